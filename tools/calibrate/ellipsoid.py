"""Hard and soft iron of a three-axis magnetometer from a log turned through all directions (Ang 2004 sec. 3.2.2).

m = A (raw - b) with |m| = 1: an ellipsoid is fitted algebraically for the start, then the distance from the unit sphere
is made least, outliers losing weight (Tukey's biweight on the median absolute deviation). A is symmetric: the turn
between magnetometer and body is not in these data; it comes from known attitudes (``micron calibrate sensors``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from hal.arrays import Array
from tools.calibrate.multi_position import Estimate, estimates_of, missing_poses
from tools.errors import InputError

TUKEY = 4.685


@dataclass(frozen=True)
class Ellipsoid:
    """``matrix`` (3, 3) per count and ``bias`` (3,) counts; norm over all samples and over those that were kept."""

    matrix: Array
    bias: Array
    intervals: dict[str, Estimate]
    norm_mean: float
    norm_spread: float
    kept_spread: float
    outliers: int
    samples: int
    condition: float
    missing: tuple[str, ...]

    def apply(self, raw: Array) -> Array:
        """(n, 3) field in units of its own size."""
        return (raw - self.bias) @ self.matrix.T


def _algebraic(raw: Array) -> tuple[Array, Array]:
    """Return centre and shape of x^T M x + 2 n^T x = 1 by least squares about the middle."""
    x, y, z = raw.T
    design = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    p, *_ = np.linalg.lstsq(design, np.ones(len(raw)), rcond=None)
    shape = np.array([[p[0], p[3], p[4]], [p[3], p[1], p[5]], [p[4], p[5], p[2]]])
    centre = -np.linalg.solve(shape, p[6:])
    values, vectors = np.linalg.eigh(shape / (1.0 + centre @ shape @ centre))
    if np.any(values <= 0.0):
        raise InputError("these directions do not close into an ellipsoid: turn the sensor through all directions")
    return centre.astype(np.float64), (vectors @ np.diag(np.sqrt(values)) @ vectors.T).astype(np.float64)


def fit_ellipsoid(raw: Array) -> Ellipsoid:
    """Fit (n, 3) counts. ``InputError`` when the directions do not show all of the ellipsoid."""
    if len(raw) < 50:
        raise InputError(f"{len(raw)} samples: turn the sensor through all directions for a minute")
    middle = 0.5 * (np.quantile(raw, 0.01, axis=0) + np.quantile(raw, 0.99, axis=0))
    size = float(np.median(np.linalg.norm(raw - middle, axis=1)))
    if size == 0.0:
        raise InputError("the log does not change at all: is it the right column?")
    unit = (raw - middle) / size
    # every direction counts alike, however long the sensor lay there: cells of a cube-map of directions
    heading = unit / np.maximum(np.linalg.norm(unit, axis=1), 1e-9)[:, None]
    cell = np.round(heading * 4.0).astype(np.int64) @ np.array([1, 100, 10_000])
    _, which, counts = np.unique(cell, return_inverse=True, return_counts=True)
    share = 1.0 / np.maximum(counts[which], len(raw) / len(counts) / 10.0)
    share = np.sqrt(share / share.mean())
    keep = np.ones(len(raw), dtype=bool)
    centre, root = _algebraic(unit)
    for _ in range(4):
        miss = np.linalg.norm((unit - centre) @ root, axis=1) - 1.0
        scale = 1.4826 * float(np.median(np.abs(miss - np.median(miss))))
        keep = np.abs(miss - np.median(miss)) < max(4.0 * scale, 1e-6)
        centre, root = _algebraic(unit[keep])
    x = np.concatenate([root[np.triu_indices(3)], centre])
    weight = np.ones(len(raw))

    def residual(p: Array) -> Array:
        return np.sqrt(weight) * (np.linalg.norm((unit - p[6:]) @ _symmetric(p[:6]), axis=1) - 1.0)

    fit = least_squares(residual, x, method="lm")
    for _ in range(10):
        miss = np.linalg.norm((unit - fit.x[6:]) @ _symmetric(fit.x[:6]), axis=1) - 1.0
        scale = 1.4826 * float(np.median(np.abs(miss)))
        weight = np.maximum(1.0 - (miss / (TUKEY * max(scale, 1e-9))) ** 2, 0.0) ** 2
        before = fit.x
        fit = least_squares(residual, before, method="lm")
        if np.max(np.abs(fit.x - before)) < 1e-10:
            break
    condition = float(np.linalg.cond(fit.jac / np.linalg.norm(fit.jac, axis=0)))
    if condition > 1e4:
        raise InputError(f"condition number {condition:.3g}: directions are missing; turn through all of them")
    matrix, bias = _symmetric(fit.x[:6]) / size, middle + fit.x[6:] * size
    norm = np.linalg.norm((raw - bias) @ matrix.T, axis=1)
    inside = weight > 0.0
    sigma2 = float(fit.fun @ fit.fun) / max(1, int(inside.sum()) - 9)
    deviation = 1.96 * np.sqrt(np.diag(sigma2 * np.linalg.pinv(fit.jac.T @ fit.jac)))
    names = ("a_xx", "a_xy", "a_xz", "a_yy", "a_yz", "a_zz", "b_x", "b_y", "b_z")
    values = np.concatenate([fit.x[:6] / size, bias])
    reach = np.concatenate([deviation[:6] / size, deviation[6:] * size])
    return Ellipsoid(
        matrix,
        bias,
        estimates_of(names, values, reach),
        float(norm.mean()),
        float(norm.std()),
        float(norm[inside].std()),
        int(np.sum(~inside)),
        len(raw),
        condition,
        missing_poses(((raw - bias) @ matrix.T) / norm[:, None]),
    )


def _symmetric(p: Array) -> Array:
    return np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])
