"""Elastic-plastic forces inside an equation of motion: a spring while they stick, dry friction when they slide."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.forces import COGGING, FRICTION, OFFSET, SPRING, friction_limit, loop_along
from sim_devices.physics.memory import dahl
from tools.mismatch.twins.feedback import Body, Rows, run_feedback

NO_SPRING, NONE5, NONE6 = np.zeros(SPRING), np.zeros(COGGING), np.zeros(FRICTION)


def free_mass(u: np.ndarray, dt: float, x0: tuple[float, float], radius: float, stiffness: float) -> np.ndarray:
    """Position of a unit mass with one stop operator under the force u."""
    ad = np.array([[1.0, dt], [0.0, 1.0]])
    # linear input over a step: exact weights of the values before and after
    g0, g1 = np.array([dt * dt / 3, dt / 2]), np.array([dt * dt / 6, dt / 2])
    body = Body(ad, g0, g1, np.array([1.0, 0.0]), np.array([0.0, 1.0]), False, 1, dt, False)
    rows = Rows(NONE6, NO_SPRING, NONE5, np.array([radius]), np.array([stiffness]))
    x = run_feedback(body, rows, u, np.array([x0]), np.zeros(1, np.int64), np.array([u.size]))
    return x[:, 0]


def test_a_bristle_that_sticks_is_a_spring_that_never_gains_energy() -> None:
    w, dt = 2.0, 0.1  # a fifth of a radian a step
    x = free_mass(np.zeros(2000), dt, (0.0, 1e-3), 1.0, w * w)
    t = np.arange(2000) * dt
    assert x[:200] == pytest.approx(0.5e-3 * np.sin(w * t[:200]), abs=0.05e-3)
    assert 0.85e-3 < np.ptp(x[-200:]) < 1e-3  # after 64 periods


def test_a_bristle_that_slides_is_a_constant_force() -> None:
    radius, level, dt = 1e-4, 0.3, 1e-3
    x = free_mass(np.full(1000, 1.0), dt, (0.0, 0.0), radius, level / radius)
    v = np.diff(x)[-100:] / dt
    assert np.diff(v) / dt == pytest.approx(np.full(99, 1.0 - level), rel=1e-6)


def lugre(u: np.ndarray, dt: float, row: np.ndarray) -> np.ndarray:
    """Position and velocity (n, 2) of a unit mass at rest with friction behind bristles under the force u."""
    ad = np.array([[1.0, dt], [0.0, 1.0]])
    g0, g1 = np.array([dt * dt / 3, dt / 2]), np.array([dt * dt / 6, dt / 2])
    row = np.pad(row, (0, FRICTION - row.size))
    body = Body(ad, g0, g1, np.array([1.0, 0.0]), np.array([0.0, 1.0]), False, 1, dt, False)
    rows = Rows(row, NO_SPRING, NONE5, np.zeros(0), np.zeros(0))
    return run_feedback(body, rows, u, np.zeros((1, 2)), np.zeros(1, np.int64), np.array([u.size]))


def test_friction_behind_bristles_is_its_level_while_it_slides() -> None:
    dt, level = 1e-3, 0.3
    x = lugre(np.full(2000, 1.0), dt, np.array([level, 0.0, 0.0, 0.0, 0.0, level / 1e-5]))
    assert np.diff(x[-200:, 1]) / dt == pytest.approx(np.full(199, 1.0 - level), rel=1e-6)


def test_friction_behind_bristles_is_a_spring_below_its_level() -> None:
    dt, level, stiffness = 1e-4, 1.0, 400.0
    x = lugre(np.full(600, 0.02), dt, np.array([level, 0.0, 0.0, 0.0, 0.0, stiffness]))
    t = dt * np.arange(600)
    spring = 0.02 / stiffness * (1 - np.cos(np.sqrt(stiffness) * t))  # z = x while |z| is far below level / stiffness
    assert x[:, 0] == pytest.approx(spring, abs=0.02 * np.ptp(spring))


def test_the_stribeck_extra_holds_what_the_level_alone_would_let_go() -> None:
    dt, stiffness = 1e-3, 2e4
    push = np.linspace(0.0, 1.2, 1500)
    held = lugre(push, dt, np.array([1.0, 0.0, 0.5, 0.05, 0.0, stiffness]))
    gone = lugre(push, dt, np.array([1.0, 0.0, 0.0, 0.05, 0.0, stiffness]))
    assert abs(held[-1, 0]) < 2e-4
    assert gone[-1, 0] > 2e-3


def test_presliding_friction_reports_level_and_distance() -> None:
    bristles = EFFECTS["coulomb_friction"].variants[0]
    assert bristles.report is not None
    found = {h.name: h.value for h in bristles.report(np.array([3e-5, 0.6]), {"travel": (0.01,)}, 2.0)}
    assert found["coulomb_forward"] == pytest.approx(0.3)
    assert found["presliding_distance"] == pytest.approx(3e-5)


@pytest.mark.parametrize("lean", [-1.4, -1.0, -0.5, 0.0, 0.5])
def test_a_bouc_wen_element_meets_its_differential_equation(lean: float) -> None:
    yielding, course = (
        0.3,
        np.concatenate([np.linspace(0, 0.5, 40), np.linspace(0.5, -0.4, 70), np.linspace(-0.4, 0, 9)]),
    )
    z, fine = np.zeros(course.size), 4000
    for k, move in enumerate(np.diff(course), 1):
        step, w = move / fine, z[k - 1]
        for _ in range(fine):
            # explicit steps of the equation as published (Wen 1976, eq. 3)
            w += step - (abs(step) * w + lean * step * abs(w)) / yielding
        z[k] = w
    assert loop_along(course, yielding, lean, np.zeros(1, np.int64)) == pytest.approx(z, abs=2e-4)


def test_a_loop_without_a_lean_is_the_smooth_spring() -> None:
    course = np.cumsum(np.random.default_rng(5).normal(size=500)) * 0.05
    start = np.zeros(1, np.int64)
    plain = dahl(course - course[0], np.array([0.3]), np.zeros(1), 0.0, start)[:, 0]
    assert loop_along(course - course[0], 0.3, 0.0, start) == pytest.approx(plain, abs=1e-9)


@pytest.mark.parametrize(
    ("flag", "falls"), [(0.0, lambda r: np.exp(-r * r)), (1.0, lambda r: np.exp(-r)), (2.0, lambda r: 1 / (1 + r * r))]
)
def test_the_extra_falls_by_one_of_three_laws(flag: float, falls: Callable[[float], float]) -> None:
    """Armstrong-Helouvry (1991), eq. 2.3; Tustin (1947); Hess and Soom (1990)."""
    row = np.array([1.0, 0.2, 0.5, 0.1, 0.0, 0.0, 0.0, flag])
    for v in (-0.3, -0.1, 0.0, 0.05, 0.2):
        sign = -1.0 if v < 0.0 else 1.0
        expected = 1.0 + sign * 0.2 + 0.5 * falls(abs(v) / 0.1)
        assert friction_limit(v, sign, row, 0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("step_rad", [0.05, 0.2])
def test_a_mass_on_a_spring_loses_the_same_travel_with_every_half_turn(step_rad: float) -> None:
    """Closed form: a half turn about +-F/k each, until the spring cannot overcome the friction F where it turns."""
    width = 0.06  # F/k
    t = np.arange(int(35.0 / step_rad)) * step_rad
    half = np.floor(t / np.pi)
    way = np.where(half % 2 == 0, 1.0, -1.0)
    exact = way * width + (1.0 - width - 2.0 * width * half) * np.cos(t)
    rest = half >= 8.0  # 1 - 16 F/k is the first turn within F/k
    exact[rest] = 1.0 - 16.0 * width
    cos, sin = np.cos(step_rad), np.sin(step_rad)
    held = np.array([1.0 - cos, sin])
    body = Body(
        np.array([[cos, sin], [-sin, cos]]), held, np.zeros(2), np.array([1.0, 0.0]), np.array([0.0, 1.0]), True, 1,
        step_rad, True,
    )  # fmt: skip
    friction = np.zeros(FRICTION)
    friction[0] = width
    rows = Rows(friction, NO_SPRING, NONE5, np.zeros(0), np.zeros(0))
    x = run_feedback(
        body, rows, np.zeros(t.size), np.array([[1.0, 0.0]]), np.zeros(1, np.int64), np.array([t.size])
    )  # fmt: skip
    assert np.max(np.abs(x[:, 0] - exact)) < 0.1 * step_rad**2
    assert np.ptp(x[rest, 0][2:]) == 0.0


def test_a_level_that_differs_with_the_direction_is_one_level_beside_a_constant_force() -> None:
    """In motion and at rest, so that a twin with such a force has no second parameter for it."""
    coulomb = EFFECTS["coulomb_friction"]
    sided, plain = {"speed": (1.0,)}, {"speed": (1.0,), OFFSET: (1.0,)}
    names = [[w.name for w in coulomb.parts(s).weights] for s in (sided, plain)]
    assert names == [["level", "asymmetry", "viscous_asymmetry"], ["level", "viscous_asymmetry"]]
    assert coulomb.fill is not None
    dt, asymmetry = 0.01, 0.2
    t = np.arange(1500) * dt
    u = 1.2 * np.sin(0.7 * t) + 0.6 * np.sin(2.3 * t)
    body = Body(
        np.array([[1.0, dt], [0.0, 1.0]]), np.array([dt * dt / 3, dt / 2]), np.array([dt * dt / 6, dt / 2]),
        np.array([1.0, 0.0]), np.array([0.0, 1.0]), False, 1, dt, True,
    )  # fmt: skip
    runs = []
    for weights, settings, force in (((0.5, asymmetry, 0.0), sided, u), ((0.5, 0.0), plain, u - asymmetry)):
        row = coulomb.fill(np.zeros(0), np.array(weights), settings)["friction"]
        rows = Rows(row, NO_SPRING, NONE5, np.zeros(0), np.zeros(0))
        end = np.array([t.size])
        runs.append(run_feedback(body, rows, force, np.zeros((1, 2)), np.zeros(1, np.int64), end))
    assert np.any(runs[0][1:, 1] == 0.0)  # it rests at times
    assert np.max(np.abs(runs[0] - runs[1])) < 1e-9 * np.ptp(runs[0])
