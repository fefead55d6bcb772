"""Still intervals of a hand-turned log (Tedaldi et al., ICRA 2014, sec. IV), and whether the sensor is warm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from hal.arrays import Array
from tools.errors import InputError

FACTORS = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 36.0)


@dataclass(frozen=True)
class StillPoses:
    """``mean`` (n, 3) of each interval, its ``samples`` (n,), ``bounds`` (n, 2) and the threshold that found them."""

    mean: Array
    samples: NDArray[np.int64]
    bounds: NDArray[np.int64]
    threshold: float


def spread(signal: Array, window: int) -> Array:
    """(n,) rms over the three axes of the moving standard deviation over ``window`` samples, centred."""
    padded = np.pad(signal - signal.mean(axis=0), ((window // 2, window - 1 - window // 2), (0, 0)), mode="edge")
    first = np.cumsum(np.vstack([np.zeros(3), padded]), axis=0)
    second = np.cumsum(np.vstack([np.zeros(3), padded**2]), axis=0)
    mean = (first[window:] - first[:-window]) / window
    variance = np.maximum((second[window:] - second[:-window]) / window - mean**2, 0.0)
    return np.sqrt(variance.sum(axis=1))


def find_poses(signal: Array, window: int, threshold: float, shortest: int) -> StillPoses:
    """Return the runs of at least ``shortest`` samples of ``raw`` (n, 3) whose moving spread stays below
    ``threshold``."""
    still = np.concatenate([[False], spread(signal, window) < threshold, [False]])
    edges = np.flatnonzero(np.diff(still.astype(np.int8)))
    bounds = edges.reshape(-1, 2)
    bounds = bounds[bounds[:, 1] - bounds[:, 0] >= shortest]
    mean = np.array([signal[a:b].mean(axis=0) for a, b in bounds]).reshape(-1, 3)
    return StillPoses(mean, bounds[:, 1] - bounds[:, 0], bounds, threshold)


def quiet_level(signal: Array, window: int) -> float:
    """Return the moving spread of the sensor (n, 3) at rest: its lowest tenth."""
    return float(np.quantile(spread(signal, window), 0.1))


@dataclass(frozen=True)
class WarmUp:
    """Holds the warm-up of a signal. It is ``steady`` if the change to come (``remaining``, in its unit) is below the
    tolerance."""

    steady: bool
    remaining: float
    tolerance: float
    time_constant_s: float

    def text(self) -> str:
        """Return one line for a report."""
        if self.steady:
            return f"warm-up: steady ({self.remaining:.3g} to come, {self.tolerance:.3g} allowed)"
        return f"warm-up: {self.remaining:.3g} still to come ({self.tolerance:.3g} allowed): drift fitted and removed"


DRIFT_TOLERANCE = 2e-3
"""Tolerance as a fraction of the sensor's reach (about 1 g): 2 mg."""
LARGEST_DRIFT = 0.25
"""Fraction of that reach. A larger change during a rest is a slow turn and no drift."""
FIRST_REST_S = 20.0


