"""Calibrations and a corrected twin laid over a copy of the bench; one way back. The session only notes its starts."""

from __future__ import annotations

import asyncio
import tomllib
from pathlib import Path

import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH
from tools.bench.applied import Applied
from tools.bench.firmware import Choice
from tools.bench.mismatch import figures
from tools.bench.session import Session
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


class NotedStarts(Session):
    """A session that only remembers with which bench it was to start the firmware."""

    def __init__(self, folder: Path, bench: Path = DEFAULT_BENCH) -> None:
        super().__init__(Choice(bench), folder)
        self.started: list[Path] = []

    async def start(self, choice: Choice | None = None) -> None:
        assert choice is not None
        self.choice = choice
        self.started.append(choice.bench)


def twin(folder: Path) -> Path:
    path = folder / "corrected.toml"
    path.write_text(TWIN)
    return path


@pytest.fixture
def bench(tmp_path: Path) -> tuple[Applied, NotedStarts]:
    session = NotedStarts(tmp_path / "recordings")
    return Applied(session), session


def test_one_over_the_other_and_back(bench: tuple[Applied, NotedStarts], tmp_path: Path):
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


def test_a_second_twin_and_a_running_recording_are_refused(bench: tuple[Applied, NotedStarts], tmp_path: Path):
    applied, session = bench
    asyncio.run(applied.twin(twin(tmp_path)))
    with pytest.raises(InputError, match="applied already"):
        asyncio.run(applied.twin(twin(tmp_path)))

    async def while_recording() -> None:
        await session.recorder.start("first", "", {"tick_hz": "1000"}, session.layout)
        with pytest.raises(InputError, match="a recording is running"):
            await applied.calibration("poses", CALIBRATION)
        await session.recorder.stop({})

    asyncio.run(while_recording())
    assert len(session.started) == 1


def test_a_bench_of_another_instrument_takes_neither(tmp_path: Path):
    session = NotedStarts(tmp_path / "recordings", DEFAULT_BENCH.with_name("endoscope.toml"))
    applied = Applied(session)
    with pytest.raises(InputError, match="takes neither calibrations nor twins"):
        asyncio.run(applied.calibration("poses", CALIBRATION))
    assert not session.started
    assert not list(session.recorder.folder.iterdir()), "nothing half written"


def test_a_twin_that_the_bench_cannot_run_changes_nothing(bench: tuple[Applied, NotedStarts], tmp_path: Path):
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


def test_another_attitude_filter_for_the_firmware(bench: tuple[Applied, NotedStarts]):
    applied, _ = bench
    toml = calibration_toml("attitude filter", "micron bench", {"sensing": {"attitude_method": "observer"}})
    out = asyncio.run(applied.calibration("attitude filter", toml))
    stages = load_plan(load_bench(out)).stages
    assert stages.sensing.attitude_method == "observer"
