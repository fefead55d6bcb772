"""Parameters that differ with the direction of motion: a shock absorber and a tank, by integrators of their own."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from tests.recording_text import channel
from tests.unit.mismatch_engine.cases import Array
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load

RATE_HZ = 100.0
SUBSTEPS = 20
CHANNELS = channel("u", "input", "{}", "{}") + channel("y", "output", "{}", "{}")
DAMPER = """
[twin]
kind = "ode"
[twin.states]
position = "m"
velocity = "m/s"
[twin.equations]
position = "velocity"
velocity = "(force - damping * velocity - stiffness * position) / mass"
[twin.parameters]
damping = 11.0
stiffness = 380.0
mass = 2.0
fixed = ["mass"]
hold = "zero"
"""
TANK = """
[twin]
kind = "ode"
[twin.states]
level = "m"
[twin.equations]
level = "(feed - level) / tau"
[twin.parameters]
tau = 0.21
hold = "zero"
"""


@numba.njit
def sprung(u: Array, bump: float, rebound: float) -> Array:
    """Return the position (n,) of 2 x'' = u - c x' - 400 x by the midpoint rule; c differs with the sign of x'."""
    h = 1.0 / (RATE_HZ * SUBSTEPS)
    x, v = 0.0, 0.0
    course = np.empty(u.size)
    for k in range(u.size):
        course[k] = x
        for _ in range(SUBSTEPS):
            a = (u[k] - (bump if v > 0.0 else rebound) * v - 400.0 * x) / 2.0
            xm, vm = x + 0.5 * h * v, v + 0.5 * h * a
            x += h * vm
            v += h * (u[k] - (bump if vm > 0.0 else rebound) * vm - 400.0 * xm) / 2.0
    return course


@numba.njit
def filled(u: Array, fill: float, drain: float) -> Array:
    """Return the level (n,) of x' = (u - x) / tau, exact over each sample; tau differs with the sign of x'."""
    course = np.empty(u.size)
    x = 0.0
    for k in range(u.size):
        course[k] = x
        x = u[k] + (x - u[k]) * np.exp(-1.0 / (RATE_HZ * (fill if u[k] > x else drain)))
    return course


@pytest.mark.parametrize(
    ("system", "up", "down"),
    [
        ("tank", 0.2, 0.3),
        pytest.param("tank", 0.2, 0.2, marks=pytest.mark.slow),
        pytest.param("damper", 8.0, 14.0, marks=pytest.mark.slow),
        pytest.param("damper", 10.0, 10.0, marks=pytest.mark.slow),
    ],
)
def test_a_parameter_that_differs_with_direction_is_named_and_nothing_else(
    tmp_path: Path, system: str, up: float, down: float
) -> None:
    rng = np.random.default_rng(11)
    u = np.repeat(rng.uniform(-1.0, 1.0, 80), 20)
    tank = system == "tank"
    y = filled(u, up, down) if tank else sprung(20.0 * u, up, down)
    y += rng.normal(0.0, 5e-3 * float(np.std(y)), y.size)
    np.savez(tmp_path / "data.npz", u=u if tank else 20.0 * u, y=y)
    channels = CHANNELS.format(*(("feed", "m", "level", "m") if tank else ("force", "N", "position", "m")))
    head = f'format = 1\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n'
    (tmp_path / "recording.toml").write_text(head + (TANK if tank else DAMPER) + channels)
    report = diagnose(load(tmp_path), jobs=1)
    if up == down:
        assert report.physics == ()
        return
    (found,) = report.physics
    assert found.name == "direction_dependence"
    assert found.target == ("tau by direction of level" if tank else "damping by direction of position")
    assert found.parameters["rising_to_falling"].value == pytest.approx(up / down, rel=0.02)
    assert report.verdict == "missing_physics"
