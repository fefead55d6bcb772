"""Loops are run through one way round, bounds are met exactly, and slow residuals are no steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Array, Context
from sim_devices.physics.memory import stops
from sim_devices.physics.statistics import bounded_solution, long_run_rms, signed_least_squares
from sim_devices.physics.step_shift import edges, find_steps

T = np.arange(4000) / 200.0
ONE = np.zeros(1, np.int64)


def test_coefficients_of_one_sign_are_those_of_lawson_and_hanson() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, y = rng.standard_normal((40, 6)), rng.standard_normal(40)
        expected = nnls(a, y)[0]
        np.testing.assert_allclose(signed_least_squares(a, y, np.ones(6), 0.0), expected, atol=1e-9)
        np.testing.assert_allclose(signed_least_squares(a, -y, -np.ones(6), 0.0), -expected, atol=1e-9)


def test_a_bound_is_met_and_the_others_are_solved_beside_it() -> None:
    # clipping the free solution (1.2, -0.4) would leave the first coefficient at 1.2
    gram, cross = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([2.0, 0.4])
    found = bounded_solution(gram, cross, np.zeros(2), np.full(2, np.inf))
    np.testing.assert_allclose(found, [1.0, 0.0], atol=1e-9)


def predicted(x: Array, y: Array, small: Array) -> Array:
    """Steady output for the drive ``small``, less its mean, of hysteresis that was fitted to y over one loop x."""
    effect = EFFECTS["hysteresis"]
    assert effect.basis is not None
    ctx = Context(T, float(T[1]), {"command": x}, "y", "y", "command", measured=y)
    settings = effect.prepare(x, y - np.polyval(np.polyfit(x, y, 1), x), ctx)
    parts = effect.parts(settings).weights
    columns = np.column_stack([np.ones_like(x), x, effect.basis(x, ctx, np.empty(0), settings)])
    signs = np.r_[0.0, 0.0, [(p.lo == 0.0) - float(p.hi == 0.0) for p in parts]]
    w = signed_least_squares(columns, y, signs)
    other = Context(T, float(T[1]), {"command": small}, "y", "y", "command")
    out = np.column_stack([np.ones_like(small), small, effect.basis(small, other, np.empty(0), settings)]) @ w
    half = out[out.size // 2 :]
    return half - half.mean()


def loop(x: Array, bend: float) -> Array:
    """A loop of four plays, and a curve behind it."""
    inside = x - stops(x, np.array([0.1, 0.25, 0.45, 0.7]), x[0], ONE) @ np.array([0.12, 0.1, 0.08, 0.06])
    return inside + bend * inside**2


@pytest.mark.parametrize("bend", [0.0, 0.08])
def test_one_loop_tells_what_a_smaller_one_is(bend: float) -> None:
    rng = np.random.default_rng(1)
    x, small = np.sin(2 * np.pi * T), 0.5 * np.sin(2 * np.pi * T)
    y = loop(x, bend) + 0.002 * rng.standard_normal(x.size)
    exact = loop(small, bend)[x.size // 2 :]
    exact = exact - exact.mean()
    error = predicted(x, y, small) - exact
    assert np.sqrt(np.mean(error**2)) < 0.03 * exact.std()


def test_what_wanders_slowly_is_no_change_of_level() -> None:
    keep, memory = np.ones(1200, np.bool_), np.exp(-1 / 12)
    ratio: list[float] = []
    found: list[int] = []
    for seed in range(8):
        white = np.random.default_rng(seed).standard_normal(1200)
        slow: Array = np.asarray(lfilter([1.0], [1.0, -memory], white), np.float64)
        # the square root of the spectral density at zero of this process is 1 / (1 - memory)
        ratio.append(long_run_rms(slow) * (1 - memory))
        found.append(len(find_steps(slow, keep)[0]))
    assert 0.7 < np.mean(ratio) < 1.4
    assert sum(found) <= 1
    jumped: Array = np.random.default_rng(8).standard_normal(1200) + np.where(np.arange(1200) >= 700, 3.0, 0.0)
    assert find_steps(jumped, keep)[0] == [pytest.approx(700, abs=3)]


def test_an_edge_jumps_by_what_the_level_changes() -> None:
    rng = np.random.default_rng(3)
    noise = 0.01 * rng.standard_normal(2000)
    k = np.arange(2000)
    ctx = Context(k / 1.0, 1.0, {}, "y", "y", mask=np.ones(2000, np.bool_))
    step = noise + 1.0 * (k >= 900)
    kink = noise + np.clip((k - 900) / 12.0, 0.0, 1.0)
    assert edges(step, ctx)[0] == [900]
    assert edges(kink, ctx)[0] == []
