"""Starts of forces while the base parameters are off: a force that is missing bends them first."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine.diagnose import prepared
from tools.mismatch.engine.screen import bend, one_step, places

PITCH_M = 0.011


def cogging_axis(n: int = 3000, rate_hz: float = 250.0):
    """A free mass of 10 kg with a triangular cogging force of 2 N, some 20 pitches of travel."""
    force = 30 * wave(np.random.default_rng(7), n, 0.3, 6.0)
    x = v = 0.0
    out = np.empty(n)
    h = 1 / rate_hz / 10
    for i in range(n):
        out[i] = x
        step = (force[min(i + 1, n - 1)] - force[i]) / 10
        for j in range(10):
            cog = 2 * (2 / np.pi) * np.arcsin(np.sin(2 * np.pi * x / PITCH_M))
            v += h * (force[i] + j * step + cog - 40 * v) / 10
            x += h * v
    out += 1e-4 * np.random.default_rng(8).standard_normal(n)
    base = {"mass": 10.2, "damping": 38.8, "stiffness": 0.0}
    return recording("mechanical_axis", {"force": force}, {"position": out}, base, rate_hz=rate_hz)


def test_cogging_starts_at_its_pitch_and_size_though_the_base_is_bent() -> None:
    problem, _, base = prepared(cogging_axis(), 0.3, 0, False)
    place = places(problem, (EFFECTS["cogging"],), ())[0]
    candidate = one_step(problem, base, place, bend(problem, base))
    start = candidate.starts[0][base.model.n_base :]
    assert abs(start[0] / PITCH_M - 1) < 0.01
    # the fundamental of a triangle of 2 N is 8/pi^2 of it; in m/s^2 on 10 kg
    assert abs(np.hypot(start[1], start[2]) / (2 * 8 / np.pi**2 / 10) - 1) < 0.3
    assert candidate.share > 0.5
