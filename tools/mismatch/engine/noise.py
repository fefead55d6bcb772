"""How loud the instrument itself is: the noise floor of an output.

Four witnesses: what the recording declares; repetitions of the excitation; the flat upper part of the residual's
spectrum (median over frequency, so that lines do not count, after clipping, so that spikes do not count); the
lattice of a quantised output.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import welch

from tools.mismatch.engine.colour import autocovariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseFloor:
    """Noise of one output, in its unit.

    ``rms`` the whole noise; ``standard_error`` of it; ``white_rms`` the flat part (equal to ``rms`` unless the noise
    is coloured); ``step`` the quantisation step that the samples sit on, 0 when none shows; ``method`` one of
    declared, repeats, spectrum; ``coloured`` says that the spectrum keeps falling to its end.
    """

    rms: float
    standard_error: float
    white_rms: float
    step: float
    method: str
    coloured: bool

    @property
    def declared(self) -> bool:
        return self.method == "declared"


def clip_spikes(e: Array, threshold: float = 15.0) -> Array:
    """``e`` (n,) with isolated outliers against a running median replaced by that median.

    The threshold is wide, so that noise with heavy tails keeps them. The scale is that of second differences:
    a steep signal equals its running median almost everywhere.
    """
    if e.size < 9:
        return e
    smooth = median_filter(e, 7, mode="nearest")
    rough = e - smooth
    second = np.diff(e, 2) / np.sqrt(6.0)
    scale = 1.4826 * max(float(np.median(np.abs(rough))), float(np.median(np.abs(second))))
    spikes = np.abs(rough) > threshold * scale
    return np.where(spikes, smooth, e) if scale > 0.0 and spikes.any() else e


def lattice_step(y: Array) -> float:
    """Step of the lattice on which ``y`` (n,) sits exactly (to 1e-6 of the step); 0 when there is none."""
    values = np.unique(y)
    if values.size < 3 or values.size > 0.5 * y.size:
        return 0.0
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(values).max()), 1e-300)]
    if gaps.size < 2:
        return 0.0
    step = float(gaps.min())
    cells = gaps / step
    if np.any(np.abs(cells - np.round(cells)) > 0.02):
        return 0.0
    total = float(values[-1] - values[0])
    return total / max(round(total / step), 1)


def _band_levels(e: Array, rate_hz: float) -> tuple[Array, Array, int]:
    """Median spectral density in equal bands (frequencies, rms had the level been flat, averages)."""
    segment = int(min(e.size, max(64, 1 << int(np.log2(max(e.size // 24, 64))))))
    frequency, density = welch(e, rate_hz, nperseg=segment, detrend="linear")
    averages = max(1, 2 * e.size // segment - 1)
    inner = slice(max(2, frequency.size // 40), -max(1, frequency.size // 40))
    bands = max(4, min(16, frequency[inner].size // 4))
    fs = np.array([b.mean() for b in np.array_split(frequency[inner], bands)])
    # median of a mean of K exponentials is below its mean by about the factor (1 - 1/(9K/1.8))^3
    k = max(1.0, averages / 1.8)
    bias = (1 - 1 / (9 * k)) ** 3
    levels = np.array([np.median(b) for b in np.array_split(density[inner], bands)]) / bias
    return fs, np.sqrt(levels * rate_hz / 2), averages


def spectral_floor(e: Array, rate_hz: float) -> tuple[float, float, bool]:
    """White level of a residual ``e`` (n,): (rms, standard error, does the spectrum fall to its very end).

    Spikes are taken out where that lowers the level: each is white by itself. Where it raises the level no spikes were
    taken but the peaks of a signal whose amplitude varies, and the cuts are broad-band.
    """
    e = np.asarray(e, float)
    found = _level_of(e, rate_hz)
    clipped = clip_spikes(e)
    if clipped is e:
        return found
    without = _level_of(clipped, rate_hz)
    return min(found, without, key=lambda f: f[0])


def _level_of(e: Array, rate_hz: float) -> tuple[float, float, bool]:
    if e.size < 32 or not np.any(np.diff(e)):
        rough = np.diff(e)
        rms = float(np.std(rough)) / np.sqrt(2) if rough.size else 0.0
        return rms, rms, False
    _, levels, averages = _band_levels(e, rate_hz)
    order = np.sort(levels)
    quiet = order[: max(2, int(np.ceil(0.4 * order.size)))]
    # spread of one band level: K averages over the band's bins
    bins = max(4.0, e.size / max(levels.size, 1) / max(averages, 1))
    spread = 0.5 * 1.25 / np.sqrt(averages / 1.8 * max(bins / 3, 1))
    same = order[order <= quiet[0] * (1 + 5 * spread)]
    rms = float(np.mean(same)) if same.size > 1 else float(quiet.mean())
    top = levels[-max(2, levels.size // 4) :]
    middle = levels[levels.size // 3 : levels.size // 2 + 1]
    falling = float(np.median(middle)) > (1.12 + 4 * spread) * float(np.median(top))
    error = rms * max(spread / np.sqrt(max(same.size, 1)), 1 / np.sqrt(2 * e.size))
    return rms, error, falling


def repeat_floor(y: Array, inputs: Array) -> tuple[float, float] | None:
    """Noise from exact repetitions of the excitation: (rms, standard error); None when nothing repeats.

    ``inputs`` (n, k). Slow drift is taken off the differences (a running mean over a twentieth of them),
    so that warm-up is not booked as noise.
    """
    n = y.size
    if inputs.size == 0 or n < 200:
        return None
    x = inputs[:, int(np.argmax(np.std(inputs, axis=0)))]
    if np.std(x) == 0:
        return None
    rho = autocovariance(x, n // 2)
    rho = rho / rho[0] / (1 - np.arange(rho.size) / n)
    below = np.nonzero(rho < 0.5)[0]
    if below.size == 0:
        return None
    start = int(below[0])
    lag = start + int(np.argmax(rho[start:]))
    for candidate in (lag, 2 * lag, 5 * lag):
        if candidate <= 0 or n - candidate < max(100, n // 3):
            break
        change = inputs[candidate:] - inputs[:-candidate]
        if float(np.max(np.abs(change))) <= 1e-6 * float(np.max(np.abs(inputs))):
            d = y[candidate:] - y[:-candidate]
            d = clip_spikes(d - uniform_filter1d(d, max(51, d.size // 20), mode="nearest"))
            rms = float(np.std(d)) / np.sqrt(2)
            return rms, rms / np.sqrt(max(d.size / 4, 2))
    return None


def noise_floor(
    y: Array,
    residual: Array,
    rate_hz: float,
    *,
    declared: float | None = None,
    inputs: Array | None = None,
) -> NoiseFloor:
    """Noise floor of one output.

    ``y`` (n,) as recorded, ``residual`` (n,) after the base parameters were fitted, ``inputs`` (n, k).
    A declared figure wins; otherwise repetitions, otherwise the quiet end of the spectrum.
    """
    step = lattice_step(y)
    white, error, falling = spectral_floor(residual, rate_hz)
    if declared is not None and declared > 0:
        white = min(white, declared) if white > 0 else declared
        return NoiseFloor(declared, 0.02 * declared, white, step, "declared", falling)
    repeated = repeat_floor(y, inputs) if inputs is not None else None
    if repeated is not None and 0 < repeated[0] < 1.5 * white:
        rms, spread = repeated
        return NoiseFloor(rms, spread, min(white, rms), step, "repeats", falling)
    least = step / np.sqrt(12.0)
    rms = max(white, least)
    return NoiseFloor(rms, max(error, 0.01 * rms), rms, step, "spectrum", falling)
