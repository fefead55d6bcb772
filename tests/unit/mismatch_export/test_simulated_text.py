"""``micron mismatch simulate``: the lines about what was read, and the residual with its offset apart."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.recording_text import channel
from tools.cli.main import app
from tools.errors import RecordingError
from tools.mismatch.export.run import as_read
from tools.mismatch.recording_load import load

COLUMNS = (
    """
format = 1
data = "data.csv"
rate_hz = 10.0
[twin]
kind = "columns"
"""
    + channel("x", "output", "x", "mm")
    + channel("sim", "input", "simulated_x", "mm")
)
SLIDING = (
    """
format = 1
data = "data.csv"
rate_hz = 10.0
[twin]
kind = "mechanical_axis"
[twin.parameters]
mass = 1.0
"""
    + channel("sim", "input", "force", "N")
    + channel("x", "output", "position", "mm")
)


def _recorded(folder: Path, text: str, offset: float) -> Path:
    sim = np.sin(np.arange(200) / 5.0)
    x = sim + offset + 0.02 * (-1.0) ** np.arange(200)
    np.savetxt(folder / "data.csv", np.c_[x, sim], delimiter=",", header="x,sim", comments="")
    (folder / "recording.toml").write_text(text)
    return folder


def _simulated(folder: Path) -> tuple[str, dict[str, float]]:
    ran = CliRunner().invoke(app, ["mismatch", "simulate", str(folder), "--json", str(folder / "out.json")])
    assert ran.exit_code == 0, ran.output
    line = next(line for line in ran.output.splitlines() if "residual" in line)
    return line, json.loads((folder / "out.json").read_text())["outputs"][0]


def test_a_constant_offset_is_printed_apart_from_the_scatter(tmp_path: Path) -> None:
    line, row = _simulated(_recorded(tmp_path, COLUMNS, 0.5))
    assert "residual 0.5004 mm rms (0.02 mm about its mean of 0.5 mm)" in line
    assert abs(row["scatter"] - 0.02) < 1e-9
    assert abs(row["mean"] - 0.5) < 1e-9


def test_without_an_offset_one_number_is_enough(tmp_path: Path) -> None:
    line, _ = _simulated(_recorded(tmp_path, COLUMNS, 0.001))
    assert "about its mean" not in line


def test_a_hold_is_printed_for_kinds_that_have_one(tmp_path: Path) -> None:
    lines = as_read(load(_recorded(tmp_path, COLUMNS, 0.0)))
    assert "inputs: simulated_x (mm)" in lines
    lines = as_read(load(_recorded(tmp_path, SLIDING, 0.0)))
    assert "inputs: force (N, hold not given, straight)" in lines


def test_the_parameters_are_printed_as_they_were_read(tmp_path: Path) -> None:
    assert "parameters: mass = 1" in as_read(load(_recorded(tmp_path, SLIDING, 0.0)))


def test_a_parameter_is_not_broken_across_lines(tmp_path: Path) -> None:
    numbers = {f"a_rather_long_name_{k}": 0.125 + k for k in range(9)}
    text = SLIDING.replace('"mechanical_axis"', '"ode"\noutputs = { position = "a_rather_long_name_1 * force" }')
    text = text.replace("mass = 1.0", "\n".join(f"{name} = {value}" for name, value in numbers.items()))
    ran = CliRunner().invoke(app, ["mismatch", "simulate", str(_recorded(tmp_path, text, 0.0))])
    assert ran.exit_code == 0, ran.output
    lines = ran.stderr.splitlines()
    assert all(any(f"{name} = {value:.6g}" in line for line in lines) for name, value in numbers.items())
    assert max(len(line) for line in lines if "a_rather_long_name_" in line) <= 80


def _of_matrices(folder: Path, matrices: str, unit: str = "mm") -> list[str]:
    text = """
