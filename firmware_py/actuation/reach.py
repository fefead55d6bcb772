"""Finds the nearest reachable tip position, which is commanded when the wanted one is beyond the strokes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.manipulator import tip_from_strokes, tip_jacobian
from firmware_py.records import Record
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch, scratch_index, scratch_matrix

# Gauss-Newton steps: each leaves about distance / shaft length of the last (a percent for half a millimetre)
REACH_PASSES = 4


@kernel
def inside(strokes: Array, low: Array, high: Array) -> bool:
    """Return True if every stroke (m from neutral) is in its range. A stroke that is not finite is outside."""
    good = True
    for i in range(3):
        good = good and low[i] <= strokes[i] <= high[i]
    return good


@kernel
def box_least_squares(h: Array, g: Array, low: Array, high: Array, out: Array) -> None:
    """Set ``out`` (3,) to the minimizer of x.h.x / 2 - g.x over low <= x <= high, for ``h`` (3, 3) positive definite.

    All 27 faces of the box are tried: three unknowns are too few for anything cleverer. The minimizer is unique, so
    it moves continuously with the data.
    """
    best = np.inf
    x = scratch(3)
    free = scratch_index(3)
    for face in range(27):
        code = face
        n = 0
        for i in range(3):
            at = code % 3
            code //= 3
            if at == 0:
                free[n] = i
                n += 1
            else:
                x[i] = low[i] if at == 1 else high[i]
        if n == 3:
            solve_free(h, g, x, free, 3)
        elif n == 2:
            solve_free(h, g, x, free, 2)
        elif n == 1:
            solve_free(h, g, x, free, 1)
        feasible = True
        for k in range(n):
            i = free[k]
            slack = 1e-12 * (high[i] - low[i])
            if not low[i] - slack <= x[i] <= high[i] + slack:
                feasible = False
        if not feasible:
            continue
        value = 0.0
        for i in range(3):
            value -= g[i] * x[i]
            for j in range(3):
                value += 0.5 * x[i] * h[i, j] * x[j]
        if value < best:
            best = value
            for i in range(3):
                out[i] = min(max(x[i], low[i]), high[i])


@kernel
def solve_free(h: Array, g: Array, x: Array, free: NDArray[np.int64], n: int) -> None:
    """Stationary ``x[free[:n]]`` with the other components held (Gauss elimination, n <= 3)."""
    a = scratch_matrix(3, 4)
    held = scratch(3)
    for k in range(3):
        held[k] = 1.0
        for m in range(4):
            a[k, m] = 0.0
    for k in range(n):
        held[free[k]] = 0.0
    for k in range(n):
        i = free[k]
        a[k, 3] = g[i]
        for j in range(3):
            if held[j] == 1.0:
                a[k, 3] -= h[i, j] * x[j]
        for m in range(n):
            a[k, m] = h[i, free[m]]
    for k in range(n):
        for m in range(k + 1, n):
            factor = a[m, k] / a[k, k]
            for c in range(k, n):
                a[m, c] -= factor * a[k, c]
            a[m, 3] -= factor * a[k, 3]
    for k in range(n - 1, -1, -1):
        total = a[k, 3]
        for m in range(k + 1, n):
            total -= a[k, m] * x[free[m]]
        x[free[k]] = total / a[k, k]


@kernel
def nearest_reachable(tip: Array, geometry: Record, low: Array, high: Array, strokes: Array) -> None:
    """``strokes`` (3,) m within low..high whose tip is nearest to ``tip`` (3,) m; ``tip`` becomes that position.

    Starts from neutral, so the answer depends on ``tip`` alone. A ``tip`` that is not finite gives neutral.
    """
    e, at, g = scratch(3), scratch(3), scratch(3)
    below, above, move = scratch(3), scratch(3), scratch(3)
    jacobian, h = scratch_matrix(3, 3), scratch_matrix(3, 3)
    for i in range(3):
        strokes[i] = 0.0
        move[i] = 0.0
    if np.isfinite(tip[0]) and np.isfinite(tip[1]) and np.isfinite(tip[2]):
        for _ in range(REACH_PASSES):
            tip_from_strokes(strokes, geometry, at)
            tip_jacobian(strokes, geometry, jacobian)
            for i in range(3):
                e[i] = tip[i] - at[i]
                below[i] = low[i] - strokes[i]
                above[i] = high[i] - strokes[i]
            for i in range(3):
                g[i] = jacobian[0, i] * e[0] + jacobian[1, i] * e[1] + jacobian[2, i] * e[2]
                for j in range(3):
                    h[i, j] = (
                        jacobian[0, i] * jacobian[0, j]
                        + jacobian[1, i] * jacobian[1, j]
                        + jacobian[2, i] * jacobian[2, j]
                    )
            box_least_squares(h, g, below, above, move)
            for i in range(3):
                strokes[i] += move[i]
    tip_from_strokes(strokes, geometry, at)
    for i in range(3):
        tip[i] = at[i]
