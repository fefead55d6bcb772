"""Numeric differential kinematics: force and rate of the same instant, with its own centripetal part (Ang 2004 (2.6)).

``kinematics.solve_motion`` takes the centripetal part from the rate before. Here alpha = (rate - rate before) / dt goes
into the readings' equation, which is then of second degree in alpha: Gauss-Newton with the analytic Jacobian, over all
N >= 6 axes, weighted by their noise. (errata 4, 5 correct the printed components; here they are vectors.)
"""

from __future__ import annotations

from math import hypot

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record
from firmware_py.sensing.kinematics import centripetal_change, plausible_rate, solve_motion
from hal.compiled import kernel
from hal.scratch import scratch, scratch_matrix

MAX_ITERATIONS = 3
RATE_TOLERANCE_RAD_S = 1e-9
UNKNOWNS = 6


@kernel
def solve_numeric(
    readings: NDArray[np.float64],
    previous_rate: NDArray[np.float64],
    dt_s: float,
    params: Record,
    out: NDArray[np.float64],
) -> int:
    """``out[:6]`` = (f m/s^2, alpha rad/s^2) from readings (N,) m/s^2; the rate is ``previous_rate + dt_s * alpha``.

    Returns the iterations it took, at most three; -1 when they were not enough:
    ``out`` is then the solution with the centripetal part of the previous rate (``solve_motion``).
    """
    solve_motion(readings, previous_rate, params, out)
    analytic, row, step = scratch(UNKNOWNS), scratch(UNKNOWNS), scratch(UNKNOWNS)
    triangle = scratch_matrix(UNKNOWNS, UNKNOWNS)
    for k in range(UNKNOWNS):
        analytic[k] = out[k]
    for iteration in range(MAX_ITERATIONS):
        wx, wy, wz = (
            previous_rate[0] + dt_s * out[3],
            previous_rate[1] + dt_s * out[4],
            previous_rate[2] + dt_s * out[5],
        )
        square = wx * wx + wy * wy + wz * wz
        for k in range(UNKNOWNS):
            step[k] = 0.0
            for j in range(UNKNOWNS):
                triangle[k, j] = 0.0
        for i in range(len(readings)):
            x, y, z = params.positions[i, 0], params.positions[i, 1], params.positions[i, 2]
            sx, sy, sz = params.axes[i, 0], params.axes[i, 1], params.axes[i, 2]
            tx, ty, tz = y * sz - z * sy, z * sx - x * sz, x * sy - y * sx  # r x s
            along = wx * x + wy * y + wz * z
            across = wx * sx + wy * sy + wz * sz
            radial = sx * x + sy * y + sz * z
            weight = params.weight[i]
            predicted = sx * out[0] + sy * out[1] + sz * out[2] + out[3] * tx + out[4] * ty + out[5] * tz
            predicted += across * along - radial * square
            row[0], row[1], row[2] = weight * sx, weight * sy, weight * sz
            row[3] = weight * (tx + dt_s * (sx * along + across * x - 2.0 * radial * wx))
            row[4] = weight * (ty + dt_s * (sy * along + across * y - 2.0 * radial * wy))
            row[5] = weight * (tz + dt_s * (sz * along + across * z - 2.0 * radial * wz))
            fold_row(row, weight * (readings[i] - predicted), triangle, step)
        if not back_substitute(triangle, step):
            break
        size = 0.0
        for k in range(UNKNOWNS):
            out[k] += step[k]
        for k in range(3):
            size = max(size, abs(dt_s * step[3 + k]))
        if size < RATE_TOLERANCE_RAD_S:
            return iteration + 1
    for k in range(UNKNOWNS):
        out[k] = analytic[k]
    return -1


@kernel
def solve_guarded(
    readings: NDArray[np.float64],
    previous_rate: NDArray[np.float64],
    dt_s: float,
    limit_m_s2: float,
    params: Record,
    out: NDArray[np.float64],
) -> bool:
    """``solve_motion`` where its centripetal part may be that of the previous rate, else ``solve_numeric``.

    The analytic solution is taken while the centripetal part of every reading changes by at most ``limit_m_s2`` within
    the step. Fed with its own rate for seconds it would otherwise run away. A previous rate that no hand has (20 rad/s)
    is taken as zero, so that ``out`` is always finite. Returns True when the analytic solution was not taken.
    """
    rate, rest = scratch(3), scratch(3)
    for k in range(3):
        rest[k] = 0.0
    if not plausible_rate(previous_rate):
        solve_motion(readings, rest, params, out)
        return True
    solve_motion(readings, previous_rate, params, out)
    for k in range(3):
        rate[k] = previous_rate[k] + dt_s * out[3 + k]
    if centripetal_change(previous_rate, rate, params) <= limit_m_s2:
        return False
    solve_numeric(readings, previous_rate, dt_s, params, out)
    return True


@kernel
def fold_row(row: NDArray[np.float64], value: float, triangle: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Add the equation ``row`` (6,) . x = ``value`` to the least squares kept as ``triangle`` (6, 6) x = ``right``.

    Givens rotations: as accurate as QR, whatever N is, without an array of its size (normal equations would square the
    condition). ``row`` is used up.
    """
    for k in range(UNKNOWNS):
        if row[k] == 0.0:
            continue
        size = hypot(triangle[k, k], row[k])
        c, s = triangle[k, k] / size, row[k] / size
        triangle[k, k] = size
        for j in range(k + 1, UNKNOWNS):
            kept = triangle[k, j]
            triangle[k, j] = c * kept + s * row[j]
            row[j] = c * row[j] - s * kept
        kept = right[k]
        right[k] = c * kept + s * value
        value = c * value - s * kept


@kernel
def back_substitute(triangle: NDArray[np.float64], right: NDArray[np.float64]) -> bool:
    """``right`` (6,) becomes the solution; False for a triangle that has none."""
    for k in range(UNKNOWNS - 1, -1, -1):
        if triangle[k, k] == 0.0:
            return False
        for j in range(k + 1, UNKNOWNS):
            right[k] -= triangle[k, j] * right[j]
        right[k] /= triangle[k, k]
    return True