format = 1
data = "data.csv"
rate_hz = 10.0
[twin]
kind = "state_space"
[twin.parameters]
"""
    text += matrices + channel("sim", "input", "drive", "mV") + channel("x", "output", "position", unit)
    return [line for line in as_read(load(_recorded(folder, text, 0.0))) if line.startswith(("poles", "static"))]


@pytest.mark.parametrize(
    ("matrices", "poles", "gain"),
    [
        ("A = [[-0.5]]\nB = [[1.0]]\nC = [[2.0]]", "-0.5 1/s", "4 mm per mV"),
        ("A = [[-0.5]]\nB = [[1.0]]\nC = [[2.0]]\nD = [[-3.0]]", "-0.5 1/s", "1 mm per mV"),
        ("A = [[0, 1], [-100, -2]]\nB = [[0], [10]]\nC = [[1, 0]]", "1.592 Hz with damping 0.1", "0.1 mm per mV"),
        ("A = [[0, 1], [0, -2]]\nB = [[0], [10]]\nC = [[1, 0]]", "0 1/s, -2 1/s", "integrates"),
        ("A = [[0, 1], [0, -2]]\nB = [[0], [10]]\nC = [[0, 1]]", "0 1/s, -2 1/s", "5 mm per mV"),
        ("A = [[0, 1], [0, 0]]\nB = [[0], [1]]\nC = [[1, 0]]", "0 1/s, 0 1/s", "integrates"),
        ("A = [[0.9]]\nB = [[0.2]]\nC = [[1]]\ndiscrete = true", "-1.054 1/s", "2 mm per mV"),
        ("A = [[1.0]]\nB = [[0.2]]\nC = [[1]]\ndiscrete = true", "0 1/s", "integrates"),
        ("A = [[0.0]]\nB = [[0.2]]\nC = [[1]]\ndiscrete = true", "none", "0.2 mm per mV"),
    ],
)
def test_matrices_are_printed_as_poles_and_static_gains(tmp_path: Path, matrices: str, poles: str, gain: str) -> None:
    lines = [f"poles: {poles}", f"static gain: drive to position {gain}"]
    assert _of_matrices(tmp_path, f"{matrices}\n") == lines


def test_a_static_gain_is_in_the_units_of_the_file(tmp_path: Path) -> None:
    """The matrices are in V and rad, the columns in mV and deg."""
    matrices = f"A = [[-50.0]]\nB = [[{50e3 * math.radians(1.0)}]]\nC = [[1.0]]\n"
    lines = ["poles: -50 1/s", "static gain: drive to position 1 deg per mV"]
    assert _of_matrices(tmp_path, matrices, "deg") == lines


def test_matrices_that_cannot_be_read_have_no_poles(tmp_path: Path) -> None:
    assert _of_matrices(tmp_path, "A = [[-0.5, 1.0]]\nB = [[1.0]]\nC = [[2.0]]\n") == []


def test_a_simulation_that_is_further_off_than_the_mean_is_said_to_be(tmp_path: Path) -> None:
    line, row = _simulated(_recorded(tmp_path, COLUMNS, 50.0))
    assert row["share"] > 1.0
    assert line.endswith(
        "its mean alone would be closer; check units, signs and offsets (where a plant integrates, small errors add up)"
    )
    line, row = _simulated(_recorded(tmp_path, COLUMNS, 0.001))
    assert row["share"] < 1.0
    assert "closer" not in line


def test_a_misspelt_name_is_told_alone(tmp_path: Path) -> None:
    text = SLIDING.replace('"mechanical_axis"', '"ode"\nback_emf = 0.1\noutputs = { position = "backemf * force" }')
    ran = CliRunner().invoke(app, ["mismatch", "simulate", str(_recorded(tmp_path, text, 0.0))])
    assert ran.exit_code == 2
    assert "'backemf' is no state, input or parameter" in ran.stderr
    assert "inputs:" not in ran.stderr
    assert "note:" not in ran.stderr


def test_segments_of_one_file_are_not_those_of_another(tmp_path: Path) -> None:
    folder = _recorded(tmp_path, SLIDING.replace("[twin]", "segments = [100]\n[twin]", 1), 0.0)
    whole = load(folder)
    other = load(folder, folder / "data.csv")
    assert (whole.segments, other.segments) == ((100,), ())
    assert any(note.startswith("segments are those of ") for note in other.warnings)


def test_a_first_segment_at_zero_is_told_to_be_left_out(tmp_path: Path) -> None:
    text = SLIDING.replace("[twin]", "segments = [0, 100]\n[twin]", 1)
    with pytest.raises(RecordingError, match="the first run begins at 0 in any case; leave the 0 out"):
        load(_recorded(tmp_path, text, 0.0))


def test_the_states_at_the_first_sample_are_printed(tmp_path: Path) -> None:
    """They are found from the record: a decay from 1 mm without a drive."""
    text = SLIDING.replace('"mechanical_axis"', '"ode"\nstates = { position = "mm" }\nrate = 0.2')
    text = text.replace("mass = 1.0", 'equations = { position = "force - rate * position" }')
    (tmp_path / "recording.toml").write_text(text)
    t = np.arange(200) / 10.0
    np.savetxt(tmp_path / "data.csv", np.c_[np.exp(-0.2 * t), 0 * t], delimiter=",", header="x,sim", comments="")
    ran = CliRunner().invoke(app, ["mismatch", "simulate", str(tmp_path)])
    assert ran.exit_code == 0, ran.output
    assert "states at the first sample: position = 1 mm" in ran.stderr
