"""Replaces a noisy input by its conditional mean, so that its noise is not taken for physics of the twin.

A twin that runs on a measured input ``x + n`` has an error that follows the input: ``n`` is part of both. Any effect
that smooths (a lag, a resonance) then predicts better, although the system has none. With the conditional mean of ``x``
given the whole record in the input's place, the error no longer follows the input, and a linear effect that is not
there gains nothing (regression calibration: Carroll et al. 2006, chapter 4).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.ndimage import uniform_filter1d

Array = NDArray[np.float64]
WIDTHS = (15, 31, 63, 127, 255)
"""Numbers of neighbouring frequencies over which the power of a continuous spectrum is averaged."""
SHRINK = 4.505
"""Noise that a block of frequencies pays, in its expected power (Cai 1999, section 3)."""
LEAST_SAMPLES = 64


def conditional_mean(measured: Array, noise_rms: float, starts: Sequence[int] = ()) -> Array:
    """Return the course (n,) that is expected behind ``measured`` (n,) with white noise of ``noise_rms``.

    Each run that begins at one of ``starts`` is smoothed by itself.
    """
    out = measured.copy()
    for run in np.split(np.arange(measured.size), list(starts)):
        if run.size >= LEAST_SAMPLES:
            course = _cosines(measured[run])
            out[run] = _course(_best_gains(course, noise_rms) * course)
    return out


def error_of_mean(expected: Array, noise_rms: float, rng: np.random.Generator) -> Array:
    """Draw an error (n,) as ``expected``, a conditional mean, has it: noise behind the root of the same gains.

    The power of the course follows from that of its mean: with the noise's ``N``, ``S^2 / (S + N)`` is that of the
    mean, and the error has ``S N / (S + N)``.
    """
    noise = noise_rms**2
    power = _smooth(_cosines(expected) ** 2, WIDTHS[0])
    course = 0.5 * (power + np.sqrt(power**2 + 4.0 * power * noise))
    white = noise_rms * rng.standard_normal(expected.size)
    return _course(np.sqrt(course / (course + noise)) * white)


def _cosines(x: Array) -> Array:
    # the course goes on mirrored: a step from its last sample to its first would spread over all frequencies
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
