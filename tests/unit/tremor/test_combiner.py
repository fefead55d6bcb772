"""Prefilter, WFLC, FLC and their combination on signals whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, ellip, sosfilt, sosfreqz

from firmware_py.biquads import cascade_response, cascade_step
from firmware_py.records import attributes, new
from firmware_py.tremor.combiner import (
    combiner_displacement,
    combiner_params,
    combiner_state,
    combiner_step,
)
from firmware_py.tremor.config import TremorConfig, WflcConfig
from firmware_py.tremor.flc import flc_step
from firmware_py.tremor.prefilter import prefilter_sections
from firmware_py.tremor.wflc import WflcState, wflc_params, wflc_step
from tests.unit.tremor.synthetic import CUTOFF_RAD_S, RATE_HZ


def locked_frequency_hz(signal: np.ndarray, config: WflcConfig) -> float:
    """WFLC frequency after ``signal``, mean of the last second."""
    params = wflc_params(config, RATE_HZ)
    state = new(WflcState, omega=2 * np.pi * config.start_hz / RATE_HZ, miss=1.0)
    tail = []
    for s in signal:
        wflc_step(s, state[0], params[0])
        tail.append(state["omega"][0])
    return float(np.mean(tail[-1000:])) * RATE_HZ / (2 * np.pi)


def test_cascade_response_is_scipys() -> None:
    config = WflcConfig()
    sections = prefilter_sections(config, RATE_HZ)
    assert sections.shape == (3, 5)  # sixth order
    f = np.linspace(0.5, 100.0, 400)
    sos = ellip(3, config.ripple_dB, config.attenuation_dB, [7.0, 13.0], "bandpass", output="sos", fs=RATE_HZ)
    _, expected = sosfreqz(sos, worN=f, fs=RATE_HZ)
    np.testing.assert_allclose(cascade_response(sections, f, RATE_HZ), expected, rtol=1e-9, atol=1e-12)
    gain = np.abs(expected)
    assert np.all(gain[(f > 7.0) & (f < 13.0)] > 10 ** (-config.ripple_dB / 20) - 1e-6)


def test_a_butterworth_of_first_order_lets_all_pass_in_the_sections_it_does_not_need() -> None:
    config = WflcConfig(prefilter="butterworth", prefilter_order=1, low_hz=6.0, high_hz=14.0)
    sections = prefilter_sections(config, RATE_HZ)
    assert sections.shape == (3, 5)
    f = np.linspace(0.5, 100.0, 400)
    _, expected = sosfreqz(butter(1, [6.0, 14.0], "bandpass", output="sos", fs=RATE_HZ), worN=f, fs=RATE_HZ)
    np.testing.assert_allclose(cascade_response(sections, f, RATE_HZ), expected, rtol=1e-9, atol=1e-12)


def test_cascade_steps_as_scipy_filters() -> None:
    config = WflcConfig()
    sections = prefilter_sections(config, RATE_HZ)
    x = np.random.default_rng(0).standard_normal(500)
    memory = np.zeros((3, 2))
    ours = [cascade_step(v, memory, sections) for v in x]
    sos = np.insert(sections, 3, 1.0, axis=1)
    np.testing.assert_allclose(ours, sosfilt(sos, x), atol=1e-12)


@pytest.mark.parametrize("size", [5e-6, 500e-6])
@pytest.mark.parametrize("hz", [8.3, 11.7])
def test_wflc_locks_to_a_steady_tone_whatever_its_size(hz: float, size: float) -> None:
    t = np.arange(30_000) / RATE_HZ
    found = locked_frequency_hz(size * np.sin(2 * np.pi * hz * t + 0.7), WflcConfig(leakage=0.0))
    assert found == pytest.approx(hz, abs=1e-3)


def test_wflc_stays_within_its_limits() -> None:
    t = np.arange(10_000) / RATE_HZ
    for hz, limit in ((4.0, 7.0), (30.0, 13.0)):
        found = locked_frequency_hz(np.sin(2 * np.pi * hz * t), WflcConfig(frequency_gain=1e-4))
        assert 7.0 - 1e-9 <= found <= 13.0 + 1e-9
        assert found == pytest.approx(limit, abs=3.5)


def test_flc_settles_on_the_fourier_weights_and_the_bias() -> None:
    weights = np.zeros(3)
    for k in range(3000):
        phase = 2 * np.pi * 0.01 * k
        flc_step(0.3 * np.sin(phase) - 0.8 * np.cos(phase) + 2.0, phase, weights, 0.01, 0.005)
    np.testing.assert_allclose(weights, [0.3, -0.8, 2.0], atol=1e-6)


@pytest.mark.parametrize("delay_s", [0.0, 0.004, 0.012])
@pytest.mark.parametrize("hz", [8.5, 10.0, 11.5])
def test_a_steady_tone_is_predicted_to_one_percent(hz: float, delay_s: float) -> None:
    """RC filter, double integration and delay undone in amplitude and phase."""
    config = TremorConfig(method="wflc_flc", loop_delay_s=delay_s)
    params, state = combiner_params(config), combiner_state(config)
    n, w = 15_000, 2 * np.pi * hz
    t = np.arange(n) / RATE_HZ
    rc = CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
    acceleration = np.real(-(w**2) * 25e-6 * rc * np.exp(1j * w * t)) + 0.05
    error = []
    for k in range(n):
        combiner_step(acceleration[k], state[0], params[0])
        if k > n - 500:
            error.append(combiner_displacement(state[0], params[0], delay_s) - 25e-6 * np.cos(w * (t[k] + delay_s)))
    assert np.max(np.abs(error)) < 0.01 * 25e-6


def test_kernels_and_python_agree() -> None:
    config = TremorConfig(method="wflc_flc")
    params = combiner_params(config)
    a, b = combiner_state(config), combiner_state(config)
    twin, at = attributes(b)[0], attributes(params)[0]
    for k in range(300):
        s = 0.07 * np.sin(0.06 * k) + 0.01
        combiner_step(s, a[0], params[0])
        wflc_step.py_func(  # type: ignore[attr-defined]
            cascade_step.py_func(s, twin.memory, at.sections),  # type: ignore[attr-defined]
            twin.wflc,
            at.wflc,
        )
        flc_step.py_func(s, twin.wflc.phase, twin.weights, at.trailing_gain, at.bias_gain)  # type: ignore[attr-defined]
    for name in ("memory", "weights"):
        np.testing.assert_allclose(a[name], b[name], rtol=1e-9, atol=1e-15)
    assert a["wflc"]["omega"][0] == pytest.approx(b["wflc"]["omega"][0], rel=1e-12)
