"""Parameters that follow a state of the equations: a coil whose iron saturates, by an integrator of its own."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from tests.unit.mismatch_engine.cases import Array
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load

RATE_HZ = 5000.0
SUBSTEPS = 20
COIL = """
format = 1
data = "data.npz"
rate_hz = 5000.0
[twin]
kind = "ode"
[twin.states]
current = "A"
[twin.equations]
current = "(voltage - R * current) / L"
[twin.parameters]
R = 2.05
L = 0.0098
hold = "zero"
[[channels]]
column = "u"
role = "input"
signal = "voltage"
unit = "V"
[[channels]]
column = "y"
role = "output"
signal = "current"
unit = "A"
"""


@numba.njit
def magnetised(u: Array, per_A2: float) -> Array:
    """Return the current (n,) of L i' = u - 2 i, L = 10 mH exp(-c i^2), by the midpoint rule; u is held."""
    h = 1.0 / (RATE_HZ * SUBSTEPS)
    course = np.empty(u.size)
    i = 0.0
    for k in range(u.size):
        course[k] = i
        for _ in range(SUBSTEPS):
            middle = i + 0.5 * h * (u[k] - 2.0 * i) / (0.01 * np.exp(-per_A2 * i * i))
            i += h * (u[k] - 2.0 * middle) / (0.01 * np.exp(-per_A2 * middle * middle))
    return course


@pytest.mark.slow
@pytest.mark.parametrize("per_A2", [0.02, 0.0])
def test_an_inductance_that_follows_its_current_is_named_and_nothing_else(tmp_path: Path, per_A2: float) -> None:
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-10.0, 10.0, 100), 25)
    y = magnetised(u, per_A2)
    highest = float(np.max(y))
    np.savez(tmp_path / "data.npz", u=u, y=y + rng.normal(0.0, 0.02, y.size))
    (tmp_path / "recording.toml").write_text(COIL)
    report = diagnose(load(tmp_path), jobs=1)
    if per_A2 == 0.0:
        assert report.physics == ()
        return
    (found,) = report.physics
    assert (found.name, found.target) == ("parameter_variation", "L by current")
    low, high = found.parameters["change_at_highest"].ci95
    # of the inductance at the mean current
    at_mean = -per_A2 * float(np.mean(y)) ** 2
    assert low < np.expm1(-per_A2 * highest**2 - at_mean) < high
    assert high - low < 0.1
    assert report.verdict == "missing_physics"
