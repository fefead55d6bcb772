"""Numbers of the adaptive filter that are known before the first sample: bank, target, and the prior in spectra.

Features are the states of a bank of fixed filters on the samples. With the prior hand (tremor, voluntary motion,
sensor noise and drift as spectra) their covariance and its cross-covariance with the tremor ahead are integrals over
frequency; solved, they are the Wiener filter of that hand (Wiener 1949, here over a finite basis).

The target that the filter learns from is the tremor itself some 0.4 s ago, out of a linear-phase filter that looks to
both sides of that instant: band, double integration and the sensor's filter in one set of taps.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import iirpeak

from firmware_py.tremor.config import AdaptiveConfig, TremorConfig

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

GRID_STEP_HZ = 0.02
GRID_STOP_HZ = 250.0
OUTPUTS = 2  # now, ahead


@dataclass(frozen=True)
class Bank:
    """Resonators z <- p z + (1 - |p|) y (two states each), low-passes, and the sample itself."""

    pole: Complex
    slow: Array

    @property
    def size(self) -> int:
        return 2 * len(self.pole) + len(self.slow) + 1

    def response(self, z: Complex) -> Complex:
        """(size, len(z)) from sample to feature, z = exp(j w / rate)."""
        p, gain = self.pole[:, None], 1.0 - np.abs(self.pole[:, None])
        one, other = gain / (1.0 - p / z), gain / (1.0 - np.conj(p) / z)
        out = np.ones((self.size, len(z)), dtype=np.complex128)
        n = 2 * len(self.pole)
        out[0:n:2], out[1:n:2] = 0.5 * (one + other), (one - other) / 2j
        out[n:-1] = (1.0 - self.slow[:, None]) / (1.0 - self.slow[:, None] / z)
        return out


@dataclass(frozen=True)
class AdaptiveDesign:
    """``taps`` (2, L) on block means: target now and ahead, ``L // 2`` blocks ago. ``weight`` b0 b1 b2 a1 a2.

    Prior of unit tremor power: ``tremor`` (m, m), ``cross`` (2, m); ``rest`` (m, m) is what does not scale with the
    tremor; ``noise_cross`` (2, m) and ``noise_power`` are the sensor noise's share in learning. All are of weighted
    signals except ``start`` (2, m), the prior's filter, and ``onward`` (m,), next sample from present features.
    """

    bank: Bank
    block_ticks: int
    taps: Array
    weight: Array
    tremor: Array
    rest: Array
    cross: Array
    noise_cross: Array
    noise_power: float
    weighted_power: float  # of the prior's tremor, m^2
    least_power: float
    start: Array
    onward: Array


@dataclass(frozen=True)
class _Spectra:
    """One-sided densities over ``hz``: unit tremor m^2/Hz, the rest as seen, noise of the sensor as seen."""

    hz: Array
    seen: Complex  # from displacement to sample
    tremor: Array
    rest: Array
    noise: Array


def bank_of(config: AdaptiveConfig, tick_hz: float) -> Bank:
    centre = np.asarray(config.centres_hz)
    pole = np.exp((-pi * config.bandwidth_hz + 2j * pi * centre) / tick_hz)
    return Bank(pole, np.exp(-2.0 * pi * np.asarray(config.slow_hz) / tick_hz))


def sensor_response(config: TremorConfig, hz: Array) -> Complex:
    """From displacement to sample: RC filter, and -w^2 for an accelerometer."""
    w = 2.0 * pi * hz
    cutoff = config.filter_cutoff_rad_s
    low_pass = 1.0 / (1.0 + (1j * w / cutoff if isfinite(cutoff) else 0j * w))
    return _complex(-(w**2) * low_pass if config.sees == "acceleration" else low_pass)


def spectra(config: TremorConfig) -> _Spectra:
    """The prior hand in the sensor's eyes."""
    a = config.adaptive
    hz = np.arange(GRID_STEP_HZ, min(GRID_STOP_HZ, 0.5 * config.tick_hz), GRID_STEP_HZ)
    seen = sensor_response(config, hz)
    tremor = 1.0 / (1.0 + np.abs((hz - a.tremor_hz) / a.tremor_half_width_hz) ** 6)
    tremor /= np.sum(tremor) * GRID_STEP_HZ
    slow = a.voluntary_m**2 / a.voluntary_hz / (1.0 + (hz / a.voluntary_hz) ** 6)
    slow += a.unsteadiness_m**2 * 0.6 / (1.0 + hz**2) ** 2
    per_sample = 2.0 / config.tick_hz
    if config.sees == "acceleration":
        low_pass = np.abs(seen / (2.0 * pi * hz) ** 2) ** 2
        drift = 4.0 * a.drift_m_s2**2 * a.drift_s / (1.0 + (2.0 * pi * hz * a.drift_s) ** 2)
        noise = low_pass * a.sensor_noise_m_s2_rtHz**2 + a.reading_noise_m_s2**2 * per_sample
        rest = noise + low_pass * drift
    else:
        noise = np.full(len(hz), a.reading_noise_m**2 * per_sample)
        rest = noise
    return _Spectra(hz, seen, tremor, rest + np.abs(seen) ** 2 * slow, noise)


