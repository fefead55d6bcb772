"""The numeric differential kinematics against a body moved through space (Ang 2004 (2.6)), alone and in the step."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from firmware_py.frame import ACCELEROMETER, COUNTS, FALLBACK, LAYOUT, STATUS, TICK
from firmware_py.records import attributes
from firmware_py.sensing import stage
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import centripetal_change, kinematic_params, solve_motion
from firmware_py.sensing.numeric_kinematics import back_substitute, fold_row, solve_guarded, solve_numeric
from firmware_py.sensing.stage import Sensing
from hal.errors import BenchError
from tests.unit.allocations import allocations
from tests.unit.pure_python import assert_kernel_is_python, without_compiler
from tests.unit.sensing.rigid_body import AXES, POSITIONS, RATE_HZ, frames_of, hand_motion
from tools.research.placement.configurations import micron_004

Array = np.ndarray
DT_S = 1e-3
NUMERIC = SensingConfig(kinematics_method="numeric", align_s=0.02)


def step_readings(rate: Array, before: Array, dt_s: float, positions: Array, axes: Array) -> tuple[Array, Array]:
    """Readings of a body whose rate went from ``before`` to ``rate``, by vector products."""
    alpha = (rate - before) / dt_s
    force = np.array([0.4, -1.0, 9.6])
    centripetal = np.cross(rate, np.cross(rate, positions))
    return np.sum(axes * (force + np.cross(alpha, positions) + centripetal), axis=1), force


def test_the_rate_comes_back_to_1e_9_in_three_iterations() -> None:
    rng = np.random.default_rng(1)
    extra = np.vstack([POSITIONS, [[0.01, 0.01, 0.05], [-0.01, 0.0, 0.08]]])
    more = np.vstack([AXES, [[0.6, 0.8, 0.0], [0.0, 0.6, 0.8]]])
    for positions, axes in ((POSITIONS, AXES), (extra, more)):
        params = kinematic_params(positions, axes, np.ones(len(axes)))
        out = np.empty(6)
        for _ in range(50):
            before = rng.normal(0.0, 1.0, 3)
            rate = before + rng.normal(0.0, 0.02, 3)
            y, force = step_readings(rate, before, DT_S, positions, axes)
            assert 1 <= solve_numeric(y, before, DT_S, params[0], out) <= 3
            np.testing.assert_allclose(before + DT_S * out[3:], rate, atol=1e-9)
            np.testing.assert_allclose(out[:3], force, atol=1e-6)


def test_what_the_axes_contradict_is_weighed_by_their_noise() -> None:
    """Nine axes with noise: the least weighted squares, found by scipy from the readings' equation alone."""
    from scipy.optimize import least_squares

    rng = np.random.default_rng(2)
    positions = np.vstack([POSITIONS, [[0.01, 0.01, 0.05], [-0.01, 0.0, 0.08], [0.0, 0.02, 0.02]]])
    axes = np.vstack([AXES, [[0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.8, 0.0, 0.6]]])
    noise = rng.uniform(0.5, 3.0, 9)
    before = np.array([1.0, -2.0, 0.5])
    y, _ = step_readings(before + 0.01, before, DT_S, positions, axes)
    y += 0.05 * noise * rng.standard_normal(9)
    out = np.empty(6)
    assert solve_numeric(y, before, DT_S, kinematic_params(positions, axes, noise)[0], out) > 0

    def left(unknown: Array) -> Array:
        rate = before + DT_S * unknown[3:]
        force = unknown[:3] + np.cross(unknown[3:], positions) + np.cross(rate, np.cross(rate, positions))
        return (np.sum(axes * force, axis=1) - y) / noise

    found = least_squares(left, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=(1, 1, 1, 20, 20, 20)).x
    np.testing.assert_allclose(out, found, rtol=1e-6, atol=1e-6)


def test_a_reading_that_cannot_be_solved_falls_back_to_the_analytic_solution() -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    out = np.empty(6)
    y = 1e9 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    assert solve_numeric(y, np.zeros(3), 1.0, params[0], out) == -1
    np.testing.assert_allclose(out, params["solve"][0] @ y, rtol=1e-12)


