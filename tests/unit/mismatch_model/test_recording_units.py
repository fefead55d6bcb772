"""In which units a state-space twin speaks: whatever makes the twin as given move as much as the recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.mismatch.recording_load import load
from tools.mismatch.recording_units import si_unit

N, DT, POLE = 400, 0.01, 20.0


def write(folder: Path, gain: float, units: tuple[str, str], factors: tuple[float, float]) -> Path:
    """A first-order lag of unit gain V -> V, its channels in other units; ``gain``: what the matrices say."""
    t = np.arange(N) * DT
    u = np.sin(2 * np.pi * t)
    y, decay = np.zeros(N), np.exp(-POLE * DT)
    ramp = 1.0 - (1.0 - decay) / (POLE * DT)
    for i in range(1, N):
        y[i] = decay * y[i - 1] + (1 - decay) * u[i - 1] + ramp * (u[i] - u[i - 1])
    np.savez(folder / "data.npz", u=u * factors[0], y=y * factors[1])
    (folder / "recording.toml").write_text(
        f"""format = 1
data = "data.npz"
rate_hz = {1 / DT}
[twin]
kind = "state_space"
[twin.parameters]
A = [[{-POLE}]]
B = [[{POLE}]]
C = [[{gain}]]
[[channels]]
column = "u"
role = "input"
signal = "drive"
unit = "{units[0]}"
[[channels]]
column = "y"
role = "output"
signal = "level"
unit = "{units[1]}"
noise_rms = {0.01 * factors[1]}
"""
    )
    return folder


@pytest.mark.parametrize(
    ("gain", "units", "factors", "read"),
    [
        (1.0, ("V", "mV"), (1.0, 1e3), ("V", "V")),  # the contract: mV is converted, C is in V
        (1e3, ("V", "mV"), (1.0, 1e3), ("V", "mV")),  # C was identified in mV
        (1.0, ("mV", "mV"), (1e3, 1e3), ("V", "V")),
        (1e-3, ("mV", "V"), (1e3, 1.0), ("mV", "V")),
        (1.0, ("mV", "um"), (1e3, 1.0), ("V", "um")),  # matrices in volts and micrometres
        (2.0, ("V", "mV"), (1.0, 1e3), ("V", "V")),  # a wrong gain is no unit
    ],
)
def test_units_that_the_matrices_speak(
    tmp_path: Path, gain: float, units: tuple[str, str], factors: tuple[float, float], read: tuple[str, str]
) -> None:
    found = load(write(tmp_path, gain, units, factors))
    assert (found.unit["drive"], found.unit["level"]) == read
    noise = found.noise["level"]
    assert noise is not None
    assert noise / np.ptp(found.outputs["level"]) == pytest.approx(0.01 * factors[1] / (np.ptp(read_y(tmp_path))))
    kept = [u for u, r in zip(units, read, strict=True) if u == r and u in ("mV", "um")]
    assert any("kept" in w for w in found.warnings) == bool(kept)


def read_y(folder: Path) -> np.ndarray:
    with np.load(folder / "data.npz") as data:
        return data["y"]


def test_si_of_a_dimension() -> None:
    assert [si_unit(u) for u in ("mV", "um", "deg/s", "G", "V", "degC", "%", "count")] == [
        "V", "m", "rad/s", "T", "V", "degC", "%", "count",
    ]  # fmt: skip
