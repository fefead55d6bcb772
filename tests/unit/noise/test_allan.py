"""Allan deviation against closed forms, against allantools, and the identified coefficients."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from tools.noise.allan import FLAT, allan_curve, identify, octave_factors, overlapping_variance, slope

RATE = 100.0


def processes(n: int, seed: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    return {
        "white": 0.02 * rng.standard_normal(n) * np.sqrt(RATE),
        "walk": 0.001 * np.cumsum(rng.standard_normal(n)) / np.sqrt(RATE),
        "ramp": 1e-4 * t,
    }


def test_a_ramp_is_exact() -> None:
    curve = allan_curve(processes(5000)["ramp"], RATE)
    np.testing.assert_allclose(curve.deviation, 1e-4 * curve.tau_s / np.sqrt(2.0), rtol=1e-7)


def test_white_noise_and_random_walk_have_their_closed_forms() -> None:
    data = processes(200_000)
    white = allan_curve(data["white"], RATE)
    sure = white.freedom > 100
    z = (white.deviation[sure] / (0.02 / np.sqrt(white.tau_s[sure])) - 1) * np.sqrt(2 * white.freedom[sure])
    assert np.max(np.abs(z)) < 4.0
    walk = allan_curve(data["walk"], RATE)
    # sampled walk: K^2 tau / 3 (1 + 1 / (2 m^2))
    m = walk.tau_s * RATE
    expected = 0.001 * np.sqrt(walk.tau_s / 3.0 * (1.0 + 0.5 / m**2))
    sure = walk.freedom > 100
    z = (walk.deviation[sure] / expected[sure] - 1) * np.sqrt(2 * walk.freedom[sure])
    assert np.max(np.abs(z)) < 4.0


def test_equal_to_allantools() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        allantools = pytest.importorskip("allantools")
        data = processes(20_001)
        signal = data["white"] + data["walk"] + data["ramp"]
        curve = allan_curve(signal, RATE)
        taus, theirs, *_ = allantools.oadev(signal - signal.mean(), rate=RATE, data_type="freq", taus=curve.tau_s[:-1])
    np.testing.assert_allclose(curve.tau_s[: len(taus)], taus, rtol=1e-12)
    np.testing.assert_allclose(curve.deviation[: len(taus)], theirs, rtol=1e-12)


def test_the_coefficients_come_back_inside_their_intervals() -> None:
    inside = 0
    for seed in range(4):
        data = processes(30_000, seed)
        model = identify(allan_curve(data["white"] + 5.0 * data["walk"], RATE))
        inside += model.white.low <= 0.02 <= model.white.high and model.walk.low <= 0.005 <= model.walk.high
        assert model.white.value == pytest.approx(0.02, rel=0.02)
        assert model.walk.value == pytest.approx(0.005, rel=0.4)
        assert model.ramp.high < 2e-3
    assert inside >= 3


def test_averages_that_a_filter_bends_are_left_out() -> None:
    """White noise behind a low-pass of 30 ms: short averages have less of it than N / sqrt(tau)."""
    n = 60_000
    smooth = np.exp(-1.0 / (0.03 * RATE))
    noise = processes(n)["white"]
    signal = lfilter([1.0 - smooth], [1.0, -smooth], noise)
    model = identify(allan_curve(signal, RATE))
    assert model.shortest_s >= 0.15
    assert model.white.value == pytest.approx(0.02, rel=0.03)
    forced = identify(allan_curve(signal, RATE), 0.0)
    assert forced.shortest_s == 0.01
    assert forced.excess > 0.02
    # what the terms miss is in the interval
    assert forced.white.high - forced.white.low > 0.1 * forced.white.value


def test_the_flat_part_is_read_over_0_664() -> None:
    """Erratum 34; a curve made from the model itself."""
    from tools.noise.allan import AllanCurve

    tau = 2.0 ** np.arange(-6, 12)
    variance = 0.01**2 / tau + FLAT * 0.004**2 + 0.0003**2 * tau / 3 + 1e-6**2 * tau**2 / 2
    sigma = np.sqrt(variance)
    model = identify(AllanCurve(tau, sigma, sigma, sigma, np.full(len(tau), 1e9), 1 << 19, 2.0**-6))
    assert np.sqrt(FLAT) == pytest.approx(0.664, abs=5e-4)
    for name, value in (("white", 0.01), ("flicker", 0.004), ("walk", 0.0003), ("ramp", 1e-6)):
        assert getattr(model, name).value == pytest.approx(value, rel=1e-3), name


def test_the_interval_covers() -> None:
    inside = []
    for seed in range(40):
        curve = allan_curve(processes(4000, seed)["white"], RATE)
        truth = 0.02 / np.sqrt(curve.tau_s[4])
        inside.append(curve.low[4] <= truth <= curve.high[4])
    assert 0.85 <= np.mean(inside) <= 1.0


def test_slopes_of_the_three_kinds() -> None:
    data = processes(100_000)
    assert slope(allan_curve(data["white"], RATE), 0.1, 30) == pytest.approx(-0.5, abs=0.05)
    assert slope(allan_curve(data["walk"], RATE), 0.1, 30) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("signal", "message"),
    [(np.zeros(4), "at least 8"), (np.full(20, 2.5), "never changes"), (np.array([1.0] * 9 + [np.nan]), "not finite")],
)
def test_bad_signals_are_refused(signal: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        allan_curve(signal, RATE)


def test_kernel_and_python_agree() -> None:
    phase = np.cumsum(np.random.default_rng(0).standard_normal(300))
    factors = octave_factors(299)
    a, b = np.empty(len(factors)), np.empty(len(factors))
    overlapping_variance(phase, factors, 0.01, a)
    overlapping_variance.py_func(phase, factors, 0.01, b)
    np.testing.assert_allclose(a, b, rtol=1e-12)
