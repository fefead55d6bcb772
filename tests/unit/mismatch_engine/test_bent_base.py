"""Starts of forces while the base parameters are off: a force that is missing bends them first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine import screen
from tools.mismatch.engine.fit import fit
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.score import misfits
from tools.mismatch.engine.screen import bend, one_step, places
from tools.mismatch.engine.trial import extended, hopeful
from tools.mismatch.recording import Recording

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


def motor() -> Recording:
    """The angle of a motor that integrates, with a limit before it that its equations lack."""
    rate_hz, n, steps = 100.0, 2000, 30
    rng = np.random.default_rng(3)
    volts = 2.5 * wave(rng, n, 0.5, 6.0)
    speed = shaft = 0.0
    angle = np.empty(n)
    h = 1 / rate_hz / steps
    for i in range(n):
        angle[i] = shaft
        step = (volts[min(i + 1, n - 1)] - volts[i]) / steps
        for j in range(steps):
            u = min(max(volts[i] + j * step, -1.3), 1.3)
            speed += h * (20.0 * u - speed) / 0.08
            shaft += h * speed
    angle += 0.003 * rng.standard_normal(n)
    twin = {
        "states": {"angle": "V", "speed": "V/s"},
        "equations": {"angle": "speed", "speed": "(gain * command - speed) / lag"},
        "units": {"gain": "1/s", "lag": "s"},
        "gain": 19.0,
        "lag": 0.085,
    }
    return recording("ode", {"command": volts}, {"angle": angle}, twin, rate_hz=rate_hz)


def fitted_alone(name: str, site: str) -> tuple[dict[str, float], float]:
    """Parameters of an effect at a place and of the base, by their short names; residual over noise power."""
    problem, _, base = prepared(motor(), 0.3, 0, False)
    place = next(p for p in places(problem, (EFFECTS[name],), ()) if p.site == site)
    candidate = one_step(problem, base, place, bend(problem, base))
    assert candidate.share > 0.9
    model, _ = extended(problem, base, candidate.placed)
    found = fit(problem, model, candidate.starts)
    values = {p.name.rsplit(".", 1)[-1]: float(v) for p, v in zip(model.parameters, found.theta, strict=True)}
    return values, misfits(problem, found)["angle"]


def test_a_limit_before_a_plant_that_integrates_is_met_though_every_stretch_starts_elsewhere() -> None:
    found, left = fitted_alone("saturation", "input")
    assert found["upper_limit"] == pytest.approx(1.3, rel=0.01)
    assert found["lower_limit"] == pytest.approx(-1.3, rel=0.01)
    assert left < 5.0


def test_candidates_on_another_base_start_near_its_one_run() -> None:
    problem, _, base = prepared(motor(), 0.3, 0, False)
    other = base.theta.copy()
    other[: base.model.n_base] = base.model.twin.start(problem.recording)
    near = base.model.started(problem.view, other)
    assert base.model.started(problem.view, other) is near
    (found,) = near.of_stretches.values()
    alone = base.model.simulate(problem.view, other)["angle"]
    assert base.model.simulate(problem.view.near(near), other)["angle"] == pytest.approx(alone, abs=1e-6)
    assert found.states.shape[1:] == (2, 2)


def test_what_its_own_test_refuses_takes_no_step_and_no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _, base = prepared(motor(), 0.3, 0, False)
    place = places(problem, (EFFECTS["quantization"],), ())[0]
    monkeypatch.setattr(screen, "_step_gain", lambda *_: pytest.fail("a step of a refused effect"))
    candidate = one_step(problem, base, place, bend(problem, base))
    assert candidate.refused
    strong = replace(candidate, share=0.9)
    assert hopeful([strong]) == [False]
    assert hopeful([replace(strong, p_value=1e-9)]) == [True]
