"""Small statistics for guesses and signature tests: residuals are coloured, so every null here allows for that."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from sim_devices.physics.effect import Array

Bool = NDArray[np.bool_]
Start = TypeVar("Start", bound=tuple[float, ...])


def robust_rms(x: Array) -> float:
    """Return 1.4826 times the median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(x - np.median(x)))) if x.size else 0.0


def runs(mask: Bool) -> list[tuple[int, int]]:
    """Return the stretches [start, stop) where the mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def autoregression(x: Array, order: int) -> Array:
    """Return coefficients a (order + 1,), a[0] = 1, that filter x into its innovations (Yule-Walker)."""
    n = x.size
    if n < 4 * order or order < 1:
        return np.ones(1)
    size = 1 << int(np.ceil(np.log2(2 * n)))
    f = np.fft.rfft(x - x.mean(), size)
    r = np.asarray(np.fft.irfft(f * np.conj(f), size)[: order + 1] / n, np.float64)
    if r[0] <= 0:
        return np.ones(1)
    r[0] *= 1 + 1e-6
    return np.concatenate([[1.0], -np.asarray(solve_toeplitz(r[:-1], r[1:]))])


def whiten(x: Array, mask: Bool | None = None, order: int = 10) -> Array:
    """Return the innovations (n,) of x by an autoregression fitted where the mask is true; 0 at the start of a run."""
    stretches = runs(np.ones(x.size, np.bool_) if mask is None else mask)
    longest = max(stretches, key=lambda s: s[1] - s[0], default=(0, 0))
    a = autoregression(np.clip(x[slice(*longest)], *_fences(x[slice(*longest)])), order)
    out = np.zeros_like(x)
    for b, e in stretches:
        w = np.asarray(lfilter(a, 1.0, x[b:e]), np.float64)
        w[: a.size - 1] = 0.0
        out[b:e] = w
    return out


def _fences(x: Array) -> tuple[float, float]:
    if x.size == 0:
        return (-np.inf, np.inf)
    m, s = float(np.median(x)), robust_rms(x)
    return (m - 6 * s, m + 6 * s) if s > 0 else (-np.inf, np.inf)


def jumps(x: Array) -> NDArray[np.int64]:
    """Return the samples at which an otherwise smooth signal jumps, such as a staircase or a sawtooth's flyback."""
    d = np.abs(np.diff(x))
    if d.size == 0:
        return np.zeros(0, np.int64)
    return np.flatnonzero(d > max(10.0 * float(np.quantile(d, 0.9)), 0.02 * float(np.ptp(x)))) + 1


def after_jumps(signals: Iterable[Array], n: int, most: float = 0.2) -> Bool:
    """Return a mask (n,) that is true in a short stretch after each jump of any signal and one sample before it.

    All stretches together cover at most about ``most`` of the record.
    """
    out = np.zeros(n, np.bool_)
    every = [j for x in signals for j in jumps(x)]
    if not every:
        return out
    width = int(np.clip(most * n / len(every), 2, 50))
    for j in every:
        out[max(0, j - 1) : j + width] = True
    return out


BLOCKS = (64, 32, 16)
"""Numbers of blocks from which a long-run variance is estimated."""


