"""Turn between a magnetometer and the body from logs without a stage, and the bridge's offset from its strap.

An ellipsoid leaves the magnetometer's frame open. With an accelerometer beside it the angle of field and gravity is
the same in every pose: (R m).f = const over the log gives R (the dot product is what both sensors must agree on).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from hal.arrays import Array
from tools.calibrate.multi_position import Estimate, estimates_of
from tools.errors import InputError

LEAST_POSES = 12
STILL = 0.02
"""Largest deviation of |f| from its median. Beyond it the body is accelerated."""
LARGEST_CONDITION = 100.0


@dataclass(frozen=True)
class BodyTurn:
    """``turn`` (3, 3) from magnetometer to accelerometer axes; its rotation vector in degrees; dip in degrees."""

    turn: Array
    parameters: dict[str, Estimate]
    residual: float
    condition: float
    samples: int


def fit_turn(field: Array, force: Array) -> BodyTurn:
    """Fit the turn from calibrated field (n, 3) and force (n, 3) in any unit. Raises ``InputError`` when the log lacks
    it."""
    size = np.linalg.norm(force, axis=1)
    still = np.abs(size - np.median(size)) < STILL * np.median(size)
    if np.sum(still) < LEAST_POSES:
        raise InputError(
            f"{int(np.sum(still))} samples at rest; the turn of the body needs {LEAST_POSES}."
            " Hold the instrument still in more attitudes"
        )
    up, m = force[still] / size[still, None], field[still]
    m = m / np.median(np.linalg.norm(m, axis=1))

    def residual(x: Array) -> Array:
        return np.sum(Rotation.from_rotvec(x[:3]).apply(m) * up, axis=1) - x[3]

    start = np.append(np.zeros(3), np.median(np.sum(m * up, axis=1)))
    fit = least_squares(residual, start, method="trf", loss="soft_l1", f_scale=0.02)
    jacobian = _slope(residual, fit.x)
    condition = float(np.linalg.cond(jacobian / np.linalg.norm(jacobian, axis=0)))
    if condition > LARGEST_CONDITION:
        raise InputError(
            f"the attitudes do not fix all three axes (condition number {condition:.0f});"
            " turn the body through all directions, about all axes"
        )
    left = residual(fit.x)
    scale = 1.4826 * float(np.median(np.abs(left)))
    spread = scale * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    reach = float(student.ppf(0.975, max(1, len(left) - 4))) * spread
    values = np.degrees(fit.x[:3])
    dip = float(np.degrees(np.arcsin(np.clip(-fit.x[3], -1.0, 1.0))))
    slant = max(1e-3, float(np.sqrt(max(0.0, 1.0 - fit.x[3] ** 2))))
    estimates = estimates_of(("turn_x_deg", "turn_y_deg", "turn_z_deg"), values, np.degrees(reach[:3]))
    estimates["dip_deg"] = Estimate.around(dip, float(np.degrees(reach[3] / slant)))
    return BodyTurn(Rotation.from_rotvec(fit.x[:3]).as_matrix(), estimates, scale, condition, len(left))


def _slope(function, x: Array) -> Array:  # pyright: ignore[reportMissingParameterType]
    """Return the derivative (n, 4) by central differences, without the weights of the loss function."""
    step = 1e-6
    return np.stack([(function(x + d) - function(x - d)) / (2.0 * step) for d in step * np.eye(4)], axis=1)


def strap(set_raw: Array, reset_raw: Array) -> tuple[Array, tuple[Estimate, ...]]:
    """Return outputs (n, 3) without the bridge's offset, and the offset (3,): a reset pulse reverses everything but the
    offset."""
    sums = 0.5 * (set_raw + reset_raw)
    mean, error = sums.mean(axis=0), sums.std(axis=0, ddof=1) / np.sqrt(len(sums))
    reach = float(student.ppf(0.975, len(sums) - 1)) * error
    offset = tuple(map(Estimate.around, mean, reach))
    return 0.5 * (set_raw - reset_raw), offset
