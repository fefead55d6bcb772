"""Estimates the noise floor of an output, and the interval that contains it.

There are five sources: the declaration of the recording; periods of the excitation, whose misfit is the same in each;
stretches in which every input rests; the flat upper part of the residual's spectrum (median over frequency, so that
lines do not count, after clipping, so that spikes do not count); the lattice of a quantised output or its declared
resolution.

A spectrum is only a lower bound of the noise: a sensor behind a low-pass has little of its noise in the upper part. The
upper bound then follows from the part of the residual that follows signals (``floor_interval``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import welch

from hal.arrays import Array
from sim_devices.physics.periods import ALIKE, period_of
from sim_devices.physics.statistics import runs


@dataclass(frozen=True)
class NoiseFloor:
    """Holds the noise of an output, in its unit.

    ``rms`` is the whole noise and ``standard_error`` its error; ``white_rms`` is the flat part (equal to ``rms`` unless
    the noise is coloured); ``step`` is the quantisation step of the samples, 0 if none is visible; ``method`` is one of
    declared, repeats, rest, spectrum, inputs (most of it is what the noise of the inputs does); ``coloured`` is True if
    the spectrum falls up to its end. ``most`` is the upper bound from periods or stretches at rest (infinite without
    any).
    """

    rms: float
    standard_error: float
    white_rms: float
    step: float
    method: str
    coloured: bool
    most: float = np.inf

    @property
    def declared(self) -> bool:
        return self.method == "declared"

    def with_inputs(self, rms: float) -> NoiseFloor:
        """Return the noise with that of the inputs, which moves the output by ``rms``."""
        if rms <= 0.0:
            return self
        both, is_most = float(np.hypot(self.rms, rms)), rms > self.rms
        return replace(
            self,
            rms=both,
            standard_error=float(np.hypot(self.standard_error, 0.1 * rms)),
            method="inputs" if is_most else self.method,
            most=float(np.hypot(self.most, KNOWN_WITHIN * rms)),
        )


def clip_spikes(e: Array, threshold: float = 15.0) -> Array:
    """Return ``e`` (n,) with isolated outliers replaced by the running median.

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
    """Return the step of the lattice on which ``y`` (n,) lies (to 1e-6 of the step); 0 if there is none."""
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
    """Return the median spectral density in equal bands: (frequencies, rms of a flat spectrum, number of averages)."""
    segment = int(min(e.size, max(64, 1 << int(np.log2(max(e.size // 24, 64))))))
    frequency, density = welch(e, rate_hz, nperseg=segment, detrend="linear")
    averages = max(1, 2 * e.size // segment - 1)
    inner = slice(max(2, frequency.size // 40), -max(1, frequency.size // 40))
    bands = max(4, min(16, frequency[inner].size // 4))
    fs = np.array([b.mean() for b in np.array_split(frequency[inner], bands)])
    # the median of a mean of K exponentials is below its mean by about the factor (1 - 1/(9K/1.8))^3
    k = max(1.0, averages / 1.8)
    bias = (1 - 1 / (9 * k)) ** 3
    levels = np.array([np.median(b) for b in np.array_split(density[inner], bands)]) / bias
    return fs, np.sqrt(levels * rate_hz / 2), averages


def spectral_floor(e: Array, rate_hz: float) -> tuple[float, float, bool]:
    """Estimate the white level of a residual ``e`` (n,): (rms, standard error, True if the spectrum falls to its end).

    Spikes, which are white, are removed if that lowers the level. If it raises the level, the removed samples were
    peaks of a signal with varying amplitude, and the cuts are broad-band.
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
    # the standard deviation of a band level with K averages over the band's bins
    bins = max(4.0, e.size / max(levels.size, 1) / max(averages, 1))
    spread = 0.5 * 1.25 / np.sqrt(averages / 1.8 * max(bins / 3, 1))
    same = order[order <= quiet[0] * (1 + 5 * spread)]
    rms = float(np.mean(same)) if same.size > 1 else float(quiet.mean())
    top = levels[-max(2, levels.size // 4) :]
    middle = levels[levels.size // 3 : levels.size // 2 + 1]
    falling = float(np.median(middle)) > (1.12 + 4 * spread) * float(np.median(top))
    error = rms * max(spread / np.sqrt(max(same.size, 1)), 1 / np.sqrt(2 * e.size))
    return rms, error, falling


HIGH_PASS = 20
"""Length of the differences between periods over the width of the running mean that is subtracted from them, because
warm-up is not noise."""


SLOW = 1.5
"""Growth of the variance of differences with a high-pass of three times the width above which they are slow: a walk
(three times), or noise that the high-pass removes. The estimate is then invalid."""


def repeat_floor(y: Array, inputs: Array) -> tuple[float, float, bool] | None:
    """Estimate the noise from periods of the excitation: (rms, standard error, True if too slow); None without periods.

    ``y`` (n,) is an output, or the residual of a simulation (which also removes the differences of inputs between
    periods); ``inputs`` (n, k). The first of three and more periods is left out, because it starts from another state.
    Slow drift, lines and bursts are removed from the differences.
    """
    n = y.size
    if inputs.size == 0 or n < 200:
        return None
    x = inputs[:, int(np.argmax(np.std(inputs, axis=0)))]
    period = period_of(x)
    if period is None:
        return None
    lag = period.lag
    begin = round(period.samples) if n - lag - period.samples >= max(100, n // 4) else 0
    if n - lag - begin < 100 or any(not _repeats(inputs[:, i], lag) for i in range(inputs.shape[1])):
        return None
    d = y[begin + lag :] - y[begin : n - lag]
    window = max(51, d.size // HIGH_PASS)
    narrow, wide = (_variance_without_lines(d, w) for w in (window, 3 * window))
    rms = float(np.sqrt(narrow / 2))
    return rms, rms / float(np.sqrt(max(d.size / 4, 2))), wide > SLOW * narrow


def _repeats(x: Array, lag: int) -> bool:
    spread = float(np.std(x))
    return spread == 0.0 or float(np.sqrt(np.mean((x[lag:] - x[:-lag]) ** 2) / 2)) <= ALIKE * spread


def _variance_without_lines(d: Array, window: int) -> float:
    """Return the variance of ``d`` (n,) less its running mean over ``window`` samples, without lines and bursts."""
    d = clip_spikes(d - uniform_filter1d(d, min(window, d.size), mode="nearest"))
    segment = int(min(d.size, max(128, 1 << int(np.log2(max(d.size // 8, 128))))))
    frequency, density = welch(d, 1.0, nperseg=segment, detrend="constant")
    usual = median_filter(density, min(15, density.size), mode="nearest")
    return float(np.sum(np.where(density > 6.0 * usual, usual, density)[1:])) * float(frequency[1])


MOST_LINES = 8
"""Largest number of lines that are removed from stretches at rest."""
LINE = 1e-6
"""Largest probability, over all frequencies, that noise alone makes a line as high above its neighbours."""


def without_lines(e: Array, at: NDArray[np.bool_]) -> Array:
    """Return ``e`` (n,), which is zero but at the samples ``at`` (n,), without its lines.

    A line is a peak of the periodogram that stands above its neighbours as no peak of noise does, whose ordinates are
    exponential (Fisher 1929), and that a single sine of steady phase explains.
    """
    k = np.flatnonzero(at)
    if k.size < LEAST_REST:
        return e
    width = round(2 * e.size / max(stop - start for start, stop in runs(at)))
    step = max(1, width // 4)
    near = NEIGHBOURS * width // step
    for _ in range(MOST_LINES):
        every = np.abs(np.fft.rfft(e, 2 * e.size)) ** 2
        power = every[::step]
        usual = median_filter(power, 2 * near + 1, mode="reflect") / math.log(2.0)
        inner = slice(near, -near)
        above = power[inner] / np.maximum(usual[inner], 1e-300)
        if above.size == 0 or above.max() < math.log(k.size / LINE):
            return e
        peak = step * (near + int(np.argmax(above)))
        # several stretches together show the frequency more finely than each does
        peak = peak - width + int(np.argmax(every[peak - width : peak + width + 1]))
        steps = np.linspace(peak - 1.0, peak + 1.0, 21) * np.pi / e.size
        best = min((_sine(e[k], k, w) for w in steps), key=lambda f: float(np.sum((e[k] - f) ** 2)))
        e = e.copy()
        e[k] -= best
    return e


NEIGHBOURS = 8
"""Number of ordinates of the longest stretch on either side of a peak whose median is the usual one."""


def _sine(e: Array, k: NDArray[np.int64], w: float) -> Array:
    """Return the sine of ``w`` radians a sample that fits ``e`` (m,) at the samples ``k`` (m,) best."""
    design = np.column_stack([np.cos(w * k), np.sin(w * k)])
    return np.asarray(design @ np.linalg.lstsq(design, e, rcond=None)[0], np.float64)


REST = 1e-3  # largest movement, relative to an input's range, of an input at rest
LEAST_REST = 64  # least samples of a stretch at rest, whose first half is left for settling


def rest_floor(y: Array, inputs: Array) -> tuple[float, float] | None:
    """Estimate the noise of ``y`` (n,) where every input (n, k) rests and the output has settled, without lines.

    Returns (rms, standard error), or None if no stretch is long enough and settled.
    """
    n = y.size
    if inputs.size == 0 or n < LEAST_REST:
        return None
    size = np.maximum(np.ptp(inputs, axis=0), 1e-300)
    if np.all(np.ptp(inputs, axis=0) == 0.0):
        return None
    level = np.round(inputs / (REST * size))
    still = np.concatenate([[False], np.all(np.abs(np.diff(level, axis=0)) <= 1, axis=1)])
    count = 0.0
    calm = np.zeros(n)
    for a, b in runs(still):
        if b - a < LEAST_REST or np.any(np.ptp(inputs[a:b], axis=0) > 2 * REST * size):
            continue
        half = y[(a + b) // 2 : b]
        t = np.linspace(-1.0, 1.0, half.size)
        e = half - np.polynomial.Polynomial.fit(t, half, 2)(t)
        early, late = float(np.std(e[: e.size // 2])), float(np.std(e[e.size // 2 :]))
        if early <= 2.0 * late:
            calm[(a + b) // 2 : b] = e
            count += e.size - 3
    calm = without_lines(calm, calm != 0.0)
    power = float(calm @ calm)
    if count < LEAST_REST / 2 or power <= 0.0:
        return None
    rms = float(np.sqrt(power / count))
    return rms, rms / float(np.sqrt(max(count / 4, 2)))


def noise_floor(
    y: Array,
    residual: Array,
    rate_hz: float,
    *,
    declared: float | None = None,
    inputs: Array | None = None,
    whole: Array | None = None,
    resolution: float = 0.0,
) -> NoiseFloor:
    """Estimate the noise floor of an output.

    ``y`` (n,) as recorded, ``residual`` (m,) after the fit of the base parameters, ``inputs`` (n, k), ``whole`` (n,)
    the residual of one run through the whole record. A declared figure has priority, then periods, then stretches at
    rest, then the quiet end of the spectrum; the floor is never below the quantisation.
    """
    step = max(lattice_step(y), resolution)
    white, error, falling = spectral_floor(residual, rate_hz)
    if declared is not None and declared > 0:
        white = min(white, declared) if white > 0 else declared
        return NoiseFloor(declared, 0.02 * declared, white, step, "declared", falling, declared)
    least = step / np.sqrt(12.0)
    rms = max(white, least)
    most = np.inf
    if inputs is not None:
        both = [repeat_floor(e, inputs) for e in (y, whole) if e is not None]
        repeated = min((r for r in both if r is not None), default=None)
        rest = rest_floor(y, inputs)
        if repeated is not None and 0 < repeated[0] < 1.5 * white:
            value, spread, _ = repeated
            value = max(value, least)
            return NoiseFloor(value, spread, min(white, value), step, "repeats", falling, value + 2 * spread)
        if repeated is not None and repeated[0] > 0 and not repeated[2]:
            # the fast part is the instrument's own; the slow part may be a walk, which the search may find
            most = max(repeated[0] + 2 * repeated[1], rms)
            return NoiseFloor(max(repeated[0], least), repeated[1], rms, step, "repeats", falling, most)
        if rest is not None:
            most = min(most, max(rest[0] + 2 * rest[1], rms))
            if rest[0] > 1.5 * white:
                return NoiseFloor(max(rest[0], least), rest[1], rms, step, "rest", falling, most)
    return NoiseFloor(rms, max(error, 0.01 * rms), rms, step, "spectrum", falling, most)


KNOWN_WITHIN = 1.25
"""Factor, either way, within which a floor from periods, rest or a flat spectrum counts as known."""


def floor_interval(
    floor: NoiseFloor, left: Array, follows: float, rate_hz: float, *, of_any_colour: bool = False
) -> tuple[float, float]:
    """Return the interval of the noise rms.

    ``left`` (m,) is the residual of the final model, ``follows`` the share of its variance that recorded signals
    predict; the rest is the upper bound of noise that falls up to the end of the spectrum, or ``of_any_colour``.
    """
    if floor.declared:
        return floor.rms, floor.rms
    if floor.method != "spectrum":
        return floor.rms / KNOWN_WITHIN, max(floor.rms * KNOWN_WITHIN, min(floor.most, 2 * floor.rms))
    _, _, falling = spectral_floor(left, rate_hz)
    if not falling and not of_any_colour:
        return floor.rms, KNOWN_WITHIN * floor.rms
    unpredicted = float(np.sqrt(np.mean(left**2) * max(1.0 - follows, 0.0)))
    return floor.rms, max(min(unpredicted, floor.most), floor.rms)