def long_run_rms(x: Array) -> float:
    """Return the square root of the spectral density at zero, per sample, from differences of adjacent block means.

    Steps and drifts hardly change it, because the estimate is robust against one of many differences. Blocks shorter
    than the memory of ``x`` underestimate it, so the largest over several block lengths is returned (blocking: H.
    Flyvbjerg, H. G. Petersen, J. Chem. Phys. 91, 1989, 461).
    """
    found = [_by_blocks(x, max(1, x.size // blocks)) for blocks in BLOCKS]
    return max((f for f in found if f is not None), default=float(np.std(x)))


def _by_blocks(x: Array, length: int) -> float | None:
    m = x[: (x.size // length) * length].reshape(-1, length).mean(axis=1)
    d = np.diff(m)
    return robust_rms(d) / np.sqrt(2.0) * np.sqrt(length) if d.size > 3 else None


def least_squares(columns: Array, y: Array, ridge: float = 1e-10) -> tuple[Array, float]:
    """Return coefficients and residual sum of squares; columns (n, k) are scaled first, ``ridge`` is relative."""
    size = np.sqrt(np.sum(columns * columns, axis=0))
    size[size == 0] = 1.0
    q = columns / size
    gram = q.T @ q
    gram[np.diag_indices_from(gram)] += ridge
    w = np.linalg.solve(gram, q.T @ y)
    r = y - q @ w
    return w / size, float(r @ r)


def signed_least_squares(columns: Array, y: Array, signs: Array, ridge: float = 1e-10) -> Array:
    """Return the least-squares coefficients whose signs are ``signs`` (k,) or which are zero; 0 leaves one free.

    C. L. Lawson, R. J. Hanson, Solving Least Squares Problems (1974), chapter 23.
    """
    size = np.sqrt(np.sum(columns * columns, axis=0))
    size[size == 0] = 1.0
    q = columns / size
    gram = q.T @ q
    gram[np.diag_indices_from(gram)] += ridge
    low, high = np.where(signs > 0.0, 0.0, -np.inf), np.where(signs < 0.0, 0.0, np.inf)
    return bounded_solution(gram, q.T @ y, low, high) / size


def bounded_solution(gram: Array, cross: Array, low: Array, high: Array) -> Array:
    """Return the ``w`` between ``low`` and ``high`` that minimises ``w gram w - 2 w cross`` (``gram`` > 0).

    Coefficients that leave the bounds are fixed there and the rest is solved again, until the gradient releases none
    (bounded-variable least squares: P. B. Stark, R. L. Parker, Computational Statistics 10, 1995, 129).
    """
    w = np.asarray(np.linalg.solve(gram, cross), np.float64)
    if np.all((w >= low) & (w <= high)):
        return w
    factor = np.linalg.cholesky(gram)
    return np.asarray(lsq_linear(factor.T, np.linalg.solve(factor, cross), (low, high), method="bvls").x, np.float64)


def thin(ctx_keep: Bool, at_most: int = 20_000) -> NDArray[np.int64]:
    """Return at most ``at_most`` indices where the mask is true, evenly spread."""
    index = np.flatnonzero(ctx_keep)
    return index[:: max(1, index.size // at_most)]


def smooth(x: Array, width: int) -> Array:
    """Return the centred moving average over an odd ``width``; at the edges it averages the samples that exist."""
    width = max(1, width | 1)
    if width == 1 or x.size < width:
        return x.copy()
    c = np.concatenate([[0.0], np.cumsum(x)])
    h = width // 2
    lo = np.maximum(np.arange(x.size) - h, 0)
    hi = np.minimum(np.arange(x.size) + h + 1, x.size)
    return (c[hi] - c[lo]) / (hi - lo)


def affine_misfit(candidate: Array, measured: Array, beside: Array | None = None) -> float:
    """Return the residual sum of squares of fitting ``a + b candidate`` and the columns ``beside`` to ``measured``."""
    columns = np.column_stack([np.ones(candidate.size), candidate])
    return least_squares(columns if beside is None else np.column_stack([columns, beside]), measured)[1]


def rank_starts(
    candidates: list[tuple[float, ...]],
    output_of: Callable[[tuple[float, ...]], Array],
    measured: Array,
    k: NDArray[np.int64],
    bends: Array | None = None,
) -> list[tuple[float, ...]]:
    """Rank candidates by how well their output, scaled and offset, fits the measured samples at ``k``; best first.

    ``bends`` (n, j) are columns that may be added to each. Among candidates within half a percent, the one that is
    listed first wins.
    """
    beside = None if bends is None else bends[k]
    found = [(affine_misfit(output_of(q)[k], measured[k], beside), i) for i, q in enumerate(candidates)]
    steps = [(round(float(np.log(max(f, 1e-300))) / 0.005), i) for f, i in found if np.isfinite(f)]
    return [candidates[i] for _, i in sorted(steps)] or candidates[:1]


def best_starts(
    candidates: Iterable[Start], columns_of: Callable[[Start], Array], line: Array, wanted: Array
) -> list[Start]:
    """Rank candidates by how well ``line`` (k, j) and their columns (k,) or (k, m) fit ``wanted`` (k,); best first."""
    tried = [(least_squares(np.column_stack([line, columns_of(q)]), wanted)[1], q) for q in candidates]
    return [q for _, q in sorted((misfit if np.isfinite(misfit) else np.inf, q) for misfit, q in tried)]


def value_range(x: Array) -> tuple[float, float]:
    """Return (least, largest) of x; the range is one unit wide about a constant signal."""
    lo, hi = float(x.min()), float(x.max())
    return (lo, hi) if hi > lo else (lo - 0.5, hi + 0.5)