def remove_drift(raw: Array, rate_hz: float, *, allowed: bool, reach: float | None = None) -> tuple[Array, WarmUp]:
    """``raw`` (n, 3) with the drift that its first rest shows taken off, if ``allowed``; InputError if it is not.

    A log whose first rest is shorter than 20 s cannot show a drift and is taken as steady. ``reach`` is what 1 g reads;
    without it half the range of the log, which is turned up and down.
    """
    window = max(5, round(0.5 * rate_hz))
    level = quiet_level(raw, window)
    rest = find_poses(raw, window, 3.0 * level, round(FIRST_REST_S * rate_hz)) if level > 0.0 else None
    tolerance = DRIFT_TOLERANCE * (float(np.max(np.ptp(raw, axis=0))) / 2.0 if reach is None else reach)
    if rest is None or len(rest.bounds) == 0:
        return raw, WarmUp(True, 0.0, tolerance, float("inf"))
    first, last = rest.bounds[0]
    means = [part.mean(axis=0) for part in np.array_split(raw[first:last], 16)]
    if reach is None and float(np.ptp(means, axis=0).max()) > LARGEST_DRIFT / DRIFT_TOLERANCE * tolerance:
        return raw, WarmUp(True, 0.0, tolerance, float("inf"))
    t = np.arange(len(raw)) / rate_hz
    warm_ups = [warm_up(t[first:last], raw[first:last, i], tolerance) for i in range(3)]
    worst = max(warm_ups, key=lambda w: abs(w.remaining))
    if all(w.steady for w in warm_ups):
        return raw, worst
    if not allowed:
        raise InputError(
            f"the sensor is still warming up: {worst.remaining:.3g} to come, {worst.tolerance:.3g} is allowed; "
            "wait and record again, or give --drift fit"
        )
    out = raw.copy()
    span = t[last - 1] - t[first]
    constant, to_come = common_warm_up(t[first:last], raw[first:last])
    for i, w in enumerate(warm_ups):
        if w.steady:
            continue
        if constant <= 3.0 * span:
            # the change still to come at the end of the rest, extrapolated along the exponential
            out[:, i] += to_come[i] * np.exp(-(t - t[last - 1]) / constant)
        else:
            out[:, i] -= w.remaining / span * (t - t[last - 1])
    return out, worst


def common_warm_up(t_s: Array, value: Array) -> tuple[float, Array]:
    """Time constant in s, and what each column of ``value`` (n, m) at rest has still to go when ``t_s`` (n,) ends.

    The axes are in one package and warm up together: one time constant for all is known far better than one for each.
    """
    blocks = min(64, len(t_s))
    t = np.array([part.mean() for part in np.array_split(t_s, blocks)])
    v = np.array([part.mean(axis=0) for part in np.array_split(value, blocks)])
    span = t_s[-1] - t_s[0]
    best, constant, to_come = np.inf, np.inf, np.zeros(value.shape[1])
    for tau in np.geomspace(span / 20.0, 20.0 * span, 240):
        shape = np.column_stack([np.ones(blocks), np.exp(-(t - t_s[-1]) / tau)])
        weights = np.linalg.lstsq(shape, v)[0]
        left = float(np.sum((v - shape @ weights) ** 2))
        if left < best:
            best, constant, to_come = left, float(tau), -weights[1]
    return constant, to_come


def warm_up(t_s: Array, value: Array, tolerance: float) -> WarmUp:
    """Decide if ``value`` (n,) at rest has settled: an exponential is fitted and extrapolated to its end.

    A drift that a straight line describes as well as the exponential has no end in sight: what it would still do in
    another recording of this length counts.
    """
    if len(t_s) < 8:
        raise ValueError(f"{len(t_s)} points: at least 8 are needed to see a drift")
    # 64 blocks: the fit should see the drift, not the noise
    blocks = min(64, len(t_s))
    t = np.array([part.mean() for part in np.array_split(t_s, blocks)])
    v = np.array([part.mean() for part in np.array_split(value, blocks)])
    span = t[-1] - t[0]
    line = np.polyfit(t, v, 1)
    left_over = v - np.polyval(line, t)
    error = np.std(left_over, ddof=2) / np.sqrt(np.sum((t - t.mean()) ** 2))
    if abs(line[0]) < 3.0 * error:
        return WarmUp(True, 0.0, tolerance, float("inf"))

    def settle(x: Array, end: float, start: float, constant: float) -> Array:
        return end + (start - end) * np.exp(-(x - t[0]) / constant)

    try:
        (end, start, constant), _ = curve_fit(
            settle,
            t,
            v,
            p0=(v[-1], v[0], span / 2.0),
            bounds=((-np.inf, -np.inf, span / 20.0), (np.inf, np.inf, 20.0 * span)),
        )
    except RuntimeError:
        return WarmUp(abs(line[0]) * span < tolerance, float(line[0] * span), tolerance, float("inf"))
    if constant > 3.0 * span:
        remaining = float(line[0] * span)
    else:
        remaining = float((end - start) * np.exp(-span / constant))
    return WarmUp(abs(remaining) < tolerance, remaining, tolerance, float(constant))
