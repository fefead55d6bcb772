"""Play or hardening in the joint of two bodies, which the simulation joins by a spring; the truth integrates itself."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.recording_text import channel
from tests.unit.mismatch_engine.cases import Array
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load

RATE_HZ, SUBSTEPS = 200.0, 20
DRIVE = (
    """
format = 1
data = "data.npz"
rate_hz = 200.0
[twin]
kind = "ode"
[twin.states]
motor = "rad"
motor_speed = "rad/s"
load = "rad"
load_speed = "rad/s"
[twin.equations]
motor = "motor_speed"
motor_speed = "(torque - 0.15*motor_speed - stiffness*(motor - load)) / motor_inertia"
load = "load_speed"
load_speed = "(stiffness*(motor - load) - load_drag*load_speed) / 0.08"
[twin.parameters]
stiffness = 27.0
motor_inertia = 0.021
load_drag = 0.047
hold = "zero"
"""
    + channel("torque", "input", "torque", "N m")
    + channel("motor", "output", "motor", "rad")
    + channel("load", "output", "load", "rad")
)


@numba.njit
def driven(u: Array, gap: float, hardening: float = 0.0) -> Array:
    """Return both angles (n, 2) by the midpoint rule; no torque passes within ``gap`` to either side."""
    h = 1.0 / (RATE_HZ * SUBSTEPS)
    x, m, rate = np.zeros(4), np.zeros(4), np.zeros(4)
    course = np.empty((u.size, 2))
    for k in range(u.size):
        course[k, 0], course[k, 1] = x[0], x[2]
        for _ in range(SUBSTEPS):
            for half in range(2):
                y = x if half == 0 else m
                d = y[0] - y[2]
                pull = 30.0 * (d - min(max(d, -gap), gap)) + hardening * d**3
                rate[0], rate[1] = y[1], (u[k] - 0.15 * y[1] - pull) / 0.02
                rate[2], rate[3] = y[3], (pull - 0.05 * y[3]) / 0.08
                if half == 0:
                    m[:] = x + 0.5 * h * rate
            x += h * rate
    return course


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 0.015])
def test_play_in_a_joint_is_named_with_its_size_and_place(tmp_path: Path, gap: float) -> None:
    rng = np.random.default_rng(8)
    u = np.repeat(rng.uniform(-1.0, 1.0, 50), 30)
    y = driven(u, gap) + rng.normal(0.0, 0.002, (u.size, 2))
    np.savez(tmp_path / "data.npz", torque=u, motor=y[:, 0], load=y[:, 1])
    (tmp_path / "recording.toml").write_text(DRIVE)
    report = diagnose(load(tmp_path), jobs=1)
    if not gap:
        assert report.physics == ()
        return
    (found,) = report.physics
    assert (found.name, found.target) == ("clearance", "motor - load")
    assert found.parameters["gap"].value == pytest.approx(2 * gap, rel=0.1)


@pytest.mark.slow
def test_a_spring_between_two_bodies_hardens(tmp_path: Path) -> None:
    """The place is the joint: a spring from either body to ground is another force."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-3.0, 3.0, 50), 30)
    y = driven(u, 0.0, 1500.0) + rng.normal(0.0, 0.002, (u.size, 2))
    np.savez(tmp_path / "data.npz", torque=u, motor=y[:, 0], load=y[:, 1])
    (tmp_path / "recording.toml").write_text(DRIVE)
    report = diagnose(load(tmp_path), jobs=1, effects=[EFFECTS[n] for n in ("cubic_stiffness", "clearance")])
    (found,) = report.physics
    assert (found.name, found.target, report.verdict) == ("cubic_stiffness", "motor - load", "missing_physics")
    assert found.parameters["cubic_stiffness"].value == pytest.approx(1500.0, rel=0.05)
