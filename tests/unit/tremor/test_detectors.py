"""Jerk and drift: false alarms, latency, and that the flags mean what they say. Time is the sample count."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from firmware_py.frame import ALIGNING, DRIFT, JERK, LAYOUT, STALE, STATUS, TIP_ACCELERATION
from firmware_py.records import attributes, new
from firmware_py.tremor.detector_config import DetectorConfig
from firmware_py.tremor.detectors import Detectors, DetectState, detect_step

RATE_HZ = 1000.0


def hand(seed: int, seconds: float) -> np.ndarray:
    """Acceleration (n, 3): tremor at 9.2 and 10.8 Hz with wandering amplitudes, noise, bias of 0.02 m/s^2 rms."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    t_s = np.arange(n) / RATE_HZ
    out = np.zeros((n, 3))
    for i in range(3):
        for f in (9.2, 10.8):
            wander = lfilter([1e-3], [1.0, -0.999], rng.standard_normal((n + 4000, 2)), axis=0)[4000:]
            wander /= wander.std(axis=0)
            turn = 2 * np.pi * f * t_s
            size = 0.7 * 14e-6 * (2 * np.pi * f) ** 2
            out[:, i] += size * (wander[:, 0] * np.cos(turn) + wander[:, 1] * np.sin(turn))
        bias = lfilter([1.0], [1.0, -np.exp(-1.0 / 3000.0)], rng.standard_normal(n))
        out[:, i] += 2e-3 * np.sqrt(0.5 * RATE_HZ) * rng.standard_normal(n) + 0.02 * bias / 39.0
    return out


def jerk(t_s: np.ndarray, start_s: float, peak_m: float, tau_s: float) -> np.ndarray:
    """Second derivative of peak (s/3)^3 exp(3 - s), s = (t - start) / tau: the shape of the emulated hand's jerks."""
    s = np.clip((t_s - start_s) / tau_s, 0.0, 60.0)
    return peak_m / tau_s**2 * np.exp(3.0 - s) / 27.0 * (s**3 - 6.0 * s**2 + 6.0 * s)


def rises(bits: np.ndarray, flag: int) -> np.ndarray:
    """Samples at which ``flag`` goes up."""
    up = bits & flag > 0
    return np.flatnonzero(up[1:] & ~up[:-1]) + 1


def test_no_false_alarm_in_ten_minutes() -> None:
    bits = Detectors(DetectorConfig(), RATE_HZ).run(hand(11, 600.0))
    assert len(rises(bits, JERK)) == 0
    assert len(rises(bits, DRIFT)) == 0


def test_the_statistic_is_chi_squared_of_three() -> None:
    """White noise of unequal axes: mean 3, and the tail of the distribution that the threshold relies on."""
    noise = np.random.default_rng(1).standard_normal((200_000, 3)) * np.array([1.0, 0.1, 10.0])
    detectors = Detectors(DetectorConfig(), RATE_HZ)
    detectors.run(noise[:100_000])
    seen = []
    for sample in noise[100_000:104_000]:
        detect_step(sample, detectors.state[0], detectors.params[0])
        seen.append(float(detectors.state[0]["statistic"][1]))
    assert np.mean(seen) == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize(("peak_m", "tau_s", "within_ms"), [(300e-6, 0.035, 200), (80e-6, 0.010, 150)])
def test_a_jerk_is_found_in_time_and_counted_once(peak_m: float, tau_s: float, within_ms: float) -> None:
    values = hand(12, 60.0)
    starts = np.arange(15.0, 58.0, 4.0)
    t_s = np.arange(len(values)) / RATE_HZ
    for n, start in enumerate(starts):
        values[:, n % 3] += jerk(t_s, start, peak_m, tau_s)
    found = rises(Detectors(DetectorConfig(), RATE_HZ).run(values), JERK) / RATE_HZ
    assert len(found) == len(starts)
    assert np.all((found - starts >= 0.0) & (found - starts < 1e-3 * within_ms))


def test_jerks_do_not_hide_the_next_one() -> None:
    values = hand(13, 30.0)
    t_s = np.arange(len(values)) / RATE_HZ
    starts = np.arange(10.0, 28.0, 1.0)
    for start in starts:
        values[:, 0] += jerk(t_s, start, 400e-6, 0.035)
    assert len(rises(Detectors(DetectorConfig(), RATE_HZ).run(values), JERK)) >= len(starts) - 2


@pytest.mark.parametrize(("bias", "within_s"), [(0.2, 1.5), (0.5, 0.7)])
def test_drift_is_found_and_forgotten(bias: float, within_s: float) -> None:
    values = hand(14, 30.0)
    values[10_000:15_000, 1] += bias
    bits = Detectors(DetectorConfig(), RATE_HZ).run(values)
    (start,) = rises(bits, DRIFT)
    assert 0 < start - 10_000 < within_s * RATE_HZ
    assert not bits[18_000:].any()


def test_kernel_and_its_python_twin_agree() -> None:
    values = hand(15, 1.0)[:400]
    detectors = Detectors(DetectorConfig(settle_s=0.05), RATE_HZ)
    compiled = detectors.run(values)
    twin = Detectors(DetectorConfig(settle_s=0.05), RATE_HZ)
    state, params = attributes(new(DetectState))[0], attributes(twin.params)[0]
    plain = [detect_step.py_func(v, state, params) for v in values]  # pyright: ignore[reportFunctionMemberAccess]
    assert compiled.tolist() == plain
    assert state.statistic == pytest.approx(detectors.state[0]["statistic"], rel=1e-9)


def test_frame_bits_and_restart() -> None:
    detectors = Detectors(DetectorConfig(settle_s=0.5), RATE_HZ)
    frame = LAYOUT.new_frame()
    for value in np.random.default_rng(1).standard_normal(2000) * 0.01:
        frame[STATUS] = 0
        frame[TIP_ACCELERATION] = value
        detectors.step(frame)
    for n in range(300):
        frame[STATUS] = 0
        frame[TIP_ACCELERATION] = 3.0 * np.sin(2 * np.pi * 4.0 * n / RATE_HZ)
        detectors.step(frame)
    assert int(frame[STATUS]) & JERK
    frame[STATUS] = STALE
    detectors.step(frame)
    assert int(frame[STATUS]) == STALE
    frame[STATUS] = ALIGNING
    detectors.step(frame)
    assert int(frame[STATUS]) == ALIGNING
    assert float(detectors.state[0]["ticks"]) == 0.0
