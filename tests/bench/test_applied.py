"""Calibrations and a corrected twin laid over a copy of the bench; one way back. No firmware: the session is a stub."""

from __future__ import annotations

import asyncio
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH
from tools.bench.applied import Applied
from tools.bench.firmware import Choice
from tools.bench.mismatch import figures
from tools.calibrate.calibration_file import calibration_toml
from tools.errors import InputError

TWIN = """
[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.13
offset_um = 0.0
"""


CALIBRATION = "format = 1\n[sensing]\nrange_g = 1.6\n"


class Stub:
    """A session that only remembers which bench it was started with."""

    def __init__(self, folder: Path) -> None:
        self.choice = Choice(DEFAULT_BENCH)
        self.recorder = SimpleNamespace(folder=folder, active=False)
        self.started: list[Path] = []

    async def start(self, choice: Choice) -> None:
        self.choice = choice
        self.started.append(choice.bench)


def twin(folder: Path) -> Path:
    path = folder / "corrected.toml"
    path.write_text(TWIN)
    return path


@pytest.fixture
def bench(tmp_path: Path) -> tuple[Applied, Stub]:
    session: Any = Stub(tmp_path / "recordings")
    session.recorder.folder.mkdir()
    return Applied(session), session


def test_one_over_the_other_and_back(bench: tuple[Applied, Stub], tmp_path: Path):
    applied, session = bench
    first = asyncio.run(applied.calibration("poses", CALIBRATION))
    second = asyncio.run(applied.twin(twin(tmp_path)))
    assert applied.what == ["poses", "corrected twin"]
    assert session.started == [first, second]
    assert first != second  # the copy before stays for whoever compares
    before, after = (tomllib.loads(p.read_text()) for p in (first, second))
    assert "twin" not in before["emulation"]
    assert tomllib.loads(Path(after["emulation"]["twin"]).read_text())["twin"]["parameters"]["gain_um_per_V"] == 0.13
    assert after["firmware"]["calibration"] == before["firmware"]["calibration"]
    assert before["firmware"]["calibration"][-1].endswith("poses.toml")
    load_bench(second)
    asyncio.run(applied.discard())
    assert session.started[-1] == DEFAULT_BENCH
    assert applied.what == []


def test_a_second_twin_and_a_running_recording_are_refused(bench: tuple[Applied, Stub], tmp_path: Path):
    applied, session = bench
    asyncio.run(applied.twin(twin(tmp_path)))
    with pytest.raises(InputError, match="applied already"):
        asyncio.run(applied.twin(twin(tmp_path)))
    session.recorder.active = True
    with pytest.raises(InputError, match="a recording is running"):
        asyncio.run(applied.calibration("poses", CALIBRATION))
    assert len(session.started) == 1


def test_a_twin_that_the_bench_cannot_run_changes_nothing(bench: tuple[Applied, Stub], tmp_path: Path):
    applied, session = bench
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(TWIN.replace("piezo_stack", "mechanical_axis"))
    with pytest.raises((BenchError, InputError)):
        asyncio.run(applied.twin(wrong))
    assert applied.what == []
    assert applied.original is None
    assert not session.started


def test_figures_of_a_run(tmp_path: Path):
    path = tmp_path / "run.json"
    path.write_text(
        '{"tremor": {"uncompensated_rms_um": 25.0, "compensated_rms_um": 5.0, "reduction_percent": 80.0,'
        ' "whole_band_error": {"uncompensated_rms_um": 30.0, "compensated_rms_um": 9.0, "reduction_percent": 70.0}}}'
    )
    assert figures(path) == {"band": [25.0, 5.0, 80.0], "all": [30.0, 9.0]}


def test_another_attitude_filter_for_the_firmware(bench: tuple[Applied, Stub]):
    applied, _ = bench
    toml = calibration_toml("attitude filter", "micron bench", {"sensing": {"attitude_method": "observer"}})
    out = asyncio.run(applied.calibration("attitude filter", toml))
    stages = load_plan(load_bench(out)).stages
    assert stages.sensing.attitude_method == "observer"
