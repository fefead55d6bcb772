"""Replaces a noisy input by its conditional mean, so that its noise is not taken for physics of the twin.

A twin that runs on a measured input ``x + n`` has an error that follows the input: ``n`` is part of both. Any effect
that smooths (a lag, a resonance) then predicts better, although the system has none. With the conditional mean of ``x``
given the whole record in the input's place, the error no longer follows the input, and a linear effect that is not
there gains nothing (regression calibration: Carroll et al. 2006, chapter 4).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.fft import dct, idct
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter, lfiltic

from hal.arrays import Array

WIDTHS = (15, 31, 63, 127, 255)
"""Numbers of neighbouring frequencies over which the power of a continuous spectrum is averaged."""
SHRINK = 4.505
"""Noise that a block of frequencies pays, in its expected power (Cai 1999, section 3)."""
LEAST_SAMPLES = 64
CONTINUED, ORDER = 8, 32
"""Share of a record by which it is continued at each end, as an inverse, and the order of the autoregression."""


def conditional_mean(measured: Array, noise_rms: float, starts: Sequence[int] = ()) -> Array:
    """Return the course (n,) that is expected behind ``measured`` (n,) with white noise of ``noise_rms``.

    Each run that begins at one of ``starts`` is smoothed by itself.
    """
    out = measured.copy()
    for run in np.split(np.arange(measured.size), list(starts)):
        if run.size >= LEAST_SAMPLES:
            wide, inner = _extended(measured[run])
            course = _cosines(wide)
            out[run] = _course(_best_gains(course, noise_rms) * course)[inner]
    return out


def error_of_mean(expected: Array, noise_rms: float, rng: np.random.Generator) -> Array:
    """Draw an error (n,) as ``expected``, a conditional mean, has it: noise behind the root of the same gains.

    The power of the course follows from that of its mean: with the noise's ``N``, ``S^2 / (S + N)`` is that of the
    mean, and the error has ``S N / (S + N)``.
    """
    noise = noise_rms**2
    wide, inner = _extended(expected)
    power = _smooth(_cosines(wide) ** 2, WIDTHS[0])
    course = 0.5 * (power + np.sqrt(power**2 + 4.0 * power * noise))
    white = noise_rms * rng.standard_normal(wide.size)
    return _course(np.sqrt(course / (course + noise)) * white)[inner]


def _extended(x: Array) -> tuple[Array, slice]:
    """Return ``x`` (n,) with its continuation at both ends, and the samples that are its own.

    Cosines would go on mirrored, with a kink at each end. The continuation is that of an autoregression (Burg 1967).
    """
    count, mean = x.size // CONTINUED, float(np.mean(x))
    away = x - mean
    a = _burg(away, min(ORDER, x.size // 4))

    def following(y: Array) -> Array:
        state: Any = lfiltic([1.0], a, y[::-1][: a.size - 1])
        return np.asarray(lfilter([1.0], a, np.zeros(count), zi=state)[0], np.float64)

    wide = np.concatenate([following(away[::-1])[::-1], away, following(away)])
    return wide + mean, slice(count, count + x.size)


def _burg(x: Array, order: int) -> Array:
    """Return the coefficients (order + 1,) of a stable autoregression, the first of which is 1."""
    ahead, back, a = x, x, np.ones(1)
    for _ in range(order):
        f, b = ahead[1:], back[:-1]
        k = -2.0 * float(f @ b) / max(float(f @ f + b @ b), 1e-300)
        ahead, back = f + k * b, b + k * f
        a = np.append(a, 0.0)
        a = a + k * a[::-1]
    return a


def _cosines(x: Array) -> Array:
    return np.asarray(dct(x, norm="ortho"), np.float64)


def _course(coefficients: Array) -> Array:
    return np.asarray(idct(coefficients, norm="ortho"), np.float64)


def _best_gains(coefficients: Array, noise_rms: float) -> Array:
    """Return the gains (n,) with the least expected error (Stein 1981). The mean of the record is kept."""
    c = coefficients / noise_rms
    gains, _ = min(_candidates(c), key=lambda found: found[1])
    gains[0] = 1.0
    return gains


def _candidates(c: Array) -> Iterator[tuple[Array, float]]:
    """Yield gains and their expected squared error, for coefficients whose noise has variance 1.

    They are Wiener's gains for a continuous spectrum, and James and Stein's by blocks, for lines.
    """
    power = c**2
    for width in WIDTHS:
        gains = np.maximum(1.0 - 1.0 / _smooth(power, width), 0.0)
        yield gains, float(np.sum((1.0 - gains) ** 2 * power + 2.0 * gains - 1.0))
    size = max(2, int(np.log(c.size)))
    starts = np.arange(0, c.size, size)
    count = np.diff(np.append(starts, c.size)).astype(np.float64)
    blocks = np.maximum(np.add.reduceat(power, starts), 1e-300)
    paid = SHRINK * count
    is_kept = blocks > paid
    kept = count + (paid**2 - 2.0 * paid * (count - 2.0)) / blocks
    gains = np.where(is_kept, 1.0 - paid / blocks, 0.0)
    yield np.repeat(gains, count.astype(np.int64)), float(np.sum(np.where(is_kept, kept, blocks - count)))


def _smooth(power: Array, width: int) -> Array:
    # the running sum of the filter is off by rounding, which may be below zero
    return np.maximum(uniform_filter1d(power, width, mode="nearest"), 1e-300)
