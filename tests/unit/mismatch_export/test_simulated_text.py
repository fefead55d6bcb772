"""``micron mismatch simulate``: the lines about what was read, and the residual with its offset apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from tests.recording_text import channel
from tools.cli.main import app
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
    assert "inputs: force (N, hold not given)" in lines


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


def test_a_simulation_that_is_further_off_than_the_mean_is_said_to_be(tmp_path: Path) -> None:
    line, row = _simulated(_recorded(tmp_path, COLUMNS, 50.0))
    assert row["share"] > 1.0
    assert line.endswith("its mean alone would be closer; check units, signs and offsets")
    line, row = _simulated(_recorded(tmp_path, COLUMNS, 0.001))
    assert row["share"] < 1.0
    assert "closer" not in line
