"""Draws families of inputs within limits: multisines, staircases, triangles, holds after steps, sweeps.

A waveform is a point ``z`` of a unit cube and a family; ``draw`` makes it obey the limits, so that a search needs none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.mismatch.plan.limits import Limits
from tools.mismatch.recording import Array

FAMILIES = ("multisine", "staircase", "triangles", "holds", "sweep", "mixed")
SIZE = {"multisine": 18, "staircase": 13, "triangles": 10, "holds": 8, "sweep": 4, "mixed": 16}
"""Number of free parameters of each family, all in 0 to 1."""


def draw(family: str, z: NDArray[np.float64], limits: Limits, dt: float) -> Array:
    """Return the waveform (n,) of ``family`` at ``z``, in the input's unit."""
    n = max(2, round(limits.duration_s / dt))
    t = np.asarray(np.arange(n) * dt, np.float64)
    return limits.centre + _limited(_SHAPES[family](np.asarray(z, np.float64), t, limits), limits, dt)


def _limited(shape: Array, limits: Limits, dt: float) -> Array:
    """Scale ``shape`` (largest magnitude 1) to the amplitude; parts that are too fast are slowed down, not reduced."""
    size = float(np.max(np.abs(shape)))
    x = shape * (limits.amplitude / size) if size > 0.0 else shape.copy()
    rms = float(np.sqrt(np.mean(x**2)))
    if rms > limits.rms:
        x *= limits.rms / rms
    step = limits.rate_per_s * dt
    if np.max(np.abs(np.diff(x, prepend=0.0))) <= step:
        return x
    out, now = np.empty_like(x), 0.0
    for i, wanted in enumerate(x.tolist()):
        now = min(max(wanted, now - step), now + step)
        out[i] = now
    return out


def _between(z: float, low: float, high: float) -> float:
    """Interpolate geometrically between two positive numbers."""
    return float(low * (high / low) ** z)


def _multisine(z: Array, t: Array, limits: Limits) -> Array:
    count = z.size // 3
    x = np.zeros(t.size)
    for a, p, f in zip(z[:count], z[count : 2 * count], z[2 * count :], strict=True):
        x += a * np.sin(2 * np.pi * (_between(f, *limits.band_hz) * t + p))
    return x


def _staircase(z: Array, t: Array, limits: Limits) -> Array:
    hold_s = _between(z[0], 1.0 / limits.band_hz[1], 0.25 * limits.duration_s)
    hold_s = max(hold_s, limits.duration_s / (8 * (z.size - 1)))
    level = 2.0 * z[1:] - 1.0
    return level[(t / hold_s).astype(np.int64) % level.size]


def _triangle(phase: Array) -> Array:
    return 2.0 * np.abs(2.0 * ((phase + 0.25) % 1.0) - 1.0) - 1.0


def _triangles(z: Array, t: Array, limits: Limits) -> Array:
    """Return two successive triangles, each with a rate, a size, a ramp of the size and an offset."""
    cut = 0.2 + 0.6 * z[0]
    here = t / t[-1]
    out = np.zeros(t.size)
    for k, part in enumerate((here < cut, here >= cut)):
        f, size, fall, offset = z[1 + 4 * k : 5 + 4 * k]
        tau = t[part] - t[part][0]
        ramp = 1.0 - fall * tau / max(float(tau[-1]), 1e-12)
        away = (2.0 * offset - 1.0) * (1.0 - size)
        out[part] = away + max(size, 0.02) * ramp * _triangle(_between(f, *limits.band_hz) * tau)
    return out


def _holds(z: Array, t: Array, limits: Limits) -> Array:
    """Return steps to levels that are held for different times."""
    count = z.size // 2
    share = 0.05 + z[:count] ** 2
    edges = np.concatenate([[0.0], np.cumsum(share / share.sum())]) * t[-1]
    level = 2.0 * z[count:] - 1.0
    return level[np.clip(np.searchsorted(edges, t, side="right") - 1, 0, count - 1)]


def _sweep(z: Array, t: Array, limits: Limits) -> Array:
    low, high = sorted((_between(z[0], *limits.band_hz), _between(z[1], *limits.band_hz)))
    high = max(high, 1.5 * low)
    frequency = low * (high / low) ** (t / t[-1])
    size = (0.2 + 0.8 * z[2]) + (z[3] - z[2]) * 0.8 * t / t[-1]
    return size * np.sin(2 * np.pi * np.cumsum(frequency) * (t[1] - t[0]))


def _mixed(z: Array, t: Array, limits: Limits) -> Array:
    """Return a staircase plus a triangle: fast small loops at many levels."""
    size = 0.05 + 0.6 * z[0]
    stairs = _staircase(z[2:], t, limits)
    return (1.0 - size) * stairs + size * _triangle(_between(z[1], *limits.band_hz) * t)


_SHAPES = {
    "multisine": _multisine,
    "staircase": _staircase,
    "triangles": _triangles,
    "holds": _holds,
    "sweep": _sweep,
    "mixed": _mixed,
}


def random_multisine(rng: np.random.Generator, limits: Limits, dt: float, energy: float | None = None) -> Array:
    """Return a multisine of random frequencies and phases in the band.

    With ``energy`` (mean square about the centre) it has exactly that energy without limits of peak and rate; a
    comparison with a planned input is then in its favour.
    """
    if energy is None:
        return draw("multisine", rng.random(SIZE["multisine"]), limits, dt)
    n = max(2, round(limits.duration_s / dt))
    t = np.asarray(np.arange(n) * dt, np.float64)
    x = _multisine(rng.random(SIZE["multisine"]), t, limits)
    x -= x.mean()
    return limits.centre + x * np.sqrt(energy / max(float(np.mean(x**2)), 1e-300))


def mean_square(x: Array, limits: Limits) -> float:
    """Return the energy of an input: its mean square about the centre."""
    return float(np.mean((x - limits.centre) ** 2))


LIBRARY: dict[str, tuple[str, tuple[float, ...]]] = {
    "a staircase": ("staircase", (0.7, *(0.5 + 0.5 * np.sin(2.4 * np.arange(12) ** 1.3)).tolist())),
    "triangles at two speeds": ("triangles", (0.6, 0.15, 1.0, 0.0, 0.5, 0.75, 0.5, 0.0, 0.5, 0.5)),
    "a shrinking triangle": ("triangles", (0.9, 0.3, 1.0, 1.0, 0.5, 0.3, 0.2, 0.5, 0.5, 0.5)),
    "long holds after steps": ("holds", (0.2, 0.9, 0.3, 0.9, 0.0, 1.0, 0.5, 0.2)),
    "a sweep": ("sweep", (0.0, 1.0, 1.0, 1.0)),
    "fast small loops at several levels": (
        "mixed",
        (0.3, 0.8, 0.6, *(0.5 + 0.5 * np.sin(3.1 * np.arange(13))).tolist()),
    ),
}
"""Inputs that a person can describe, by their descriptions."""
