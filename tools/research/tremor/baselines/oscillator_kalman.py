"""Estimates tremor by a stationary Kalman filter whose model includes the sensor's RC filter.

Model per axis, continuous time: tremor displacement x = sum of modes; each mode is an oscillator driven by a
second, equal oscillator, which is driven by white noise. One oscillator alone would leave white noise in the
acceleration that is measured; two in a row have the steep skirts of a modulated tone (measured on held-out
synthetic records: residual 14 % against 24 %). The measured acceleration is the mode accelerations plus drift
(a slow Gauss-Markov process: attitude error, bias, voluntary motion, which the double derivative makes small)
plus white noise, all through the RC filter. The filter's state is part of the model, so its phase is undone
by the estimate; the prediction over the loop's delay is the model's free motion.

The model is linear and constant, hence so is the gain: all of it is designed once, a step costs a few dozen
multiplications.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg as scipy_linalg  # pyright: ignore[reportMissingTypeStubs]

from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.own import OwnEstimator
from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from hal.validation import Positive, StrictTable, validate_table

linalg: Any = scipy_linalg  # without type stubs
ORDER = 4  # states of a mode: x, v, u, du/dt
MEMORY, NUMBERS = 128, 1024
FIRST = 3  # numbers in front of the rows: modes, drift, observe


class KalmanConfig(StrictTable):
    """Tremor as a sum of narrow-band oscillators, sensor noise and drift, all seen through the RC filter.

    The gain depends only on ratios, so ``tremor_rms_m`` is the size the filter is best at, not a limit.
    """

    frequencies_hz: tuple[Positive, ...] = (8.5, 9.2, 10.0, 10.8, 11.5)
    bandwidth_hz: Positive = 0.8
    tremor_rms_m: Positive = 14e-6
    sensor_noise_m_s2_rtHz: Positive = 1.4e-3  # at the tip; below the true 2e-3: measured best in 8-12 Hz
    drift_m_s2: Positive = 0.02  # rms of what is left of gravity and bias
    drift_s: Positive = 3.0
    reading_noise_m_s2: Positive = 0.8e-3  # quantisation, after the RC filter


@dataclass(frozen=True)
class OscillatorModel:
    """Discrete filter in balanced states s: s <- F s, then s += K (y - C s).

    ``now`` and ``ahead`` are rows that give tremor x(t) and x(t + loop delay) in m.
    """

    transition: Array
    gain: Array
    observe: Array
    now: Array
    ahead: Array
    error_rms_m: float  # of x(t), when the model is true
    n_modes: int


def _mode(frequency_hz: float, bandwidth_hz: float, variance: float) -> tuple[Array, Array]:
    """Continuous (A, Q) of one mode whose displacement has ``variance`` m^2."""
    w = 2.0 * np.pi * frequency_hz
    single = np.array([[0.0, 1.0], [-w * w, -2.0 * np.pi * bandwidth_hz]])
    a = np.zeros((ORDER, ORDER))
    a[:2, :2] = single
    a[1, 2] = 1.0
    a[2:, 2:] = single
    q = np.zeros((ORDER, ORDER))
    q[3, 3] = 1.0
    covariance = linalg.solve_continuous_lyapunov(a, -q)
    return a, q * (variance / covariance[0, 0])


def _discretise(a: Array, q: Array, dt: float) -> tuple[Array, Array]:
    """Return the exact transition and noise covariance over ``dt`` (Van Loan 1978)."""
    n = len(a)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = -a
    block[:n, n:] = q
    block[n:, n:] = a.T
    e = linalg.expm(block * dt)
    transition: Array = np.asarray(e[n:, n:].T, dtype=np.float64)
    return transition, np.asarray(transition @ e[:n, n:], dtype=np.float64)


def design_oscillators(config: TremorConfig) -> OscillatorModel:
    """Return the stationary filter for ``config``. Raises LinAlgError when the Riccati equation has no solution."""
    k = validate_table(KalmanConfig, config.own, "[firmware.tremor.own]")
    if config.sees != "acceleration":
        raise BenchError("method 'kalman' models an accelerometer: sees must be 'acceleration'")
    m = len(k.frequencies_hz)
    n = ORDER * m + 2
    cutoff = config.filter_cutoff_rad_s
    a = np.zeros((n, n))
    q = np.zeros((n, n))
    displacement = np.zeros(n)
    acceleration = np.zeros(n)
    for i, frequency in enumerate(k.frequencies_hz):
        span = slice(ORDER * i, ORDER * (i + 1))
        a[span, span], q[span, span] = _mode(frequency, k.bandwidth_hz, k.tremor_rms_m**2 / m)
        displacement[ORDER * i] = 1.0
        acceleration += a[ORDER * i + 1]
    drift, rc = n - 2, n - 1
    a[drift, drift] = -1.0 / k.drift_s
    q[drift, drift] = 2.0 * k.drift_m_s2**2 / k.drift_s
    a[rc] += cutoff * acceleration
    a[rc, drift] += cutoff
    a[rc, rc] -= cutoff
    q[rc, rc] = cutoff**2 * k.sensor_noise_m_s2_rtHz**2 / 2.0  # two-sided density is half the one-sided square
    transition, noise = _discretise(a, q, 1.0 / config.tick_hz)
    # states differ by 1e6 in size: balance by their stationary deviations before the Riccati equation
    scale = np.sqrt(np.diag(linalg.solve_discrete_lyapunov(transition, noise)))
    f = transition * scale[None, :] / scale[:, None]
    w = noise / scale[:, None] / scale[None, :]
    c = np.zeros((1, n))
    c[0, rc] = scale[rc]
    r = np.array([[k.reading_noise_m_s2**2]])
    prior = linalg.solve_discrete_are(f.T, c.T, 0.5 * (w + w.T), r)
    innovation = (c @ prior @ c.T + r)[0, 0]
    gain = prior @ c[0] / innovation
    posterior = prior - np.outer(gain, c[0] @ prior)
    now = displacement * scale
    ahead = displacement @ linalg.expm(a * config.loop_delay_s) * scale
    return OscillatorModel(f, gain, c[0], now, ahead, float(np.sqrt(now @ posterior @ now)), m)


def kalman_numbers(config: TremorConfig) -> Array:
    """Return modes, drift, observe; last row, gain, now and ahead (``n`` each); and the modes' blocks (4, 4) each.

    The transition is block diagonal but for its last row, and kept so. States are balanced.
    """
    model = design_oscillators(config)
    spans = [slice(ORDER * i, ORDER * (i + 1)) for i in range(model.n_modes)]
    blocks = [model.transition[span, span].ravel() for span in spans]
    rows = (model.transition[-1], model.gain, model.now, model.ahead)
    return np.concatenate([[model.n_modes, model.transition[-2, -2], model.observe[-1]], *rows, *blocks])


@kernel
def kalman_predict(state: Array, numbers: Array) -> None:
    """s <- F s for one axis, one tick; ``state`` (4 m + 2,)."""
    n = len(state)
    last = combine(state, numbers[FIRST : FIRST + n])
    for m in range(int(numbers[0])):
        block = numbers[FIRST + 4 * n + 16 * m :]
        j = 4 * m
        s0, s1, s2, s3 = state[j], state[j + 1], state[j + 2], state[j + 3]
        for r in range(4):
            state[j + r] = block[4 * r] * s0 + block[4 * r + 1] * s1 + block[4 * r + 2] * s2 + block[4 * r + 3] * s3
    state[n - 2] *= numbers[1]
    state[n - 1] = last


@kernel
def kalman_correct(state: Array, measured: float, numbers: Array) -> None:
    """s += K (y - C s): ``measured`` is the tip's acceleration m/s^2, behind the RC filter."""
    n = len(state)
    innovation = measured - numbers[2] * state[n - 1]
    for i in range(n):
        state[i] += numbers[FIRST + n + i] * innovation


@kernel
def combine(state: Array, row: Array) -> float:
    """row . state"""
    total = 0.0
    for i in range(len(state)):
        total += row[i] * state[i]
    return total


@kernel
def kalman_step(memory: Array, numbers: Array, sample: float, have: bool, out: Array) -> None:
    """Compute one tick of one axis; see ``OwnEstimator``."""
    n = ORDER * int(numbers[0]) + 2
    state = memory[:n]
    kalman_predict(state, numbers)
    if have:
        kalman_correct(state, sample, numbers)
    out[0] = combine(state, numbers[FIRST + 2 * n : FIRST + 3 * n])
    out[1] = combine(state, numbers[FIRST + 3 * n : FIRST + 4 * n])


KALMAN = OwnEstimator(kalman_numbers, kalman_step, MEMORY, NUMBERS)
