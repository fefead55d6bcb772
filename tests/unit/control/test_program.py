"""A program of voltages: read, checked against the outputs' limits, played tick by tick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.actuation.config import ActuationConfig
from firmware_py.control.program import APPROACH_S, Program, ProgramDrive, check_program, load_program
from hal.errors import BenchError

GOOD = "format = 1\nrate_hz = 1000.0\nstacks = [1, 3]\nvolts = [50.0, 60.0, 70.0]\n"


def test_a_program_is_read(tmp_path: Path):
    file = tmp_path / "program.toml"
    file.write_text(GOOD)
    program = load_program(file)
    assert program.stacks == (0, 2)
    assert program.volts.tolist() == [50.0, 60.0, 70.0]


def test_stacks_may_have_volts_of_their_own(tmp_path: Path):
    file = tmp_path / "program.toml"
    file.write_text(
        GOOD.replace("[1, 3]", "[3, 1]").replace("[50.0, 60.0, 70.0]", "[[50.0, 60.0, 70.0], [50.0, 49.0, 48.0]]")
    )
    program = load_program(file)
    check_program(file, program, ActuationConfig())
    assert program.seconds == pytest.approx(0.003 + 4 * APPROACH_S)
    drive = ProgramDrive(0.0, 100.0, 50.0, program)
    path = np.array([drive.step(5_000_000 + k * 1_000_000).copy() for k in range(2100)])
    first = round(2 * APPROACH_S * 1000)
    np.testing.assert_array_equal(path[first : first + 3], [[50.0, 50.0, 50.0], [49.0, 50.0, 60.0], [48.0, 50.0, 70.0]])
    assert path[-1].tolist() == [50.0, 50.0, 50.0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[50.0, 60.0, 70.0]", "[[50.0, 60.0]]", "give each stack one"),
        ("[50.0, 60.0, 70.0]", "[[50.0, 60.0], [70.0]]", "lists of as many numbers"),
        ("format = 1", "format = 2", "not a program"),
        ("rate_hz = 1000.0", "rate_hz = 0", "rate_hz"),
        ("[1, 3]", "[4]", "stacks"),
        ("70.0]", "nan]", "finite"),
        ("50.0, 60.0, 70.0", "50.0", "at least two"),
        ("volts", "= volts", "program.toml"),
    ],
)
def test_what_is_wrong_with_a_program_is_said(tmp_path: Path, old: str, new: str, message: str):
    file = tmp_path / "program.toml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(BenchError, match=message):
        load_program(file)


def test_a_program_beyond_the_limits_is_refused():
    limits, path = ActuationConfig(), Path("p.toml")
    with pytest.raises(BenchError, match="from 0 to 100 V"):
        check_program(path, Program(np.array([50.0, 101.0]), (0,), 10.0), limits)
    with pytest.raises(BenchError, match="V/s"):
        check_program(path, Program(np.array([0.0, 100.0]), (0,), 1000.0), limits)
    check_program(path, Program(np.array([0.0, 20.0]), (0,), 1000.0), limits)


def test_it_waits_approaches_plays_and_comes_back():
    volts = 60.0 + np.arange(300) * 0.1
    drive = ProgramDrive(0.0, 100.0, 50.0, Program(volts, (1,), 1000.0))
    path = np.array([drive.step(5_000_000 + k * 1_000_000).copy() for k in range(3000)])
    first = round(2 * APPROACH_S * 1000)
    np.testing.assert_array_equal(path[:, (0, 2)], 50.0)
    np.testing.assert_array_equal(path[: first // 2, 1], 50.0)
    np.testing.assert_allclose(path[first : first + 300, 1], volts)
    assert path[-1, 1] == 50.0
    assert np.max(np.abs(np.diff(path[:, 1]))) < 0.5
    assert drive.active


def test_after_a_stop_it_stays_at_neutral():
    drive = ProgramDrive(0.0, 100.0, 50.0, Program(np.full(100, 80.0), (0,), 1000.0))
    for k in range(1050):
        drive.step(k * 1_000_000)
    drive.stop()
    assert drive.step(1_060_000_000).tolist() == [50.0, 50.0, 50.0]
    assert not drive.armed(1_060_000_000)
