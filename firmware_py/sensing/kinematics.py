"""Solves for specific force and angular acceleration of a rigid body with six or more single-axis accelerometers.

Axis i at r_i with unit direction s_i reads y_i = s_i.(f + alpha x r_i + omega x (omega x r_i)), f the specific
force at the origin (Ang 2004 (2.3) with errata 2, 13, 30). With omega known this is linear in (f, alpha): all axes
are solved at once, weighted by their noise; the three differences of Ang 2004 (2.14) are the special case N = 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Records, field, new, record
from hal.arrays import Array
from hal.compiled import kernel

MAX_RATE_RAD_S = 20.0
"""No hand turns faster than this."""


@record
class Kinematics:
    """The numbers of ``n`` axes."""

    solve: Array = field("1, 1/m", 6, "n")  # from readings to (f, alpha)
    axes: Array = field("1", "n", 3)
    positions: Array = field("m", "n", 3)
    weight: Array = field("1", "n")  # least noise over that of the axis


def observation_matrix(positions: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N, 6) matrix from (f, alpha) to readings at omega = 0: rows (s_i, r_i x s_i)."""
    return np.hstack([axes, np.cross(positions, axes)])


def kinematic_params(
    positions: NDArray[np.float64], axes: NDArray[np.float64], noise: NDArray[np.float64]
) -> Records[Kinematics]:
    """Weighted least squares for N >= 6 axes: positions (N, 3) m, unit axes (N, 3), noise (N,) in any one unit.

    Raises ValueError when the six unknowns cannot be told apart.
    """
    observe = observation_matrix(positions, axes)
    if len(observe) < 6 or np.linalg.matrix_rank(observe) < 6:
        raise ValueError(f"{len(observe)} axes at these positions do not determine six degrees of freedom")
    weighted = observe / noise[:, None]
    solve = np.linalg.pinv(weighted) / noise
    return new(Kinematics, solve=solve, axes=axes, positions=positions, weight=noise.min() / noise)


@kernel
def solve_motion(
    readings: NDArray[np.float64],
    rate: NDArray[np.float64],
    params: Kinematics,
    out: NDArray[np.float64],
) -> None:
    """``out[:6]`` = (f m/s^2, alpha rad/s^2) from readings (N,) m/s^2 and the body rate (3,) rad/s."""
    wx, wy, wz = rate[0], rate[1], rate[2]
    for k in range(6):
        out[k] = 0.0
    for i in range(len(readings)):
        x, y, z = params.positions[i, 0], params.positions[i, 1], params.positions[i, 2]
        along = wx * x + wy * y + wz * z
        square = wx * wx + wy * wy + wz * wz
        centripetal = (
            params.axes[i, 0] * (wx * along - x * square)
            + params.axes[i, 1] * (wy * along - y * square)
            + params.axes[i, 2] * (wz * along - z * square)
        )
        tangential = readings[i] - centripetal
        for k in range(6):
            out[k] += params.solve[k, i] * tangential


@kernel
def plausible_rate(rate: NDArray[np.float64]) -> bool:
    """Return True if a hand can turn that fast. The comparison is written so that nan is not plausible either."""
    return rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2 < MAX_RATE_RAD_S**2


@kernel
def centripetal_change(before: NDArray[np.float64], now: NDArray[np.float64], params: Kinematics) -> float:
    """Return the largest change of a reading's centripetal part (m/s^2) between two body rates (3,) in rad/s."""
    largest = 0.0
    square = now[0] ** 2 + now[1] ** 2 + now[2] ** 2 - before[0] ** 2 - before[1] ** 2 - before[2] ** 2
    for i in range(len(params.positions)):
        place, axis = params.positions[i], params.axes[i]
        late = before[0] * place[0] + before[1] * place[1] + before[2] * place[2]
        along = now[0] * place[0] + now[1] * place[1] + now[2] * place[2]
        change = 0.0
        for k in range(3):
            change += axis[k] * (now[k] * along - before[k] * late - place[k] * square)
        largest = max(largest, abs(change))
    return largest
