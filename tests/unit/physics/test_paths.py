"""Filters, delays, limits and grids against closed forms and independent simulations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lsim

from hal.arrays import Array
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.curve import curve_basis
from sim_devices.physics.dropped_samples import best_shifts, find_drops, shift_by, shift_costs
from sim_devices.physics.effect import Context
from sim_devices.physics.exponential import exponential
from sim_devices.physics.lag import low_pass
from sim_devices.physics.quantization import find_lumps, find_step, mean_of_steps
from sim_devices.physics.resampling import delay_by_correlation, resample, resample_straight
from sim_devices.physics.resonance import discrete_mode, mode
from sim_devices.physics.saturation import limit
from sim_devices.physics.slew import slew

ONE = np.zeros(1, np.int64)
DT = 1e-3


def wave(n: int = 3000) -> tuple[Array, Array]:
    t = np.arange(n) * DT
    return t, np.sin(2 * np.pi * 3 * t) + 0.4 * np.sin(2 * np.pi * 11.3 * t + 1)


def apply(name: str, x: Array, q: list[float], dt: float = DT) -> Array:
    effect = EFFECTS[name]
    assert effect.apply is not None
    t = np.arange(x.size) * dt
    return effect.apply(x, Context(t, dt, {}, "y"), np.array(q), {})


def test_lag_against_lsim() -> None:
    t, x = wave()
    _, y, _ = lsim(([1.0], [0.02, 1.0]), x - x[0], t)
    np.testing.assert_allclose(low_pass(x, DT, 0.02, ONE), y + x[0], atol=1e-9)


def test_resonance_against_lsim() -> None:
    t, x = wave()
    w, d = 2 * np.pi * 25.0, 0.1
    _, y, _ = lsim(([w * w], [1.0, 2 * d * w, w * w]), x - x[0], t)
    np.testing.assert_allclose(apply("resonance", x, [25.0, d, 1.0, 0.0]), y + x[0], atol=1e-8)
    _, v, _ = lsim(([w, 0.0], [1.0, 2 * d * w, w * w]), x - x[0], t)
    got = apply("resonance", x, [25.0, d, 0.0, 1.0]) - x
    np.testing.assert_allclose(got, v, atol=1e-8)


def test_ac_coupling_against_lsim() -> None:
    t, x = wave()
    _, y, _ = lsim(([0.3, 0.0], [0.3, 1.0]), x + 2.0, t)
    # from rest at zero: nothing settled
    np.testing.assert_allclose(apply("ac_coupling", x + 2.0, [0.3, 0.0])[5:], y[5:], atol=1e-6)


@pytest.mark.parametrize("damping", [0.4, 1.0, 2.5])
def test_ac_coupling_of_second_order_against_lsim(damping: float) -> None:
    t, x = wave()
    twice = EFFECTS["ac_coupling"].variants[0]
    tau = 0.2
    _, y, _ = lsim(([tau * tau, 0.0, 0.0], [tau * tau, 2 * damping * tau, 1.0]), x + 2.0, t)
    assert twice.apply is not None
    got = twice.apply(x + 2.0, Context(t, DT, {}, "y"), np.array([tau, damping, 0.0]), {})
    np.testing.assert_allclose(got, y, atol=1e-6)
    # settled on a constant: nothing of it passes
    still = twice.apply(np.full(t.size, 3.0), Context(t, DT, {}, "y"), np.array([tau, damping, 1.0]), {})
    np.testing.assert_allclose(still, 0.0, atol=1e-9)


def test_a_clock_that_drifts_reads_where_it_says() -> None:
    t = np.arange(4000) * DT
    drifting = EFFECTS["clock_skew"].variants[1]
    assert drifting.apply is not None
    got = drifting.apply(np.sin(2 * np.pi * 3 * t), Context(t, DT, {}, "y"), np.array([-2000.0, 3000.0]), {})
    late = t - 2e-3 * t + 0.5 * 3e-3 * t * t / (DT * t.size)
    np.testing.assert_allclose(got[2:-20], np.sin(2 * np.pi * 3 * late[2:-20]), atol=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01234])
def test_delay_of_a_sine(delay: float) -> None:
    t = np.arange(2000) * DT
    y = apply("dead_time", np.sin(2 * np.pi * 4 * t), [delay])
    np.testing.assert_allclose(y[30:], np.sin(2 * np.pi * 4 * (t[30:] - delay)), atol=2e-6)


def test_delay_is_found() -> None:
    _, x = wave()
    late = resample(x, -37.4, 1.0, 0.0)
    assert delay_by_correlation(x, late, 200) == pytest.approx(37.4, abs=0.1)


def test_skew_of_a_sine() -> None:
    t = np.arange(5000) * DT
    y = apply("clock_skew", np.sin(2 * np.pi * 2 * t), [400.0])
    np.testing.assert_allclose(y[5:-10], np.sin(2 * np.pi * 2 * t * 1.0004)[5:-10], atol=1e-6)


def test_lost_and_repeated_samples_are_found() -> None:
    rng = np.random.default_rng(1)
    x = np.convolve(rng.standard_normal(8000), np.hanning(25), "same")
    index = np.concatenate([np.arange(2500), np.arange(2507, 6000), np.repeat(6000, 4), np.arange(6000, 7990)])
    y = x[index]
    at, total, share, _ = find_drops(x[: y.size], y + 0.01 * rng.standard_normal(y.size))
    assert total == [7, 3]
    assert abs(at[0] - 2500) <= 2
    assert abs(at[1] - 5997) <= 3
    assert share > 0.99
    np.testing.assert_allclose(shift_by(x, np.array(at), np.array(total))[3000:5900], y[3000:5900])


def test_hard_and_soft_limits() -> None:
    x = np.linspace(-3, 3, 601)
    np.testing.assert_array_equal(limit(x, -1.0, 2.0, 0.0), np.clip(x, -1.0, 2.0))
    soft = limit(x, -1.0, 2.0, 0.1)
    assert np.all((soft > -1.0) & (soft < 2.0))
    assert np.max(np.abs(soft - np.clip(x, -1.0, 2.0))) == pytest.approx(0.1 * np.log(2), rel=1e-2)
    assert np.all(np.diff(soft) > 0)


def test_slew_of_a_step() -> None:
    x = np.concatenate([np.zeros(1), np.ones(50)])
    y = slew(x, (0.05, 0.1), 1.0, ONE, 1, False)
    np.testing.assert_allclose(y, np.minimum(0.1 * np.arange(51), 1.0), atol=1e-12)
    back = slew(-x, (0.05, 0.1), 1.0, ONE, 1, False)
    np.testing.assert_allclose(back, -np.minimum(0.05 * np.arange(51), 1.0), atol=1e-12)


def test_a_sine_far_beyond_the_slew_limit_becomes_a_triangle() -> None:
    t = np.arange(40_000) * DT
    frequency, rate = 71.3, 40.0  # 14 samples a period: most turns lie between samples
    effect = EFFECTS["slew_limit"]
    assert effect.apply is not None
    y = effect.apply(np.sin(2 * np.pi * frequency * t), Context(t, DT, {}, "y"), np.array([rate, 1e-7]), {})
    peak = rate / (4 * frequency)
    assert np.sqrt(3.0) * np.std(y[4000:]) == pytest.approx(peak, rel=2e-3)


def test_a_rounded_slew_limit_against_an_ode_solver() -> None:
    t = np.arange(600) * DT
    rate, lag = 40.0, 0.004
    x = np.sin(2 * np.pi * 13.7 * t)

    def slope(s: float, y: Array) -> Array:
        return rate * np.tanh((np.interp(s, t, x) - y) / (rate * lag))

    want = solve_ivp(slope, (0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=DT).y[0]
    effect = EFFECTS["slew_limit"].variants[1]
    assert effect.apply is not None
    got = effect.apply(x, Context(t, DT, {}, "y"), np.array([rate, lag]), {})
    np.testing.assert_allclose(got, want, atol=5e-3 * np.ptp(want))


def test_quantiser_mean_against_monte_carlo() -> None:
    rng = np.random.default_rng(0)
    x = np.linspace(0, 3, 40)
    for dither in (0.1, 0.3):
        sampled = np.mean(np.round(x + dither * rng.standard_normal((40_000, 40))), axis=0)
        np.testing.assert_allclose(mean_of_steps(x, 1.0, 0.0, dither), sampled, atol=0.012)


def test_grid_is_found_and_noise_has_none() -> None:
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.standard_normal(4000))
    assert find_step(0.25 * np.round(x / 0.25) + 0.1) == pytest.approx(0.25, rel=1e-9)
    assert find_step(x) == 0.0
    coarse = np.round(200 * x / np.ptp(x))
    assert find_step(0.07 * np.round(coarse / 0.07)) == pytest.approx(1.0, rel=1e-4)  # a finer grid over it


@pytest.mark.parametrize("noise", [0.025, 0.006])
def test_a_grid_is_found_under_noise_that_came_after_the_rounding(noise: float) -> None:
    rng = np.random.default_rng(1)
    x = 5.0 * np.sin(np.arange(4000) * 0.013) + np.sin(np.arange(4000) * 0.11)
    late = noise * rng.standard_normal(4000)
    y = 0.1 + 0.25 * np.round((x - 0.1) / 0.25) + late
    step, origin, p = find_lumps(y, x, float(np.std(y - x)))
    assert step == pytest.approx(0.25, rel=1e-3)
    assert (origin - 0.1) / 0.25 == pytest.approx(np.round((origin - 0.1) / 0.25), abs=0.02)
    assert p < 1e-12
    plain = x + 0.08 * rng.standard_normal(4000)
    assert find_lumps(plain, x, 0.08)[2] == 1.0
    # a few levels that are held lie on many a grid
    held = np.repeat(rng.uniform(-5, 5, 14), 300)
    off = held + np.repeat(rng.uniform(-0.2, 0.2, 14), 300)
    assert find_lumps(off, held, float(np.std(off - held)))[2] > 1e-7


def test_curves_have_no_offset_line_inside_and_tangents_outside() -> None:
    x = np.linspace(-2, 6, 401)
    cols = curve_basis(x, 0.0, 4.0, 3)
    z = (x - 2) / 2
    inside = np.abs(z) <= 1
    np.testing.assert_allclose(cols[inside, 0], (3 * z[inside] ** 2 - 1) / 2, atol=1e-12)
    beyond = z > 1
    np.testing.assert_allclose(cols[beyond, 0], 1 + 3 * (z[beyond] - 1), atol=1e-12)


@pytest.mark.parametrize(
    ("kernel", "args"),
    [
        (low_pass, (DT, 0.01, np.array([0, 70]))),
        (mode, (*(np.ascontiguousarray(m) for m in discrete_mode(30.0, 0.2, DT)), np.array([0, 70]))),
        (limit, (-0.5, 0.7, 0.05)),
        (slew, ((0.02, 0.03), 0.5, np.array([0, 70]), 3, True)),
        (resample, (-3.3, 1.001, 1e-5)),
        (shift_by, (np.array([20, 90]), np.array([3, -1]))),
    ],
    ids=["low_pass", "mode", "limit", "slew", "resample", "shift_by"],
)
def test_compiled_equals_python(kernel: Callable[..., Array], args: tuple[object, ...]) -> None:
    x = wave(150)[1]
    np.testing.assert_allclose(kernel(x, *args), kernel.py_func(x, *args), atol=1e-13)  # pyright: ignore


def test_exponential_against_scipy() -> None:
    rng = np.random.default_rng(0)
    for size, scale in ((2, 1e-3), (4, 1.0), (6, 5.0)):
        m = scale * rng.standard_normal((size, size))
        np.testing.assert_allclose(exponential(m), expm(m), rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(exponential.py_func(m), expm(m), rtol=1e-11, atol=1e-13)


def test_cheapest_path_compiled_equals_python() -> None:
    costs = np.random.default_rng(2).random((12, 5))
    a, b = best_shifts(costs, 0.4, 2), best_shifts.py_func(costs, 0.4, 2)
    np.testing.assert_array_equal(a[0], b[0])
    assert a[1] == pytest.approx(b[1])


def test_shift_costs_equal_python() -> None:
    rng = np.random.default_rng(5)
    x, y = rng.standard_normal(90), rng.standard_normal(90)
    shifts = np.array([-7, 0, 3])
    d = y[20:40] - x[23:43]
    for local, least in ((True, float(np.sum((d - d.mean()) ** 2))), (False, float(np.sum(d**2)))):
        costs = shift_costs(x, y, 20, shifts, local)
        np.testing.assert_allclose(costs, shift_costs.py_func(x, y, 20, shifts, local), atol=1e-12)
        assert costs[1, 2] == pytest.approx(least)


def test_straight_resampling_equals_python_and_interpolation() -> None:
    x = np.random.default_rng(9).standard_normal(80)
    found = resample_straight(x, -1.3, 1.01, 1e-4)
    np.testing.assert_allclose(found, resample_straight.py_func(x, -1.3, 1.01, 1e-4), atol=1e-12)
    k = np.arange(80)
    np.testing.assert_allclose(found, np.interp(-1.3 + (1.01 + 1e-4 * k) * k, k, x), atol=1e-12)


def test_a_shift_from_the_first_window_on_is_paid_like_any_other() -> None:
    """Two shifts over three windows: the first window alone would choose the other one, for less than a change."""
    costs = np.array([[0.3, 0.0], [0.0, 1.0], [0.0, 1.0]])
    path, left = best_shifts(costs, 0.4, 0)
    assert (path.tolist(), left) == ([0, 0, 0], pytest.approx(0.3))
    path, left = best_shifts(costs, 0.1, 0)
    assert (path.tolist(), left) == ([1, 0, 0], pytest.approx(0.2))
