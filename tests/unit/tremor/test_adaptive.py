"""The adaptive filter: its design against direct integrals, its learning against batch least squares, its manners."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from firmware_py.tremor.adaptive_design import (
    bank_of,
    block_response,
    design_adaptive,
    sensor_response,
    solve_scaled,
    target_taps,
)
from firmware_py.tremor.config import AdaptiveConfig, TremorConfig
from firmware_py.tremor.estimator import Estimator, peek
from hal.errors import BenchError
from tests.unit.tremor.compare import HELD_OUT, residuals
from tests.unit.tremor.synthetic import CUTOFF_RAD_S, RATE_HZ, make_record, rc_filter, residual_percent


def tone_acceleration(hz: float, size: float, n: int, bias: float = 0.0) -> np.ndarray:
    w, t = 2 * np.pi * hz, np.arange(n) / RATE_HZ
    rc = CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
    return np.real(-(w**2) * size * rc * np.exp(1j * w * t)) + bias


def test_bank_response_is_what_the_recursion_does() -> None:
    bank = bank_of(AdaptiveConfig(), RATE_HZ)
    impulse = np.zeros(4000)
    impulse[0] = 1.0
    hz = np.array([3.0, 10.0])
    response = bank.response(np.exp(2j * np.pi * hz / RATE_HZ))
    pole = bank.pole[4]
    state = lfilter([1.0 - abs(pole)], [1.0, -pole], impulse.astype(complex))
    turning = np.exp(-2j * np.pi * hz[:, None] * np.arange(4000) / RATE_HZ)
    np.testing.assert_allclose(turning @ state.real, response[8], atol=1e-6)
    np.testing.assert_allclose(turning @ state.imag, response[9], atol=1e-6)


@pytest.mark.parametrize(("hz", "error"), [(6.0, 0.07), (8.0, 0.04), (9.3, 0.025), (12.0, 0.015)])
def test_the_target_is_the_displacement_some_blocks_ago(hz: float, error: float) -> None:
    """Gain 1 and no phase at the centre tap, for a tone in the band, sensor and double integration undone.

    ``error`` is what the window leaves (docstring of ``target_taps``), not what one would wish.
    """
    config = TremorConfig()
    taps = target_taps(config, 10, 0.002)
    f = np.array([hz])
    half = len(taps) // 2
    delays = np.exp(-2j * np.pi * hz * 0.01 * (np.arange(len(taps)) - half))
    total = (taps @ delays) * block_response(f, 10, RATE_HZ)[0] * sensor_response(config, f)[0]
    assert abs(total * np.exp(-2j * np.pi * hz * 0.002) - 1.0) < error


def test_voluntary_motion_and_bias_are_outside_the_target() -> None:
    config = TremorConfig()
    taps = target_taps(config, 10, 0.0)
    for hz in (0.01, 0.3, 1.0):
        delays = np.exp(-2j * np.pi * hz * 0.01 * np.arange(len(taps)))
        assert abs(taps @ delays * sensor_response(config, np.array([hz]))[0]) < 0.003


def test_the_prior_filter_is_the_wiener_filter_of_its_hand() -> None:
    """No other filter over the same bank has a smaller error: the gradient of the error vanishes."""
    d = design_adaptive(TremorConfig())
    rng = np.random.default_rng(0)
    gram = rng.standard_normal((6, 6))
    spd = gram @ gram.T + np.diag(10.0 ** np.arange(-6, 6, 2))
    right = rng.standard_normal((2, 6))
    np.testing.assert_allclose(solve_scaled(spd, right) @ spd, right, rtol=1e-4, atol=1e-6)
    assert np.all(np.linalg.eigvalsh(d.rest) > -1e-12 * np.linalg.norm(d.rest))
    # a steady tone in the middle of the band comes out nearly whole and in phase
    z = np.array([np.exp(2j * np.pi * 10.0 / RATE_HZ)])
    through = d.start[0] @ d.bank.response(z)[:, 0] * sensor_response(TremorConfig(), np.array([10.0]))[0]
    assert abs(through - 1.0) < 0.15


@pytest.mark.parametrize("kind", ["one tone", "two tones", "band noise"])
def test_it_beats_every_fixed_filter_on_held_out_hands(kind: str) -> None:
    seeds = list(HELD_OUT)[:3]
    assert np.mean(residuals("adaptive", 2, kind, seeds, 14.0)) < np.mean(residuals("kalman", 2, kind, seeds, 14.0))


def test_a_steady_tone_is_learned_as_well_as_its_target_says() -> None:
    n, size = 12_000, 20e-6
    acceleration = tone_acceleration(10.7, size, n, bias=0.02)
    ahead = Estimator(TremorConfig(loop_delay_s=0.004), axes=1).run(acceleration[:, None]).ahead_m[:, 0]
    true = size * np.cos(2 * np.pi * 10.7 * (np.arange(n) / RATE_HZ + 0.004))
    assert np.max(np.abs(ahead[-1000:] - true[-1000:])) < 0.025 * size


@pytest.mark.parametrize("rms_m", [5e-6, 500e-6])
def test_one_setting_serves_small_and_large_tremor(rms_m: float) -> None:
    record = make_record(104, "two tones", 12.0, rms_m=rms_m)
    ahead = Estimator(TremorConfig(), axes=1).run(record.acceleration[:, None]).ahead_m[:, 0]
    assert residual_percent(record.tremor, ahead, 2) < (30.0 if rms_m < 1e-5 else 8.0)


def test_a_bias_that_grows_does_not_capture_it() -> None:
    """000, 5.2.2: 5 mg in 10 s, then a step of 20 mg, under 20 um of tremor."""
    n, size = 12_000, 20e-6
    t = np.arange(n) / RATE_HZ
    drift = rc_filter(np.minimum(0.005 * 9.81 * t, 0.05) + 0.2 * (t > 10.5))
    acceleration = tone_acceleration(9.4, size, n) + drift
    result = Estimator(TremorConfig(), axes=1).run(acceleration[:, None])
    true = size * np.cos(2 * np.pi * 9.4 * t)
    error = result.now_m[:, 0] - true
    assert np.std(error[8000:10_400]) < 0.03 * np.std(true)
    assert np.std(error[11_200:]) < 0.15 * np.std(true)
    assert result.frequency_hz[-1, 0] == pytest.approx(9.4, abs=0.1)


def test_voluntary_motion_below_one_hertz_is_kept() -> None:
    """A movement of 1 mm at 0.8 Hz beside the tremor: less than one percent of it is taken for tremor."""
    n = 14_000
    t = np.arange(n) / RATE_HZ
    w = 2 * np.pi * 0.8
    lag = CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
    slow = np.real(-(w**2) * 1e-3 * lag * np.exp(1j * w * t))
    ahead = Estimator(TremorConfig(), axes=1).run((tone_acceleration(10.0, 25e-6, n) + slow)[:, None]).ahead_m[:, 0]
    tail = slice(-5000, None)  # four whole periods
    taken = 2 * np.mean(ahead[tail] * np.exp(-1j * w * t[tail]))
    assert abs(taken) < 0.01 * 1e-3


def test_learning_is_least_squares_with_the_prior() -> None:
    """After a run the filter of an axis solves the normal equations that the state holds."""
    config = TremorConfig(adaptive=AdaptiveConfig(share=0.0))
    record = make_record(3, "one tone", 6.0)
    estimator = Estimator(config, axes=1)
    estimator.run(record.acceleration[:, None])
    state, param = peek(estimator.state).adaptive, peek(estimator.params).adaptive
    before = np.array(state.filter[0])
    count, n0 = state.count[0], param.prior_blocks
    power = (state.power[0] + n0 * param.weighted_power - count * param.noise_power) / (count + n0)
    normal = np.tril(state.normal[0]) + np.tril(state.normal[0], -1).T
    matrix = normal + n0 * (power * param.tremor + param.rest)
    right = state.right[0] - count * param.noise_cross + n0 * power * param.cross
    direct = solve_scaled(matrix, np.asarray(right))
    # the last solution is at most two blocks old
    np.testing.assert_allclose(before @ matrix, direct @ matrix, rtol=0.05, atol=0.02 * np.abs(right).max())


def test_edges_out_of_order_are_refused() -> None:
    with pytest.raises(BenchError, match="cancel_from_hz"):
        TremorConfig.from_dict({"adaptive": {"cancel_from_hz": [6.0, 4.0]}})