def test_rows_folded_one_by_one_are_the_least_squares() -> None:
    rng = np.random.default_rng(3)
    matrix, value = rng.standard_normal((9, 6)) * np.logspace(0, 4, 6), rng.standard_normal(9)
    triangle, right = np.zeros((6, 6)), np.zeros(6)
    for row, one in zip(matrix, value, strict=True):
        fold_row(row.copy(), one, triangle, right)
    assert back_substitute(triangle, right)
    np.testing.assert_allclose(right, np.linalg.lstsq(matrix, value)[0], rtol=1e-10)
    assert not back_substitute(np.zeros((6, 6)), right)


def test_kernel_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    y, w = np.linspace(-3, 9, 6), np.array([0.3, -2.0, 1.0])
    a, b = np.empty(6), np.empty(6)
    took = solve_numeric(y, w, DT_S, params[0], a)
    without_compiler(monkeypatch)
    assert took == solve_numeric.py_func(y, w, DT_S, attributes(params)[0], b)  # type: ignore[attr-defined]
    np.testing.assert_allclose(a, b, rtol=1e-9)


def wild(n: int) -> Array:
    """Frames (n, Layout.size) of a body that turns at 3 rad/s with 60 rad/s^2 about its long axis."""
    t = np.arange(n) / RATE_HZ
    turn = np.stack([0.2 * np.sin(6.0 * t), np.zeros(n), 0.15 * np.cos(20.0 * t)], axis=1)
    motion = hand_motion(3, n / RATE_HZ, np.zeros((n, 3)), turn)
    return frames_of(motion.readings(), motion)


def run(frames: Array, config: SensingConfig) -> Sensing:
    sensing = Sensing(config)
    for frame in frames:
        sensing.step(frame)
    return sensing


@pytest.mark.parametrize("method", ["numeric", "analytic"])
def test_in_the_step_force_and_rate_are_of_the_same_instant(method: str) -> None:
    """The readings come back from (f, alpha) and the rate of their own tick, rate before + dt alpha; without iterating
    they miss by what that tick changed in the centripetal part."""
    config = NUMERIC.model_copy(update={"kinematics_method": method, "kinematics_guard": False})
    frames = wild(301)
    sensing = run(frames[:300], config)
    before = sensing.state["attitude"]["rate"][0].copy()
    assert np.abs(before).max() > 1.0
    sensing.step(frames[300])
    assert sensing.fallbacks == 0
    assert not int(frames[300, STATUS]) & FALLBACK
    force, alpha = np.split(sensing.state["motion"][0], 2)
    rate = before + DT_S * alpha

    def centripetal(w: Array) -> Array:
        return np.sum(AXES * np.cross(w, np.cross(w, POSITIONS)), axis=1)

    seen = np.sum(AXES * (force + np.cross(alpha, POSITIONS)), axis=1) + centripetal(rate)
    late = centripetal(rate) - centripetal(before)
    assert np.abs(late).max() > 1e-5
    miss = seen - frames[300, ACCELEROMETER : ACCELEROMETER + 6]
    np.testing.assert_allclose(miss, late if method == "analytic" else 0.0, atol=1e-9)


def test_both_ways_agree_for_a_hand_and_part_for_a_tumble() -> None:
    """The analytic one is a tick late with the centripetal part: r |omega| |alpha| dt."""
    frames = wild(400)
    other = frames.copy()
    run(frames, NUMERIC)
    run(other, NUMERIC.model_copy(update={"kinematics_method": "analytic", "kinematics_guard": False}))
    apart = np.abs(frames - other)[300:, LAYOUT["specific_force"]].max()
    rate = np.abs(frames[300:, LAYOUT["rate"]]).max()
    assert 1e-5 < apart < 10.0 * 0.116 * rate * 60.0 * DT_S


def test_what_does_not_converge_is_counted_and_marked() -> None:
    """After a gap of 40 ticks a blow of several g on one axis: three iterations are not enough."""
    frames = wild(400)
    frames[300:, TICK] += 40
    frames[300, COUNTS] += 30_000.0
    sensing = run(frames, NUMERIC)
    assert sensing.fallbacks == 1
    assert np.flatnonzero(frames[:, STATUS].astype(int) & FALLBACK).tolist() == [300]
    sensing.reset()
    assert sensing.fallbacks == 0


def test_the_numeric_step_is_the_same_in_plain_python_and_allocates_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = wild(60)
    twins = frames.copy()
    sensing = Sensing(NUMERIC)
    for frame in frames[:30]:
        sensing.step(frame)
    first = allocations()
    sensing.step(frames[30])
    one = allocations() - first
    first = allocations()
    for frame in frames[31:]:
        sensing.step(frame)
    assert allocations() - first == one * len(frames[31:])
    assert_kernel_is_python(monkeypatch, stage, "sense_kernel", Sensing(NUMERIC), twins, frames, atol=1e-12)


