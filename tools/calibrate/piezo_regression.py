"""Fits all parameters of a stack's model that enter linearly, by one bounded least squares.

z = z0 + S(W . H[u]) + creep is not linear in its parameters, but S^-1(z - z0 - creep) = W . H is (Kuhnen): dead-zone
slopes of the inverse, slopes W_i at rest and at the highest rate, and creep shares are found together. The unknowns
are the slopes themselves (partial sums of the weights), so a lower bound on each keeps the inverse valid between the
two rates (erratum 74). Creep follows the stroke, which is corrected by the last solution: three passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from firmware_py.actuation.config import StackConfig
from firmware_py.actuation.hysteresis import inverse_thresholds, inverse_weights
from hal.arrays import Array
from hal.compiled import kernel

LEAST_SLOPE = 0.05  # smallest slope, relative to the mean one
LEAST_ZONE = 0.5  # slope of a zone, relative to the first; a stack bends by some percent
PASSES = 3


@dataclass(frozen=True)
class Shape:
    """Holds the structure of the model: thresholds as fractions of half the drive's (plays) and of the displacement's
    range (zones).

    ``rate``: slopes depend on the rate; ``rate_low_um_per_s`` and ``rate_high_um_per_s`` (for the first two slopes)
    are where that law is held, Ang 2004 Fig. 7.11.
    """

    plays: tuple[float, ...]
    zones: tuple[float, ...] = ()
    creep_times_s: tuple[float, ...] = ()
    rate: bool = False
    rate_low_um_per_s: float = 0.0
    rate_high_um_per_s: float = np.inf


@dataclass(frozen=True)
class Piece:
    """Holds one recording ready to be fitted: drive V as the stack sees it, displacement um, its rate um/s, usable
    rows.

    ``response``: how the displacement follows a held stroke, weights of this and earlier samples.
    """

    drive: Array
    z: Array
    rate: Array
    rows: slice
    dt: float
    response: Array


@dataclass(frozen=True)
class Axes:
    """Thresholds in V and um, and what the rates are scaled by: the same for all pieces of one stack."""

    r: Array
    d: Array
    centre_V: float
    top_rate: float
    span_um: float
    slope: float


@dataclass(frozen=True)
class Solution:
    """Slopes um/V at rest and at ``top_rate``, slopes T_j of the inverse above each zone, creep shares."""

    rest: Array
    top: Array
    zones: Array
    creep: Array


@kernel
def play_states(drive: Array, r: Array, centre_V: float) -> Array:
    """(n, len(r)) outputs of the play operators on ``drive - centre_V``, for a drive that came up from 0 V."""
    out = np.empty((len(drive), len(r)))
    y = np.maximum(drive[0] - r, 0.0) - centre_V
    for k in range(len(drive)):
        x = drive[k] - centre_V
        for i in range(len(r)):
            y[i] = max(x - r[i], min(x + r[i], y[i]))
            out[k, i] = y[i]
    return out


def low_pass(x: Array, tau_s: float, dt: float) -> Array:
    """Return ``x`` (n,) through a first-order lag that rests at ``x[0]``, as the firmware's creep element."""
    keep = np.exp(-dt / tau_s)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x - x[0]), dtype=np.float64)


def axes_of(pieces: Sequence[Piece], shape: Shape, centre_V: float) -> Axes:
    """Return the thresholds that these pieces excite."""
    low, high = min(p.drive.min() for p in pieces), max(p.drive.max() for p in pieces)
    floor, top = min(p.z.min() for p in pieces), max(p.z.max() for p in pieces)
    rates = np.concatenate([p.rate[p.rows] for p in pieces])
    return Axes(
        r=0.5 * (high - low) * np.array(shape.plays),
        d=floor + (top - floor) * np.array(shape.zones),
        centre_V=centre_V,
        top_rate=float(np.quantile(rates, 0.995)),
        span_um=float(top - floor),
        slope=float((top - floor) / (high - low)),
    )


