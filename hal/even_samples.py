"""Samples on an even time base from jittering stamps: whether the stamps are to be believed, and if not, when was it.

A host stamps a sample when it arrives. Interpolating at such stamps moves samples that were taken evenly, and makes
noise of them: twice the power above 20 Hz in the mouse recordings of ``../shared/data``.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array

SMOOTH_S = 2.0  # a crystal does not change its rate within this; a transport jitters far faster


def stamp_share(stamps_s: Array, values: Array) -> float:
    """Return the share of the time stamps' scatter that is real.

    The share is 1 if the samples were taken at their stamps, 0 if they were taken evenly and stamped late.

    Between two samples a signal changes by slope x elapsed time. The slope is taken over three steps, so the change
    over the middle step regressed on slope x (deviation of that step from the mean) is 1 for true stamps, 0 for an
    even clock behind a jittering transport. ``values`` (n, k).
    """
    step = np.diff(stamps_s)
    deviation = (step[1:-1] / step.mean() - 1.0)[:, None]
    slope = (values[3:] - values[:-3]) / 3.0
    change = values[2:-1] - values[1:-2]
    expected = slope * deviation
    power = float(np.sum(expected**2))
    return float(np.sum((change - slope) * expected)) / power if power > 0.0 else 1.0


def steady_stamps(stamps_s: Array) -> Array:
    """Return the time (n,) in s of each sample of an even clock from jittering host stamps.

    A straight line is fitted in every ``SMOOTH_S``."""
    from scipy.signal import savgol_filter  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

    rate_hz = (len(stamps_s) - 1) / (stamps_s[-1] - stamps_s[0])
    length = min(2 * int(0.5 * SMOOTH_S * rate_hz) + 1, len(stamps_s) - (len(stamps_s) + 1) % 2)
    smooth = np.asarray(savgol_filter(stamps_s, length, 1), dtype=np.float64)
    # late stamps that are caught up with can bend the line backwards by less than a sample
    least = 0.05 / rate_hz
    return np.maximum.accumulate(smooth - least * np.arange(len(smooth))) + least * np.arange(len(smooth))


def evenly(stamps_s: Array, values: Array, judge: Array | None = None) -> tuple[Array, float, float, tuple[str, ...]]:
    """Return ``values`` (n, k) on an even time base: samples, rate, time of the first, and notes on what was done.

    The longest stretch without a gap is used. ``judge`` (n, j), default ``values``, is the signal by which the stamps
    are believed or taken as jitter of the transport (``stamp_share``). Raises ValueError for stamps that run backwards,
    are not finite, or are all the same.
    """
    from scipy.interpolate import CubicSpline  # pyright: ignore[reportMissingTypeStubs]

    notes: list[str] = []
    step = np.diff(stamps_s)
    if len(stamps_s) < 2 or not np.all(np.isfinite(stamps_s)) or np.any(step < 0.0):
        at = int(np.argmin(step)) + 1 if len(step) else 0
        raise ValueError(f"time runs backwards or is no number at sample {at}; sort the rows")
    gap_s = max(0.1, 5.0 * float(np.median(step)))
    edges = np.concatenate([[0], np.flatnonzero(step > gap_s) + 1, [len(stamps_s)]])
    longest = int(np.argmax(np.diff(edges)))
    first, last = int(edges[longest]), int(edges[longest + 1])
    if len(edges) > 2:
        notes.append(f"{len(edges) - 2} gap(s): used {stamps_s[first]:.2f} s to {stamps_s[last - 1]:.2f} s")
    stamps, kept, seen = stamps_s[first:last], values[first:last], (values if judge is None else judge)[first:last]
    steps = np.diff(stamps)
    if len(stamps) < 2 or stamps[-1] == stamps[0]:
        raise ValueError("all samples have the same time")
    if float(np.std(steps)) < 0.02 * float(np.mean(steps)):
        times = stamps
    elif len(stamps) > 5 and (share := stamp_share(stamps, seen)) < 0.5:
        times = steady_stamps(stamps)
        late_ms = 1e3 * float(np.std(stamps - times))
        notes.append(
            f"time stamps jitter by {late_ms:.1f} ms rms, the samples do not (share {share:.2f}): "
            "taken as an even clock"
        )
    else:
        apart = np.concatenate([[True], steps > 0.0])
        if not apart.all():
            notes.append(f"{np.count_nonzero(~apart)} samples with a repeated time stamp left out")
        times, kept = stamps[apart], kept[apart]
    rate_hz = (len(times) - 1) / float(times[-1] - times[0])
    grid = times[0] + np.arange(len(times)) / rate_hz
    if float(np.max(np.abs(times - grid))) * rate_hz > 1e-3:
        kept = np.asarray(CubicSpline(times, kept, axis=0)(np.minimum(grid, times[-1])), dtype=np.float64)
    return kept, rate_hz, float(times[0]), tuple(notes)
