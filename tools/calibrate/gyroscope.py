"""Scale and misalignment of a gyroscope from the poses that calibrate the accelerometer (Tedaldi, sec. V).

Between two still poses the integrated rate must turn gravity from where the accelerometer saw it to where it sees it
next: rate = T K (raw - bias), T = [[1, -yz, zy], [xz, 1, -zx], [-xy, yx, 1]]. The bias is the mean of the rests on both
sides of each turn, so that its drift does not count. Turns in which the gyroscope saturates are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

from firmware_py.sensing.quaternion import rotate_by, to_matrix
from hal.arrays import Array
from hal.compiled import kernel
from tools.calibrate.multi_position import Estimate, MultiPosition, compensate, estimates_of, identify_poses
from tools.calibrate.still import find_poses
from tools.errors import InputError
from tools.numbers import rms, vector_rms

NAMES = ("misalignment_yz", "misalignment_zy", "misalignment_xz", "misalignment_zx", "misalignment_xy")
NAMES += ("misalignment_yx", "scale_x", "scale_y", "scale_z")
LEAST_TURNS = 6
LEAST_TURN_RAD = 0.2
STUCK_SAMPLES = 3
LARGEST_CONDITION = 100.0


@dataclass(frozen=True)
class GyroscopeFit:
    """Scale in rad/s per count, bias in counts, misalignment in rad; residual: rms angle of gravity after a turn."""

    parameters: dict[str, Estimate]
    residual_rad: float
    condition: float
    turns: int
    saturated: int
    accelerometer: MultiPosition

    def values(self) -> Array:
        """(9,) in the order of ``NAMES``."""
        return np.array([self.parameters[name].value for name in NAMES])

    def apply(self, raw: Array) -> Array:
        """(n, 3) rad/s from (n, 3) counts."""
        bias = np.array([self.parameters[f"bias_{axis}"].value for axis in "xyz"])
        return (raw - bias) @ rate_matrix(self.values()).T


def rate_matrix(p: Array) -> Array:
    """Return the matrix T K (3, 3) from ``p`` (9,)."""
    turn = np.array([[1.0, -p[0], p[1]], [p[2], 1.0, -p[3]], [-p[4], p[5], 1.0]])
    return turn * p[6:]


@kernel
def turned_gravity(
    raw: Array, bounds: NDArray[np.int64], bias: Array, unit: tuple[Array, float], up: Array, out: Array
) -> None:
    """Fill ``out`` (n, 3) with ``up`` (n, 3) of the start of a turn, as the body sees it at its end; ``raw`` (m, 3)
    counts. ``unit``: matrix from counts to rad/s, and the time between samples in s."""
    matrix, dt_s = unit
    q, c, rate, before = np.empty(4), np.empty((3, 3)), np.empty(3), np.empty(3)
    for k in range(len(bounds)):
        q[:] = 0.0
        q[0] = 1.0
        for n in range(bounds[k, 0], bounds[k, 1]):
            for i in range(3):
                rate[i] = 0.0
                for j in range(3):
                    rate[i] += matrix[i, j] * (raw[n, j] - bias[k, j])
            if n > bounds[k, 0]:
                h = 0.5 * dt_s
                # mean rate of the interval, and how much its axis turned meanwhile (Bortz' second-order term)
                turn_x = h * (before[0] + rate[0]) + h * dt_s / 6.0 * (before[1] * rate[2] - before[2] * rate[1])
                turn_y = h * (before[1] + rate[1]) + h * dt_s / 6.0 * (before[2] * rate[0] - before[0] * rate[2])
                turn_z = h * (before[2] + rate[2]) + h * dt_s / 6.0 * (before[0] * rate[1] - before[1] * rate[0])
                rotate_by(q, turn_x, turn_y, turn_z)
            for i in range(3):
                before[i] = rate[i]
        to_matrix(q, c)
        for i in range(3):
            out[k, i] = c[0, i] * up[k, 0] + c[1, i] * up[k, 1] + c[2, i] * up[k, 2]


def _saturated(raw: Array) -> NDArray[np.bool_]:
    """(n,) samples at an extreme value of an axis that holds for several samples."""
    stuck = np.zeros(len(raw), dtype=bool)
    for axis in raw.T:
        for extreme in (axis.min(), axis.max()):
            at = axis == extreme
            runs = np.convolve(at, np.ones(STUCK_SAMPLES), mode="same") >= STUCK_SAMPLES
            stuck |= runs
    return stuck


def fit_gyroscope(
    force_raw: Array,
    rate_raw: Array,
    rate_hz: float,
    gravity: float,
    shortest_s: float = 0.5,
    *,
    keep_saturated: bool = False,
) -> GyroscopeFit:
    """Fit (n, 3) counts of both sensors. ``InputError`` when the turns do not show all nine parameters.

    ``keep_saturated``: also turns in which the gyroscope stood at its end, to compare with those who keep them.
    """
    accelerometer = identify_poses(force_raw, rate_hz, gravity, shortest_s)
    window, shortest = max(5, round(0.5 * rate_hz)), max(3, round(shortest_s * rate_hz))
    poses = find_poses(force_raw, window, accelerometer.threshold, shortest)
    seen = compensate(accelerometer.values(), poses.mean)
    up = seen / np.linalg.norm(seen, axis=1)[:, None]
    rest = np.array([rate_raw[a:b].mean(axis=0) for a, b in poses.bounds])
    bounds = np.stack([poses.bounds[:-1, 1] - 1, poses.bounds[1:, 0] + 1], axis=1)
    stuck = _saturated(rate_raw)
    clean = np.array([not stuck[a:b].any() for a, b in bounds], dtype=bool)
    turned = np.arccos(np.clip(np.sum(up[:-1] * up[1:], axis=1), -1.0, 1.0)) > LEAST_TURN_RAD
    use = turned if keep_saturated else clean & turned
    saturated = int(np.sum(turned & ~clean))
    if np.sum(use) < LEAST_TURNS:
        raise InputError(
            f"{int(np.sum(use))} turns between still poses can be used ({saturated} saturate the gyroscope): nine "
            f"parameters need {LEAST_TURNS}, and better twenty; turn more slowly"
        )
    bounds, bias = bounds[use].astype(np.int64), 0.5 * (rest[:-1] + rest[1:])[use]
    start, end = np.ascontiguousarray(up[:-1][use]), up[1:][use]
    raw, out = np.ascontiguousarray(rate_raw), np.empty_like(start)
    size = _first_scale(raw, bounds, bias, start, end, 1.0 / rate_hz)
    unit = np.concatenate([np.ones(6), np.full(3, size)])

    def residual(x: Array) -> Array:
        turned_gravity(raw, bounds, bias, (rate_matrix(x * unit), 1.0 / rate_hz), start, out)
        return (out - end).ravel()

    fit = least_squares(residual, np.concatenate([np.zeros(6), np.ones(3)]), method="lm", x_scale="jac")
    condition = float(np.linalg.cond(fit.jac / np.linalg.norm(fit.jac, axis=0)))
    if condition > LARGEST_CONDITION:
        raise InputError(
            f"the turns do not fix all three axes (condition number {condition:.0f});"
            " turn about each of them, in both directions"
        )
    freedom = max(1, 2 * len(start) - 9)  # a direction has two angles
    sigma2 = float(fit.fun @ fit.fun) / freedom
    reach = float(student.ppf(0.975, freedom)) * unit * np.sqrt(np.diag(sigma2 * np.linalg.pinv(fit.jac.T @ fit.jac)))
    estimates = estimates_of(NAMES, fit.x * unit, reach)
    weight = poses.samples / poses.samples.sum()
    mean = weight @ rest
    spread = float(student.ppf(0.975, len(rest) - 1)) * np.sqrt(weight @ (rest - mean) ** 2 / (len(rest) - 1))
    estimates |= estimates_of(("bias_x", "bias_y", "bias_z"), mean, spread)
    angle = vector_rms(fit.fun.reshape(-1, 3))
    return GyroscopeFit(estimates, angle, condition, len(start), saturated, accelerometer)


def _first_scale(raw: Array, bounds: NDArray[np.int64], bias: Array, start: Array, end: Array, dt_s: float) -> float:
    """The one scale for all axes, of a wide range, that turns gravity best: the start of the fit."""
    moving = np.concatenate([raw[a:b] - m for (a, b), m in zip(bounds, bias, strict=True)])
    # hands turn at 0.05 to 10 rad/s
    size = 1.0 / rms(moving)
    out = np.empty_like(start)
    best, least = size, np.inf
    for scale in size * np.geomspace(0.05, 10.0, 120):
        turned_gravity(raw, bounds, bias, (scale * np.eye(3), dt_s), start, out)
        miss = float(np.sum(np.abs(out - end)))
        if miss < least:
            best, least = float(scale), miss
    return best
