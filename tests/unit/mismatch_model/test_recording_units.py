"""In which units a twin of matrices or equations speaks: what it states, else what makes it move as the recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import channel
from tools.errors import RecordingError
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
"""
        + channel("u", "input", "drive", units[0])
        + channel("y", "output", "level", units[1], 0.01 * factors[1])
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


def equations(folder: Path, state: str, more: str = "", unit: str = "mm", scale: float = 1e3) -> Path:
    """A body on a spring, its equations in N, kg and m; the channels are in mN and ``unit``."""
    t = np.arange(N) * DT
    u = np.sin(2 * np.pi * t)
    np.savez(folder / "data.npz", u=1e3 * u, y=scale * u / 50.0)
    (folder / "recording.toml").write_text(
        f"""format = 1
data = "data.npz"
rate_hz = {1 / DT}
[twin]
kind = "ode"
[twin.states]
x = "{state}"
v = ""
[twin.equations]
x = "v"
v = "(drive - 50 * x - 20 * v) / mass"
[twin.parameters]
mass = 0.01
{more}
"""
        + channel("u", "input", "drive", "mN")
        + channel("y", "output", "x", unit)
    )
    return folder


def test_a_channel_is_converted_to_the_unit_of_its_state(tmp_path: Path) -> None:
    """The equations state metres; that the force is in newtons shows in how far they then move."""
    found = load(equations(tmp_path, "m"))
    assert (found.unit["drive"], found.unit["x"]) == ("N", "m")
    assert np.ptp(found.outputs["x"]) == pytest.approx(2.0 / 50.0, rel=1e-3)
    assert any("fit drive in N: converted" in w for w in found.warnings)


@pytest.mark.parametrize(("read", "wanted"), [("N", "N"), ("mN", "mN")])
def test_units_may_state_that_of_an_input(tmp_path: Path, read: str, wanted: str) -> None:
    found = load(equations(tmp_path, "m", f'[twin.units]\ndrive = "{read}"'))
    assert found.unit["drive"] == wanted
    assert not any("converted" in w for w in found.warnings)


def test_equations_in_the_units_of_the_columns_stay_as_they_are(tmp_path: Path) -> None:
    """50 mN/mm is 50 N/m: nothing tells millinewtons and millimetres from newtons and metres, so nothing is changed."""
    found = load(equations(tmp_path, "mm"))
    assert (found.unit["drive"], found.unit["x"]) == ("mN", "mm")
    assert found.warnings == ()


def test_a_channel_of_another_dimension_than_its_state_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"'x' is recorded in rad, and \[twin.states\] states m"):
        load(equations(tmp_path, "m", unit="rad"))


def test_a_concentration_is_converted_to_the_unit_of_its_state(tmp_path: Path) -> None:
    """Grams per litre were taken for gravity per litre, and refused."""
    found = load(equations(tmp_path, "kg/m^3", unit="g/l"))
    assert found.unit["x"] == "kg/m^3"
    assert np.ptp(found.outputs["x"]) == pytest.approx(1e3 * 2.0 / 50.0, rel=1e-3)


def test_a_share_stays_as_it_is_recorded() -> None:
    assert si_unit("%") == "%"
    assert si_unit("degC") == "degC"