def coning(noise_m_s2: float = 0.0) -> tuple[Array, Array, Array]:
    """(3000, 6) readings of Latt 2011's placement, (3001, 3) rates of 1.2 rad/s at 3 Hz about three axes, params."""
    place = micron_004()
    phase = np.radians([41.0, 147.0, 0.0])
    rates = 1.2 * np.sin(2.0 * np.pi * 3.0 * np.arange(3001)[:, None] * DT_S + phase)
    readings = [step_readings(b, a, DT_S, place.positions, place.axes)[0] for a, b in itertools.pairwise(rates)]
    noise = noise_m_s2 * np.random.default_rng(1).standard_normal((3000, 6))
    return np.array(readings) + noise, rates, kinematic_params(place.positions, place.axes, np.ones(6))


def fed_back(solve: Callable[[Array, Array, Array], object], readings: Array, start: Array) -> Array:
    """(n, 3) rates when every solution's rate is the next one's previous rate: no attitude corrects them."""
    rate, out, found = start.copy(), np.empty(6), np.empty((len(readings), 3))
    for k, reading in enumerate(readings):
        solve(reading, rate, out)
        rate += DT_S * out[3:]
        found[k] = rate
    return found


GUARD_M_S2 = float(Sensing(SensingConfig()).params["guard_m_s2"][0])


def test_fed_with_its_own_rate_the_analytic_solution_runs_away_and_the_guarded_one_stays_with_the_numeric() -> None:
    readings, rates, params = coning()
    p = params[0]
    with np.errstate(all="ignore"):
        analytic = fed_back(lambda y, w, out: solve_motion(y, w, p, out), readings, rates[0])
    numeric = fed_back(lambda y, w, out: solve_numeric(y, w, DT_S, p, out), readings, rates[0])
    guarded = fed_back(lambda y, w, out: solve_guarded(y, w, DT_S, GUARD_M_S2, p, out), readings, rates[0])
    assert not np.isfinite(analytic).all()
    np.testing.assert_allclose(numeric, rates[1:], atol=9e-9)
    np.testing.assert_allclose(guarded, rates[1:], atol=9e-9)


def test_a_rate_that_no_hand_has_is_taken_as_zero_so_that_the_solution_is_finite() -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    y, out = np.linspace(-3, 9, 6), np.empty(6)
    for rate in (np.array([30.0, 0.0, 0.0]), np.full(3, 1e200), np.array([np.nan, 0.0, 0.0])):
        assert solve_guarded(y, rate, DT_S, GUARD_M_S2, params[0], out)
        np.testing.assert_allclose(out, params["solve"][0] @ y, rtol=1e-12)


def test_the_guard_looks_at_the_centripetal_part_of_every_reading() -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    before, now = np.array([0.9, -0.4, 1.3]), np.array([1.0, -0.5, 1.1])
    expected = np.sum(
        AXES * (np.cross(now, np.cross(now, POSITIONS)) - np.cross(before, np.cross(before, POSITIONS))), 1
    )
    assert centripetal_change(before, now, params[0]) == pytest.approx(np.abs(expected).max(), rel=1e-12)


def test_the_step_counts_and_marks_what_the_analytic_solution_could_not_take() -> None:
    """A tumble of 3 rad/s: ticks that fell back are the numeric method's; without the guard there are none."""
    config = NUMERIC.model_copy(update={"kinematics_method": "analytic"})
    frames, plain = wild(300), wild(300)
    guarded, unguarded = run(frames, config), run(plain, config.model_copy(update={"kinematics_guard": False}))
    marked = frames[:, STATUS].astype(int) & FALLBACK > 0
    assert guarded.fallbacks == marked.sum() > 100
    assert unguarded.fallbacks == 0
    assert not np.any(plain[:, STATUS].astype(int) & FALLBACK)
    numeric = wild(300)
    run(numeric, NUMERIC)
    force = LAYOUT["specific_force"]
    assert np.abs(frames - numeric)[:, force].max() < 0.2 * np.abs(plain - numeric)[:, force].max()


def test_another_name_is_refused() -> None:
    with pytest.raises(BenchError, match="kinematics_method"):
        SensingConfig.from_dict({"kinematics_method": "newton"})
