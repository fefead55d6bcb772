"""Computes features of every recorded signal that a residual may follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from hal.arrays import Array
from hal.compiled import kernel


@dataclass(frozen=True)
class Feature:
    """Holds ``columns`` (n, k), of which a flexible curve of the feature is a linear combination.

    ``memory`` says that the feature needs more than the present value and rate of recorded signals.
    """

    signal: str
    kind: str
    columns: Array
    memory: bool = False


def side_by_side(signals: Sequence[Array]) -> Array:
    """Stack k signals (n,) to (n, k), each contiguous: filters and sums of products pass along a signal."""
    return np.stack(signals).T


def curve(x: Array, knots: int = 7) -> Array:
    """Return columns (n, k) that span piecewise linear curves of ``x`` (n,): the value and hinges at its quantiles."""
    spread = float(np.std(x))
    if spread <= 1e-12 * max(float(np.max(np.abs(x))), 1e-300):
        return np.empty((x.size, 0))
    z = (x - x.mean()) / spread
    levels = np.unique(np.round(z[:: max(1, z.size // 5000)], 9))
    if levels.size <= 8:
        return side_by_side([(np.abs(z - v) < 1e-6).astype(float) for v in levels[1:]])
    spots = np.unique(np.quantile(z, np.linspace(0.08, 0.92, knots)))
    columns = [z, *(np.maximum(z - s, 0.0) for s in spots[:-1])]
    return side_by_side(columns)


def rate_of(x: Array, dt: float, width: int = 1) -> Array:
    """Return the rate (n,) of ``x`` by differences over ``width`` samples either way."""
    if width <= 1:
        return np.gradient(x, dt)
    padded = np.concatenate([np.full(width, x[0]), x, np.full(width, x[-1])])
    return (padded[2 * width :] - padded[: -2 * width]) / (2 * width * dt)


def recent_mean(x: Array, seconds: float, dt: float) -> Array:
    """Return the exponentially weighted mean (n,) of the past of ``x``, starting in equilibrium."""
    a = float(np.exp(-dt / seconds))
    return lfilter([1 - a], [1, -a], x, zi=np.array([a * x[0]]))[0]


@kernel
def last_reversal(x, band):
    """Return the value (n,) of ``x`` at its last reversal of more than ``band``, which is the memory of a loop."""
    out = np.empty_like(x)
    extreme = held = x[0]
    direction = 0
    for i in range(x.size):
        v = x[i]
        if direction == 0:
            if abs(v - extreme) > band:
                direction, extreme = (1 if v > extreme else -1), v
        elif (v - extreme) * direction > 0:
            extreme = v
        elif (extreme - v) * direction > band:
            held, extreme, direction = extreme, v, -direction
        out[i] = held
    return out


def envelope(x: Array, seconds: float, dt: float) -> Array:
    """Return the slow amplitude (n,) of ``x``: weighted rms about its weighted mean."""
    fluctuation = x - recent_mean(x, 3 * seconds, dt)
    return np.sqrt(np.maximum(recent_mean(fluctuation**2, seconds, dt), 0.0))


def local_frequency(x: Array, seconds: float, dt: float) -> Array:
    """Return the local centre frequency (n,), Hz: weighted rms of the rate over that of the value."""
    rate = rate_of(x, dt)
    return envelope(rate, seconds, dt) / (2 * np.pi * np.maximum(envelope(x, seconds, dt), 1e-12 * np.std(x) + 1e-300))


def standard(x: Array) -> Array:
    """Return ``x`` (n,) less its mean, over its deviation."""
    return (x - x.mean()) / (np.std(x) or 1.0)


def alike(a: Array, b: Array) -> bool:
    """Return True if two standardised signals (n,) are nearly equal (correlation beyond 0.99)."""
    return abs(float(np.mean(a * b))) > 0.99


def _moves(x: Array) -> bool:
    return bool(np.std(x) > 1e-9 * max(float(np.max(np.abs(x))), 1e-300))


def features_of(
    signals: Mapping[str, Array], dt: float, *, pairs: bool = True, drive: str = "", motion: str = ""
) -> list[Feature]:
    """Return every feature to be tested; ``signals`` (n,) each.

    Per signal these are value, rate, acceleration, sign of rate, square, last reversal, recent history, amplitude and
    frequency; further products of two signals, and time itself. A gain that depends on a signal is a curve of that
    signal times ``drive`` or ``motion`` (the plant's own course): its ``kind`` is "cross product" and its signal the
    one that sets the gain.
    """
    out: list[Feature] = []
    names = [k for k, v in signals.items() if _moves(v)]
    n = next(iter(signals.values())).size if signals else 0
    duration = n * dt
    for name in names:
        x = signals[name]
        z = (x - x.mean()) / np.std(x)
        rate = rate_of(z, dt)
        out.append(Feature(name, "value", curve(z)))
        out.append(Feature(name, "square", (z**2)[:, None]))
        if np.mean(np.abs(rate) > 1e-9) > 0.02:
            scale = np.std(rate)
            out.append(Feature(name, "rate", curve(rate)))
            out.append(Feature(name, "sign of rate", np.tanh(rate / (0.1 * scale))[:, None]))
            out.append(Feature(name, "acceleration", curve(rate_of(rate, dt), 4)))
            out.append(Feature(name, "running extremum", curve(last_reversal(z, 0.05), 4), memory=True))
        history = [z - recent_mean(z, s, dt) for s in _times(dt, duration)]
        history += [recent_mean(np.abs(z), s, dt) for s in _times(dt, duration)]
        out.append(Feature(name, "recent history", side_by_side(history), memory=True))
        slow = max(20 * dt, duration / 60)
        out.append(Feature(name, "amplitude", curve(envelope(z, slow, dt), 4), memory=True))
        out.append(Feature(name, "frequency", curve(local_frequency(z, slow, dt), 4), memory=True))
    if pairs:
        for i, a in enumerate(names):
            for b in names[i + 1 :]:
                movers = (drive, motion)
                gain_by, other = (b, a) if a in movers or b not in movers else (a, b)
                za, zb = standard(signals[gain_by]), standard(signals[other])
                moved = other in movers and gain_by not in movers
                columns = curve(za, 5) * zb[:, None] if moved else (za * zb)[:, None]
                out.append(Feature(gain_by, "cross product", columns))
                if moved:
                    slope = standard(rate_of(zb, dt))
                    out.append(Feature(gain_by, "cross product with rate", curve(za, 5) * slope[:, None]))
    if n:
        phase = np.linspace(0, 1, n)
        waves = side_by_side([np.cos(np.pi * k * phase) for k in range(1, 7)])
        out.append(Feature("time", "time itself", waves))
        if drive in names and pairs:
            out.append(Feature("time", "cross product", waves * standard(signals[drive])[:, None]))
    return [f for f in out if f.columns.shape[1] > 0 and np.all(np.isfinite(f.columns))]


def _times(dt: float, duration: float) -> list[float]:
    times: list[float] = []
    s = 4 * dt
    while s < duration / 6:
        times.append(s)
        s *= 6
    return times or [2 * dt]
