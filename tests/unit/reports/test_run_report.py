"""What the report of a run says in words: nothing that went wrong is left to the JSON."""

from __future__ import annotations

import errno
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH
from tools.cli.run import complete_result
from tools.errors import OutputError
from tools.reports import run_report
from tools.reports.figures import SHOWN_HZ
from tools.reports.run_report import headline, spectrum_table, summary_lines, task_table, write_report


@pytest.fixture(scope="module")
def sensed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    bench: Path = DEFAULT_BENCH
    return complete_result(*run_in_process(RunRequest(bench, 0.5, pace="virtual", sense_only=True)))


def test_a_run_that_arms_nothing_says_so(sensed: dict[str, Any]):
    assert "Nothing was armed" in headline(sensed)
    assert not any(line.startswith("noticed") for line in summary_lines(sensed))


def test_a_run_too_short_for_a_figure_says_what_it_needs(sensed: dict[str, Any]):
    assert "a run of more than 3 s" in headline({**sensed, "armed_ns": 1})


def test_what_was_noticed_and_caught_up_is_told(sensed: dict[str, Any]):
    told = {**sensed, "noticed": {"scans came late": 7, "parallel axes disagree": 9}}
    told["ticks"] = {**sensed["ticks"], "caught_up": 41}
    lines = summary_lines(told)
    assert "noticed: scans came late, parallel axes disagree" in lines
    assert any("41 caught up without a command" in line for line in lines)


def test_what_the_machine_and_the_processor_cost_is_told(sensed: dict[str, Any]):
    host = {"pace": "realtime", "stalls": 0, "longest_stall_ms": 0.0, "cpu_share": 0.314}
    machine = [{"name": "governor", "good": False}, {"name": "interrupts", "good": True}]
    told = {**sensed, "host": host, "machine": machine, "loop": {"kind": "compiled", "spin_share": 0.2}}
    lines = "\n".join(summary_lines(told)).splitlines()
    assert "processor: the firmware used 31 % of one; 20 % was spinning for scans" in lines
    assert "machine: not as wanted: governor; see micron doctor" in lines


def test_no_figure_of_a_task_is_cut_on_eighty_columns():
    large = {"p50": 1234.4, "p99": 12345.4, "p99_9": 23456.4, "max": 34567.4}
    task = {
        "rate_hz": 1000.0, "runs": 1_800_000, "budget_us": 520.0, "duration_us": large, "cpu_us": large,
        "overruns": 12345, "put_off": 34567,
    }  # fmt: skip
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(task_table({"tasks": {"magnetometer_x": task}}))
    words = console.export_text().split()
    for figure in ("1800000", "520", "1234", "12345", "34567"):
        assert figure in words
    assert words.count("34567") == 2


class FullConsole(Console):
    def print(self, *_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("lost", [(), ("table",), ("JSON",), ("picture",), ("page",), ("drawing",), ("JSON", "page")])
def test_the_four_results_of_a_run_do_not_depend_on_one_another(
    sensed: dict[str, Any],
    tmp_path: Path,
    full_disk: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
    lost: tuple[str, ...],
) -> None:
    files = {"JSON": tmp_path / "r.json", "picture": tmp_path / "new" / "r.png", "page": tmp_path / "r.html"}
    for name in set(lost) & set(files):
        full_disk(files[name].name)

    def draw(*_: object) -> bytes:
        if "drawing" in lost:
            raise ValueError("a drawing that fails")
        return b"PNG"

    monkeypatch.setattr(run_report, "picture", draw)
    monkeypatch.setattr(run_report, "tremor_table", lambda _: "a table")
    monkeypatch.setattr(run_report, "headline", lambda _: "a headline")
    result = {**sensed, "tremor": {**sensed["tremor"], "reduction_percent": 80.0}}
    said = io.StringIO()
    console = FullConsole() if "table" in lost else Console(file=said, width=80)

    def write() -> None:
        write_report(
            result, {"t_ns": np.zeros(1)}, console, json_file=str(files["JSON"]), html=files["page"],
            image=files["picture"],
        )  # fmt: skip

    if lost:
        with pytest.raises(OutputError) as caught:
            write()
        for name in lost:
            assert f"\n  {'picture' if name == 'drawing' else name}: " in str(caught.value)
    else:
        write()
    expected = {name for name in files if name not in lost and not (name == "picture" and "drawing" in lost)}
    assert {name for name, path in files.items() if path.exists()} == expected
    if "table" not in lost:
        assert "a headline" in said.getvalue()
    if "JSON" in expected:
        assert json.loads(files["JSON"].read_text())["tremor"]["reduction_percent"] == 80.0
    leftovers = list(tmp_path.rglob(".*"))
    assert leftovers == []


def test_the_page_has_every_band(sensed: dict[str, Any]) -> None:
    bands = [
        {"low_Hz": 0.0, "high_Hz": 2.0, "without_um": 40.0, "with_um": 41.0},
        {"low_Hz": 20.0, "high_Hz": 500.0, "without_um": 0.1, "with_um": 0.75},
    ]
    tremor = {**sensed["tremor"], "bands": bands}
    page = run_report.html_page({**sensed, "tremor": tremor}, None)
    assert "below 2 Hz<td>40.00" in page
    assert "20-500 Hz" in page
    assert "<td>0.75" in page


def scored() -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Truth of 8 s with a tremor of 10 Hz of which a tenth is left, and the result that is made of it."""
    t = np.arange(8000) / 1000.0
    tremor = 20e-6 * np.sin(2 * np.pi * 10 * t)[:, None] * np.ones(3)
    truth = {"t_ns": (t * 1e9).astype(np.int64), "tip_rigid_m": tremor, "tip_m": 0.1 * tremor}
    truth["intended_m"] = np.zeros_like(tremor)
    return truth, complete_result({"armed_ns": 0, "safe_ns": round(7.5e9)}, truth)


def test_a_run_prints_its_spectrum_on_eighty_columns():
    _, result = scored()
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(spectrum_table(result))
    lines = console.export_text().splitlines()
    head, without, left = (line.split() for line in lines[1:4])
    assert head == ["Hz", *(f"{hz:g}" for hz in SHOWN_HZ)]
    assert (without[0], left[0]) == ("without", "with")
    at = head.index("10")
    assert float(left[at]) == pytest.approx(0.1 * float(without[at]), rel=0.05)
    assert max(map(float, without[1:])) == float(without[at])


def test_the_picture_of_a_run_names_four_bands(monkeypatch: pytest.MonkeyPatch):
    from matplotlib.figure import Figure

    titles: list[str] = []
    monkeypatch.setattr(Figure, "suptitle", lambda _, text, **__: titles.append(text))
    truth, result = scored()
    assert run_report.picture(truth, result).startswith(b"\x89PNG")
    for band in ("below 2 Hz", "2-8 Hz", "8-12 Hz 24.49 to 2.45", "20-500 Hz"):
        assert band in titles[0]


def test_a_run_without_figures_has_the_same_keys(sensed: dict[str, Any]):
    _, result = scored()
    assert set(result["tremor"]) - set(sensed["tremor"]) == {"evaluated_s"}
    assert sensed["tremor"]["bands"] == sensed["tremor"]["spectrum"]["hz"] == []
