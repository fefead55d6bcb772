"""Synthetic hands for tuning and scoring the estimators, and their score.

Three kinds of tremor, all narrow-band and stochastic: one or two tones with slow random amplitude and frequency,
and band-passed noise. On top: voluntary motion below 0.6 Hz, sensor noise at the tip (110 ug/rtHz times the
placement's 1.8), slow error of gravity removal, the RC filter, quantisation. All analytic or by differences:
nothing of the firmware is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, cont2discrete, lfilter, sosfilt, sosfiltfilt

from hal.arrays import Array

RATE_HZ = 1000.0
GRAVITY = 9.80131
CUTOFF_RAD_S = 1.0 / (32_000.0 * 0.33e-6)
KINDS = ("one tone", "two tones", "band noise")
RUN_IN = 20_000


@dataclass(frozen=True)
class Record:
    """``tremor`` and ``voluntary`` m; ``acceleration`` m/s^2 is what sensing hands to the estimator."""

    tremor: Array
    voluntary: Array
    acceleration: Array


def wander(rng: np.random.Generator, n: int, time_s: float, deviation: float) -> Array:
    """Gauss-Markov process without the roughness that would turn into acceleration noise (2 Hz low-pass)."""
    keep = np.exp(-1.0 / (RATE_HZ * time_s))
    white = rng.standard_normal(n + RUN_IN) * deviation * np.sqrt(1.0 - keep**2)
    smooth = butter(3, 2.0, fs=RATE_HZ, output="sos")
    return np.asarray(sosfilt(smooth, lfilter([1.0], [1.0, -keep], white)))[RUN_IN:]


def narrow_band(rng: np.random.Generator, n: int, kind: str) -> Array:
    """Tremor of unit deviation."""
    if kind == "band noise":
        centre, width = rng.uniform(9.0, 11.0), rng.uniform(0.8, 2.0)
        band = butter(2, [centre - width / 2, centre + width / 2], btype="band", fs=RATE_HZ, output="sos")
        x = np.asarray(sosfilt(band, rng.standard_normal(n + RUN_IN)))[RUN_IN:]
    else:
        x = np.zeros(n)
        for _ in range(1 if kind == "one tone" else 2):
            frequency = rng.uniform(8.5, 11.5) + wander(rng, n, 1.5, 0.35)
            size = 1.0 + wander(rng, n, 0.8, 0.4)
            x += size * np.sin(2 * np.pi * np.cumsum(frequency) / RATE_HZ + rng.uniform(0.0, 2 * np.pi))
    return x / np.std(x)


def make_record(
    seed: int, kind: str, seconds: float = 20.0, rms_m: float = 14e-6, voluntary_m: float = 300e-6
) -> Record:
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE_HZ)
    tremor = rms_m * narrow_band(rng, n, kind)
    slow = butter(3, 0.6, fs=RATE_HZ, output="sos")
    voluntary = np.asarray(sosfilt(slow, rng.standard_normal(n + RUN_IN)))[RUN_IN:]
    voluntary *= voluntary_m / np.std(voluntary)
    path = tremor + voluntary
    acceleration = np.zeros(n)
    acceleration[1:-1] = (path[2:] - 2 * path[1:-1] + path[:-2]) * RATE_HZ**2
    acceleration += 1.8 * 110e-6 * GRAVITY * np.sqrt(RATE_HZ / 2) * rng.standard_normal(n)
    acceleration += wander(rng, n, 3.0, 0.03)
    acceleration = rc_filter(acceleration) + 0.8e-3 * rng.standard_normal(n)
    return Record(tremor, voluntary, acceleration)


def rc_filter(x: Array) -> Array:
    """32 kOhm, 0.33 uF, exact for input that runs straight between samples."""
    (b,), a, _ = cont2discrete(([CUTOFF_RAD_S], [1.0, CUTOFF_RAD_S]), 1.0 / RATE_HZ, "foh")
    return np.asarray(lfilter(b, a, x))


def residual_percent(tremor: Array, ahead: Array, delay_ticks: int, skip_s: float = 4.0) -> float:
    """What is left of the tremor in 8-12 Hz when ``ahead[k]`` is subtracted at tick k + delay; zero phase."""
    band = butter(4, [8.0, 12.0], btype="band", fs=RATE_HZ, output="sos")
    error = tremor[delay_ticks:] - ahead[: len(ahead) - delay_ticks]
    inside = slice(round(skip_s * RATE_HZ), -1000)
    return float(100 * np.std(sosfiltfilt(band, error)[inside]) / np.std(sosfiltfilt(band, tremor)[inside]))
