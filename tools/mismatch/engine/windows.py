"""Finds when a mismatch is worst: the residual's energy in blocks, cut into windows of constant level."""

from __future__ import annotations

import itertools

import numpy as np

from hal.arrays import Array


def change_points(x: Array, penalty: float | None = None) -> list[int]:
    """Return the edges (0 and len included) of the best piecewise constant fit of ``x`` (b,).

    Optimal partitioning (Jackson et al., IEEE Signal Processing Letters 12, 2005) with a penalty per segment of
    3 log(b) noise variances; the noise from first differences.
    """
    b = x.size
    if b < 4:
        return [0, b]
    variance = (1.4826 * float(np.median(np.abs(np.diff(x)))) / np.sqrt(2)) ** 2
    variance = max(variance, 1e-4 * float(np.var(x)), 1e-300)
    cost_of_one = (penalty if penalty is not None else 3.0 * np.log(b)) * variance
    s1 = np.concatenate(([0.0], np.cumsum(x)))
    s2 = np.concatenate(([0.0], np.cumsum(x**2)))
    best = np.full(b + 1, np.inf)
    best[0] = -cost_of_one
    previous = np.zeros(b + 1, int)
    for stop in range(1, b + 1):
        start = np.arange(stop)
        cost = s2[stop] - s2[start] - (s1[stop] - s1[start]) ** 2 / (stop - start)
        total = best[start] + cost + cost_of_one
        previous[stop] = int(np.argmin(total))
        best[stop] = total[previous[stop]]
    edges = [b]
    while edges[-1] > 0:
        edges.append(int(previous[edges[-1]]))
    return edges[::-1]


EVERYWHERE = 0.8
"""Share of the record above the noise from which only the loudest windows are named."""
MOST_ENERGY = 0.8
"""Share of the energy above the noise that the loudest windows contain."""


def bad_windows(e: Array, noise_rms: float, dt: float, *, blocks: int = 96) -> list[tuple[float, float]]:
    """Return the windows (start_s, stop_s) in which the residual ``e`` (n,) exceeds its noise.

    Neighbouring windows above are joined. Where more than ``EVERYWHERE`` of the record is above, the loudest segments
    that hold ``MOST_ENERGY`` of the excess; the whole record is one window only when it is as loud throughout.
    """
    n = e.size
    blocks = max(4, min(blocks, n // 16))
    edges = np.linspace(0, n, blocks + 1).astype(int)
    energy = np.array([float(np.mean(e[a:b] ** 2)) for a, b in itertools.pairwise(edges)])
    level = np.log(np.maximum(energy, (0.05 * noise_rms) ** 2 + 1e-300))
    segments = list(itertools.pairwise(change_points(level)))
    threshold = np.log(1.3 * noise_rms**2) if noise_rms > 0 else float(np.median(level))
    above = [s for s in segments if float(np.log(np.mean(np.exp(level[s[0] : s[1]])))) > threshold]
    if sum(b - a for a, b in above) > EVERYWHERE * blocks:
        loud = _loudest(energy, noise_rms)
        if sum(b - a for a, b in loud) <= EVERYWHERE * blocks:
            above = loud
    out: list[tuple[float, float]] = []
    for a, b in above:
        start, stop = float(edges[a] * dt), float(edges[b] * dt)
        if out and abs(out[-1][1] - start) < 1e-9:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out


def _loudest(energy: Array, noise_rms: float) -> list[tuple[int, int]]:
    """Return runs of blocks [start, stop), as few as contain ``MOST_ENERGY`` of the excess over the noise.

    A single quieter block between two of them is included.
    """
    excess = np.maximum(energy - noise_rms**2, 0.0)
    order = np.argsort(-excess, kind="stable")
    needed = int(np.searchsorted(np.cumsum(excess[order]), MOST_ENERGY * excess.sum())) + 1
    chosen = np.zeros(energy.size, bool)
    chosen[order[:needed]] = True
    chosen[1:-1] |= chosen[:-2] & chosen[2:]
    ends = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(ends[::2], ends[1::2], strict=True)]
