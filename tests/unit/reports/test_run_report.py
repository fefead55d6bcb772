"""What the report of a run says in words: nothing that went wrong is left to the JSON."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH
from tools.cli.run import complete_result
from tools.reports.run_report import headline, summary_lines, task_table


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
