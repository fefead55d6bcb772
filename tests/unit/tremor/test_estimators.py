"""Every method behind the one interface: tones, sizes, horizons, holes, steps against batches."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.biquads import cascade_response
from firmware_py.tremor.config import METHODS, Method, TremorConfig
from firmware_py.tremor.estimator import ROWS, Estimator, run_estimator
from firmware_py.tremor.prefilter import prefilter_gain, prefilter_sections
from firmware_py.tremor.sensor_model import invert_sensor, sensor_params
from tests.unit.allocations import allocations
from tests.unit.tremor.estimator_state import peek, unfiltered
from tests.unit.tremor.synthetic import CUTOFF_RAD_S, RATE_HZ
from tests.unit.tremor.test_adaptive import tone_acceleration
from tools.research.tremor.baselines import BASELINES
from tools.research.tremor.baselines.ar_kalman import chain_gain_and_lag, horizons
from tools.research.tremor.baselines.bmflc import BmflcConfig, comb_size

EVERY = (*METHODS, *BASELINES)
# how far a method may be off on a steady tone at 10 Hz, share of its amplitude: LMS keeps a ripple, a short memory
# does not reach the whole, and the adaptive filter allows for sensor noise that is not there
TONE_ERROR: dict[Method, float] = {
    "adaptive": 0.07,
    "kalman": 0.1,
    "wflc_flc": 0.01,
    "flc": 0.01,
    "wflc": 0.06,
    "bmflc": 0.05,
    "ebmflc": 0.4,
    "bmflc_kalman": 0.02,
    "ar_kalman": 0.05,
}


@pytest.mark.parametrize("size", [5e-6, 500e-6])
@pytest.mark.parametrize("method", EVERY)
def test_a_tone_is_predicted_whatever_its_size(method: Method, size: float) -> None:
    n, delay = 12_000, 0.004
    config = TremorConfig(method=method, loop_delay_s=delay)
    result = Estimator(config, axes=1).run(tone_acceleration(10.0, size, n)[:, None])
    true = size * np.cos(2 * np.pi * 10.0 * (np.arange(n) / RATE_HZ + delay))
    assert np.max(np.abs(result.ahead_m[-1000:, 0] - true[-1000:])) < TONE_ERROR[method] * size
    assert result.frequency_hz[-1, 0] == pytest.approx(10.0, abs=0.02)
    assert result.amplitude_m[-1, 0] == pytest.approx(size, rel=0.2)
    assert result.confidence[-1, 0] > 0.8


@pytest.mark.parametrize("method", EVERY)
def test_a_step_allocates_nothing(method: Method) -> None:
    """A call from Python wraps its arrays: one tick and eight hundred, with a hole in them, ask for the same."""
    estimator = Estimator(TremorConfig(method=method))
    samples = np.tile(tone_acceleration(10.0, 50e-6, 2000)[:, None], 3)
    samples[1500:1520] = np.nan
    out = np.empty((len(samples), ROWS, 3))
    run_estimator(samples[:1199], out[:1199], estimator.state, estimator.params)
    asked = []
    for part in (slice(1199, 1200), slice(1200, 2000)):
        before = allocations()
        run_estimator(samples[part], out[part], estimator.state, estimator.params)
        asked.append(allocations() - before)
    assert asked[0] == asked[1]


@pytest.mark.parametrize("method", [m for m in EVERY if m != "kalman"])
def test_displacement_with_voluntary_motion(method: Method) -> None:
    """Seen by a displacement sensor; the intended path is what is left, nothing of it below 1 Hz is taken."""
    n = 12_000
    t = np.arange(n) / RATE_HZ
    slow = 300e-6 * np.sin(2 * np.pi * 0.5 * t)
    tremor = 25e-6 * np.cos(2 * np.pi * 10.0 * t)
    config = unfiltered(TremorConfig(method=method, loop_delay_s=0.002))
    result = Estimator(config, axes=1).run((slow + tremor)[:, None])
    tail = slice(-4000, None)
    kept = 2 * np.mean(result.intended_m[tail, 0] * np.exp(-2j * np.pi * 0.5 * t[tail])) * 1j
    assert abs(kept / 300e-6 - 1.0) < 0.01
    left = 2 * np.mean(result.intended_m[tail, 0] * np.exp(-2j * np.pi * 10.0 * t[tail]))
    assert abs(left) < 0.3 * 25e-6


@pytest.mark.parametrize("method", EVERY)
def test_steps_are_the_batch_and_holes_are_coasted_over(method: Method) -> None:
    samples = np.stack([tone_acceleration(hz, 20e-6, 400) for hz in (9.0, 10.0, 11.0)], axis=1)
    samples[200:205] = np.nan
    config = TremorConfig(method=method, settle_s=0.1)
    one, many = Estimator(config), Estimator(config)
    batch = many.run(samples)
    for k, sample in enumerate(samples):
        step = one.step(sample)
        assert np.array_equal(step.ahead_m, batch.ahead_m[k])
        assert np.array_equal(step.confidence, batch.confidence[k])
    assert np.all(np.isfinite(batch.ahead_m))
    many.reset()
    assert np.array_equal(many.run(samples).ahead_m, batch.ahead_m)


def test_the_wflc_is_not_trusted_before_it_is_locked() -> None:
    rng = np.random.default_rng(1)
    noise = 0.1 * rng.standard_normal((3000, 1))
    assert np.max(Estimator(TremorConfig(method="wflc_flc"), axes=1).run(noise).confidence[-500:]) < 0.7
    quiet = Estimator(TremorConfig(method="wflc"), axes=1)
    quiet.run(np.zeros((2000, 1)))
    assert peek(quiet.state).combiner[0].wflc.miss > 0.7


def test_sensor_factor_and_prefilter_gain_at_one_frequency() -> None:
    config = TremorConfig(loop_delay_s=0.003)
    hz = np.array([8.0, 11.0])
    sections = prefilter_sections(config.wflc, RATE_HZ)
    for f, expected in zip(hz, cascade_response(sections, hz, RATE_HZ), strict=True):
        w = 2 * np.pi * f
        assert prefilter_gain(sections, w / RATE_HZ) == pytest.approx(expected, rel=1e-9)
        seen = -(w**2) * CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
        assert invert_sensor(w, 0.003, sensor_params(config)[0]) == pytest.approx(np.exp(0.003j * w) / seen, rel=1e-9)


def test_horizon_is_filter_lag_and_loop_delay() -> None:
    config = TremorConfig(loop_delay_s=0.01)
    _, lag_s = chain_gain_and_lag(config)
    now, ahead = horizons(config)
    assert ahead - now == 10
    assert now == round(lag_s * RATE_HZ)
    assert 0.0 <= lag_s < 0.1


def test_the_comb_covers_its_band() -> None:
    assert comb_size(BmflcConfig()) == 13


def test_adaptive_band_follows_the_tremor() -> None:
    estimator = Estimator(TremorConfig(method="ebmflc"), axes=1)
    estimator.run(tone_acceleration(11.5, 20e-6, 12_000)[:, None])
    shift_hz = estimator.state["own"]["memory"][0, 0, 1] * RATE_HZ / (2 * np.pi)
    assert 0.5 < shift_hz <= 1.5 + 1e-9
