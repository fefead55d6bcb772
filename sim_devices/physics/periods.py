"""Inputs that repeat: their period, and where in it things happen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array

ALIKE = 0.05
"""Largest rms difference between two periods, relative to the rms of the signal times the root of two. It is not zero,
because a measured input repeats only up to its noise."""


@dataclass(frozen=True)
class Period:
    """Holds a period: ``samples`` is the fundamental period, not always a whole number; ``lag`` is the whole number of
    samples, one or a few periods, after which the signal differs least from itself.
    """

    samples: float
    lag: int


def period_of(x: Array, *, alike: float = ALIKE) -> Period | None:
    """Return the period of ``x`` (n,) if it repeats at least twice within the record, else None.

    Lags are proposed by the autocorrelation and judged by the difference of the signal from itself.
    """
    n = x.size
    spread = float(np.std(x))
    if n < 64 or spread <= 0.0:
        return None
    centred = x - float(np.mean(x))
    size = 1 << int(np.ceil(np.log2(2 * n)))
    wave = np.fft.rfft(centred, size)
    rho = np.asarray(np.fft.irfft(wave * np.conj(wave), size)[: n // 2 + 1], np.float64)
    rho = rho / rho[0] / (1 - np.arange(rho.size) / n)
    below = np.flatnonzero(rho < 0.5)
    if below.size == 0:
        return None
    inner = np.arange(max(int(below[0]), 2), rho.size - 1)
    peaks = inner[(rho[inner] >= rho[inner - 1]) & (rho[inner] > rho[inner + 1]) & (rho[inner] > 0.8)]
    if peaks.size == 0:
        return None
    # a peak of the autocorrelation may be a near miss (a slow swell of the same waveform): the difference decides
    tried = peaks[np.argsort(-rho[peaks], kind="stable")[:24]]
    near = {int(k) + j for k in tried for j in (-2, -1, 0, 1, 2) if 0 < int(k) + j < n}
    difference = {k: _difference(x, k) / spread for k in near}
    lag = min(difference, key=lambda k: (difference[k], k))
    if difference[lag] > alike:
        return None
    # the fundamental: the first peak as high as the best one, up to what a whole number of samples costs
    first = int(peaks[np.flatnonzero(rho[peaks] > 1 - 3 * max(1 - rho[lag], 0.02))[0]])
    cycles = max(round(lag / first), 1)
    return Period(_refined(x, lag) / cycles, lag)


def _difference(x: Array, lag: int) -> float:
    """Return the rms difference of ``x`` (n,) from itself ``lag`` samples later, over the root of two."""
    return float(np.sqrt(np.mean((x[lag:] - x[:-lag]) ** 2) / 2))


def _refined(x: Array, lag: int) -> float:
    """Return the lag of least difference, refined between samples: near it the mean square is a parabola."""
    a, b, c = (_difference(x, k) ** 2 for k in (lag - 1, lag, lag + 1))
    bend = a - 2 * b + c
    return lag + (0.5 * (a - c) / bend if bend > 0 else 0.0)


def locked_p_value(at: Array, period: float) -> float:
    """Return the p-value of the null hypothesis that events at samples ``at`` (k,) have random phases of the period.

    The alternative is that they cluster at one, two or four phases (Rayleigh's test at three multiples: N. I. Fisher,
    Statistical Analysis of Circular Data, 1993, section 4.3).
    """
    k = at.size
    if k < 3 or period <= 0.0:
        return 1.0
    resultant = max(float(np.abs(np.mean(np.exp(2j * np.pi * m * at / period)))) for m in (1, 2, 4))
    z = k * resultant**2
    series = 1 + (2 * z - z**2) / (4 * k) - (24 * z - 132 * z**2 + 76 * z**3 - 9 * z**4) / (288 * k**2)
    return float(min(1.0, 3.0 * np.exp(-z) * max(series, 0.05)))