def _columns(piece: Piece, x: Array, shape: Shape, axes: Axes) -> Array:
    """Return the regressors (rows, unknowns): slopes at rest, slopes at the top rate, zones, creep."""
    h = play_states(piece.drive, axes.r, axes.centre_V)
    steps = h.copy()
    steps[:, :-1] -= h[:, 1:]
    if shape.rate:
        rate = np.maximum(piece.rate, shape.rate_low_um_per_s)[:, None]
        share = np.repeat(rate, len(axes.r), axis=1)
        share[:, :2] = np.minimum(share[:, :2], shape.rate_high_um_per_s)
        share /= axes.top_rate
        steps = np.concatenate([steps * (1.0 - share), steps * share], axis=1)
    if len(piece.response) > 1:
        first = steps[0].copy()
        steps = first + np.asarray(lfilter(piece.response, [1.0], steps - first, axis=0), dtype=np.float64)
    zones = np.maximum(x[:, None] - axes.d, 0.0)
    # zones as partial sums of slopes above 1: sum_j (T_j - T_(j-1)) S_j, T_0 = 1
    zones[:, :-1] -= zones[:, 1:]
    creep = [low_pass(x, tau, piece.dt) for tau in shape.creep_times_s]
    return np.column_stack([steps, -zones, *creep])[piece.rows]


def _target(piece: Piece, x: Array, axes: Axes) -> Array:
    """T_0 = 1 below the first zone is not an unknown: its part goes to this side."""
    first = np.maximum(x[piece.rows] - axes.d[0], 0.0) if len(axes.d) else 0.0
    return piece.z[piece.rows] - first


def local_slope(x: Array, axes: Axes, zones: Array) -> Array:
    """Return dS^-1/dx at ``x`` (n,): the factor of an error of the displacement in these equations."""
    return np.concatenate([[1.0], zones])[np.searchsorted(axes.d, x)] if len(axes.d) else np.ones(len(x))


def triangle(piece: Piece, x: Array, shape: Shape, axes: Axes, zones: Array) -> Array:
    """Return the piece's equations as a triangle. Its zero is eliminated, and every piece has the same weight. ``x``:
    (n,) stroke without creep, um. ``zones``: slopes T_j so far; rows are divided by them, so that an error counts in um
    of displacement: unweighted, a fit would flatten S^-1 to make its errors small."""
    both = np.column_stack([_columns(piece, x, shape, axes), _target(piece, x, axes)])
    weight = 1.0 / local_slope(x[piece.rows], axes, zones)
    both *= weight[:, None]
    both -= weight[:, None] * (weight @ both / (weight @ weight))
    return np.asarray(np.linalg.qr(both / np.sqrt(len(both)), mode="r"), dtype=np.float64)


def solve(triangles: Sequence[Array], shape: Shape, axes: Axes) -> Solution:
    """Solve the bounded least squares over the pieces' triangles. Return the unknowns (n,)."""
    stack = np.vstack(triangles)
    n, m, k = len(axes.r), len(axes.d), len(shape.creep_times_s)
    slopes = 2 * n if shape.rate else n
    low = np.concatenate([np.full(slopes, LEAST_SLOPE * axes.slope), np.full(m, LEAST_ZONE), np.zeros(k)])
    high = np.concatenate([np.full(slopes, 20.0 * axes.slope), np.full(m, 1.0 / LEAST_ZONE), np.full(k, 0.15)])
    scale = np.linalg.norm(stack[:, :-1], axis=0)
    scale[scale == 0.0] = 1.0
    result: Any = lsq_linear(stack[:, :-1] / scale, stack[:, -1], bounds=(low * scale, high * scale))
    x: Array = np.asarray(result.x, dtype=np.float64) / scale
    rest = x[:n]
    top = x[n:slopes] if shape.rate else rest
    return Solution(rest, top, x[slopes : slopes + m], x[slopes + m :])


