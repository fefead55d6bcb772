"""The oscillator filter: its design against the plain Kalman recursion, its prediction against the tremor."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.linalg import expm

from firmware_py.tremor.config import TremorConfig
from tests.unit.tremor.compare import HELD_OUT, predictions, residuals
from tests.unit.tremor.synthetic import CUTOFF_RAD_S, KINDS, RATE_HZ
from tools.research.tremor.baselines.oscillator_kalman import (
    KalmanConfig,
    _mode,
    combine,
    design_oscillators,
    kalman_correct,
    kalman_numbers,
    kalman_predict,
)


@numba.njit
def euler_model(white, k, substeps):  # type: ignore[no-untyped-def]
    stiffness, damping, forget, cutoff, dt = k
    n = len(white) // substeps
    acceleration, tremor = np.empty(n), np.empty(n)
    x = v = u = w = drift = rc = 0.0
    for i in range(len(white)):
        a = -stiffness * x - damping * v + u
        rc += cutoff * (a + drift + white[i, 1] - rc) * dt
        drift += (-forget * drift + white[i, 2]) * dt
        w += (-stiffness * u - damping * w + white[i, 0]) * dt
        u += w * dt
        v += a * dt
        x += v * dt
        if (i + 1) % substeps == 0:
            acceleration[i // substeps], tremor[i // substeps] = rc, x
    return acceleration, tremor


@pytest.fixture(scope="module")
def config() -> TremorConfig:
    return TremorConfig(loop_delay_s=0.004, own={"frequencies_hz": (9.0, 11.0), "bandwidth_hz": 1.0})


def test_the_filter_is_stable_and_its_rows_are_its_models(config: TremorConfig) -> None:
    model = design_oscillators(config)
    closed = model.transition - np.outer(model.gain, model.observe @ model.transition)
    assert np.max(np.abs(np.linalg.eigvals(closed))) < 1.0
    # coasting four ticks from any state is the prediction over 4 ms
    four = np.linalg.matrix_power(model.transition, 4)
    np.testing.assert_allclose(model.now @ four, model.ahead, rtol=1e-6, atol=1e-9 * np.abs(model.ahead).max())


def test_the_error_is_what_the_design_promises() -> None:
    """On a signal that is exactly the model, made by small Euler steps: what the Riccati equation promised."""
    own = {"frequencies_hz": (10.0,), "bandwidth_hz": 2.0}
    k, config = KalmanConfig.model_validate(own), TremorConfig(own=own)
    substeps, n = 10, 30_000
    dt = 1e-3 / substeps
    rng = np.random.default_rng(4)
    white = rng.standard_normal((n * substeps, 3)) / np.sqrt(dt)
    _, q = _mode(10.0, 2.0, k.tremor_rms_m**2)
    acceleration, tremor = euler_model(
        white * [np.sqrt(q[3, 3]), k.sensor_noise_m_s2_rtHz / np.sqrt(2), k.drift_m_s2 * np.sqrt(2 / k.drift_s)],
        np.array([(2 * np.pi * 10.0) ** 2, 2 * np.pi * 2.0, 1.0 / k.drift_s, CUTOFF_RAD_S, dt]),
        substeps,
    )
    acceleration += k.reading_noise_m_s2 * rng.standard_normal(n)
    model = design_oscillators(config)
    state, now = np.zeros(len(model.gain)), np.empty(n)
    for i, y in enumerate(acceleration):
        state = model.transition @ state
        state = state + model.gain * (y - model.observe @ state)
        now[i] = model.now @ state
    assert np.std(tremor[2000:]) == pytest.approx(k.tremor_rms_m, rel=0.25)
    assert np.std((tremor - now)[2000:]) == pytest.approx(model.error_rms_m, rel=0.1)


@pytest.mark.parametrize("delay_s", [0.0, 0.004, 0.012])
def test_a_steady_tone_comes_out_with_its_amplitude_and_phase(delay_s: float) -> None:
    w, size = 2 * np.pi * 10.0, 20e-6
    t = np.arange(8000) / RATE_HZ
    rc = CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
    acceleration = np.real(-(w**2) * size * rc * np.exp(1j * w * t)) + 0.02
    ahead = predictions(TremorConfig(method="kalman", loop_delay_s=delay_s), np.stack([acceleration] * 3, axis=1))
    true = size * np.cos(w * (t + delay_s))
    assert np.max(np.abs(ahead[-1000:, 1] - true[-1000:])) < 0.1 * size


@pytest.mark.parametrize("kind", KINDS)
def test_residual_on_held_out_hands(kind: str) -> None:
    """Seeds that no setting was tuned on; the bar of the instrument is 50 %."""
    seeds = list(HELD_OUT)[:3]
    kalman = residuals("kalman", 8, kind, seeds, 12.0)
    assert np.max(kalman) < 20.0
    if kind != "one tone":  # the case that the combiner is made for
        assert np.mean(kalman) < 0.8 * np.mean(residuals("wflc_flc", 8, kind, seeds, 12.0))


def test_voluntary_motion_passes() -> None:
    """A 1 Hz movement of 1 mm is left alone to better than one percent."""
    t = np.arange(10_000) / RATE_HZ
    w = 2 * np.pi
    acceleration = np.stack([-(w**2) * 1e-3 * np.sin(w * t)] * 3, axis=1)
    ahead = predictions(TremorConfig(method="kalman"), acceleration)
    assert np.max(np.abs(ahead[5000:])) < 0.01 * 1e-3


def test_kernels_are_the_matrix_filter(config: TremorConfig) -> None:
    model, numbers = design_oscillators(config), kalman_numbers(config)
    rng = np.random.default_rng(2)
    state = rng.standard_normal(len(model.gain))
    twin, plain = state.copy(), state.copy()
    for y in rng.standard_normal(20):
        kalman_predict(state, numbers)
        kalman_correct(state, y, numbers)
        kalman_predict.py_func(twin, numbers)  # type: ignore[attr-defined]
        kalman_correct.py_func(twin, y, numbers)  # type: ignore[attr-defined]
        plain = model.transition @ plain
        plain = plain + model.gain * (y - model.observe @ plain)
    np.testing.assert_allclose(state, plain, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(twin, state, rtol=1e-12, atol=1e-12)
    assert combine(state, model.ahead) == pytest.approx(model.ahead @ plain, abs=1e-15)


def test_mode_variance_is_what_was_asked_for() -> None:
    """Propagating the noise of the continuous model to its stationary state gives tremor_rms_m."""
    a, q = _mode(10.0, 1.0, (14e-6) ** 2)
    dt, covariance = 1e-3, np.zeros((4, 4))
    f = expm(a * dt)
    for _ in range(6000):
        covariance = f @ covariance @ f.T + q * dt
    assert np.sqrt(covariance[0, 0]) == pytest.approx(14e-6, rel=0.01)