def target_taps(config: TremorConfig, block_ticks: int, advance_s: float) -> Array:
    """(L,) taps on block means that give displacement in the band, L // 2 blocks ago plus ``advance_s``.

    The window leaves an error of 4 % at 8 Hz, 2 % at 10 Hz (a gain that is too large) and 7 % at 5 Hz.
    """
    a = config.adaptive
    rate_hz = config.tick_hz / block_ticks
    half = round(a.half_width_s * rate_hz)
    points = 8192
    hz = np.linspace(0.0, 0.5 * rate_hz, points // 2 + 1)
    rise = np.clip((hz - a.cancel_from_hz[0]) / (a.cancel_from_hz[1] - a.cancel_from_hz[0]), 0.0, 1.0)
    fall = np.clip((a.cancel_to_hz[1] - hz) / (a.cancel_to_hz[1] - a.cancel_to_hz[0]), 0.0, 1.0)
    band = 0.5 - 0.5 * np.cos(pi * rise * fall)
    inside = band > 0.0
    wanted = np.zeros(len(hz), dtype=np.complex128)
    response = sensor_response(config, hz[inside]) * block_response(hz[inside], block_ticks, config.tick_hz)
    wanted[inside] = band[inside] / response * np.exp(2j * pi * hz[inside] * advance_s)
    taps = np.roll(np.fft.irfft(wanted, points), half)[: 2 * half + 1]
    return np.asarray(taps * np.hanning(2 * half + 3)[1:-1])


def block_response(hz: Array, block_ticks: int, tick_hz: float) -> Complex:
    """Of the mean over a block, timed at its last sample."""
    lag = np.exp(-1j * pi * hz * (block_ticks - 1) / tick_hz)
    return _complex(lag * np.sinc(hz * block_ticks / tick_hz) / np.sinc(hz / tick_hz))


def solve_scaled(matrix: Array, right: Array) -> Array:
    """Positive definite system whose unknowns differ in size: (k, m) for ``right`` (k, m)."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    scaled = matrix * scale[:, None] * scale[None, :] + 1e-9 * np.eye(len(matrix))
    return np.asarray(np.linalg.solve(scaled, (right * scale).T).T * scale)


def _complex(x: Any) -> Complex:
    return np.asarray(x, dtype=np.complex128)


def _polynomial(coefficients: Array, x: Complex) -> Complex:
    """c0 + c1 x + c2 x^2"""
    return coefficients[0] + x * (coefficients[1] + x * coefficients[2])


def design_adaptive(config: TremorConfig) -> AdaptiveDesign:
    """Everything that follows from ``config``."""
    a = config.adaptive
    bank = bank_of(a, config.tick_hz)
    block = max(1, round(a.block_s * config.tick_hz))
    s = spectra(config)
    w = 2.0 * pi * s.hz
    z = _complex(np.exp(1j * w / config.tick_hz))
    b, denominator = (np.asarray(c, dtype=np.float64) for c in iirpeak(a.emphasis_hz, a.emphasis_q, fs=config.tick_hz))
    numerator = denominator + (a.emphasis - 1.0) * b
    back = _complex(1.0 / z)
    weight = _polynomial(numerator, back) / _polynomial(denominator, back)
    plain = bank.response(z)
    phi = plain * weight
    advance = (0.0, config.loop_delay_s)
    taps = np.stack([target_taps(config, block, h) for h in advance])
    half = len(taps[0]) // 2
    in_blocks = np.exp(-1j * w[None, :] * block / config.tick_hz * (np.arange(len(taps[0])) - half)[:, None])
    target = (taps @ in_blocks) * block_response(s.hz, block, config.tick_hz)

    def covariance(features: Complex, density: Array) -> Array:
        return np.asarray(np.real((features * density) @ features.conj().T) * GRID_STEP_HZ)

    def cross(features: Complex, density: Complex | Array) -> Array:
        return np.asarray(np.real(np.conj(features) @ density) * GRID_STEP_HZ)

    ahead = [np.exp(1j * w * h) for h in advance]
    as_seen = np.abs(s.seen) ** 2 * s.tremor
    power = a.tremor_rms_m**2
    plain_cross = np.stack([cross(plain * s.seen, s.tremor * e) for e in ahead])
    plain_sum = power * covariance(plain, as_seen) + covariance(plain, s.rest)
    next_sample = cross(plain, (power * as_seen + s.rest) * z)
    weighted_unit = float(np.sum(s.tremor * np.abs(weight) ** 2) * GRID_STEP_HZ)
    return AdaptiveDesign(
        bank=bank,
        block_ticks=block,
        taps=taps,
        weight=np.array([*numerator, *denominator[1:]]) / denominator[0],
        tremor=covariance(phi, as_seen) / weighted_unit,
        rest=covariance(phi, s.rest),
        cross=np.stack([cross(phi * s.seen, weight * s.tremor * e) for e in ahead]) / weighted_unit,
        noise_cross=np.stack([cross(phi, s.noise * weight * t) for t in target]),
        noise_power=float(np.sum(s.noise * np.abs(weight * target[0]) ** 2) * GRID_STEP_HZ),
        weighted_power=power * weighted_unit,
        least_power=a.least_rms_m**2 * weighted_unit,
        start=solve_scaled(plain_sum, power * plain_cross),
        onward=solve_scaled(plain_sum, next_sample[None, :])[0],
    )