def without_creep(piece: Piece, shape: Shape, solution: Solution) -> Array:
    """Return the strokes (n,) of the piece in um without creep. Two passes suffice, because creep is a few percent."""
    x = piece.z
    for _ in range(2):
        creep = np.zeros(len(x))
        for share, tau in zip(solution.creep, shape.creep_times_s, strict=True):
            creep += share * low_pass(x, tau, piece.dt)
        x = piece.z - creep
    return x


def residual(piece: Piece, shape: Shape, axes: Axes, solution: Solution) -> Array:
    """Return the residual (n,) of the piece's rows, in um of displacement. Its mean is the displacement's zero."""
    x = without_creep(piece, shape, solution)
    slopes = [solution.rest, solution.top] if shape.rate else [solution.rest]
    values = np.concatenate([*slopes, solution.zones, solution.creep])
    e = _target(piece, x, axes) - _columns(piece, x, shape, axes) @ values
    # around its own mean, which is a shift before the zones and no error
    return e.mean() + (e - e.mean()) / local_slope(x[piece.rows], axes, solution.zones)


def fit(
    pieces: Sequence[Piece],
    shape: Shape,
    axes: Axes,
    folds: Sequence[Sequence[int]],
    partials: list[Solution] | None = None,
) -> tuple[Solution, Array]:
    """Return the solution from all ``pieces``, and (len(pieces),) rms of each when its fold had not been seen, um.

    ``partials`` collects the solutions without each fold. ``folds``: indices that are held out together.
    """
    xs = [piece.z for piece in pieces]
    zones = np.ones(len(axes.d))
    triangles: list[Array] = []
    solution = None
    for _ in range(PASSES if shape.creep_times_s or shape.zones else 1):
        triangles = [triangle(piece, x, shape, axes, zones) for piece, x in zip(pieces, xs, strict=True)]
        solution = solve(triangles, shape, axes)
        zones = solution.zones
        xs = [without_creep(piece, shape, solution) for piece in pieces]
    assert solution is not None
    unseen = np.full(len(pieces), np.nan)
    for fold in folds:
        partial = solve([t for i, t in enumerate(triangles) if i not in fold], shape, axes)
        if partials is not None:
            partials.append(partial)
        for i in fold:
            unseen[i] = np.std(residual(pieces[i], shape, axes, partial))
    return solution, unseen


def stack_of(solution: Solution, shape: Shape, axes: Axes, zero_um: float) -> StackConfig:
    """The firmware's numbers. ``zero_um``: z of the pieces where W . H[u] and creep are zero."""
    n = len(axes.r)
    offset = zero_um - float(solution.rest[-1]) * axes.centre_V
    level = max(0.0, 1.0 - float(np.min(axes.d - offset))) if len(axes.d) else 0.0
    offset -= level
    d = np.concatenate([[0.0], axes.d - offset])
    s = np.concatenate([[1.0], np.diff(solution.zones, prepend=1.0)])
    high = (shape.rate_high_um_per_s,) * 2 + (np.inf,) * (n - 2)
    limited = shape.rate and np.isfinite(shape.rate_high_um_per_s)
    return StackConfig(
        play_thresholds_V=tuple(map(float, axes.r)),
        play_weights_um_per_V=tuple(map(float, np.diff(solution.rest, prepend=0.0))),
        # the zones were found for the inverse; transforming an inverse gives the forward operator back
        dead_zone_thresholds_um=tuple(map(float, inverse_thresholds(d, s))),
        dead_zone_weights=tuple(map(float, inverse_weights(s))),
        offset_um=offset,
        level_um=level,
        centre_V=axes.centre_V,
        slope_per_rate_s_per_V=(
            tuple(map(float, (solution.top - solution.rest) / axes.top_rate)) if shape.rate else ()
        ),
        rate_low_um_per_s=shape.rate_low_um_per_s,
        rate_high_um_per_s=tuple(float(min(v, 1e6)) for v in high) if limited else (),
        least_slope_um_per_V=0.5 * LEAST_SLOPE * axes.slope,
        creep_times_s=shape.creep_times_s,
        creep_shares=tuple(map(float, solution.creep)),
    )
