"""Calibrates a three-axis accelerometer from poses at unknown angles (Tedaldi, Pretto, Menegatti, ICRA 2014).

a = T K (raw - b), T = [[1, -t0, t1], [0, 1, -t2], [0, 0, 1]], and |a| = g in every still pose. Nine parameters, so nine
poses at least; x keeps its direction. Ten poses hardly tell the misalignments: there a maker's limits
hold them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from hal.arrays import Array
from tools.calibrate.still import FACTORS, find_poses, quiet_level
from tools.errors import InputError

NAMES = ("misalignment_0", "misalignment_1", "misalignment_2", "scale_x", "scale_y", "scale_z")
NAMES += ("bias_x", "bias_y", "bias_z")

LARGEST_CONDITION = 1e3
"""Poses all round have 2 to 4, a half sphere 130, a cone of 35 degrees 7e4: there a scale came out negative."""
MISALIGNMENT_RAD = 0.02
"""Standard deviation of a misalignment before any pose is seen: 2 % cross-axis sensitivity, as data sheets print it."""


@dataclass(frozen=True)
class Estimate:
    """Holds ``value`` with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, reach: float) -> Estimate:
        """Return ``value`` with an interval that reaches equally far to both sides."""
        return cls(float(value), float(value - reach), float(value + reach))


def estimates_of(names: Iterable[str], values: Array, reach: Array) -> dict[str, Estimate]:
    """Return the estimate of each name, from values and reaches in the order of ``names``."""
    return {name: Estimate.around(v, r) for name, v, r in zip(names, values, reach, strict=True)}


@dataclass(frozen=True)
class MultiPosition:
    """Scale in m/s^2 per count, bias in counts, misalignment in rad; residual of |a| over the poses, m/s^2."""

    parameters: dict[str, Estimate]
    mean_m_s2: float
    residual_m_s2: float
    condition: float
    poses: int
    missing: tuple[str, ...]
    threshold: float

    def values(self) -> Array:
        return np.array([self.parameters[name].value for name in NAMES])

    def apply(self, raw: Array) -> Array:
        """(n, 3) m/s^2 from (n, 3) counts."""
        return compensate(self.values(), raw)


def compensate(p: Array, raw: Array) -> Array:
    """Return accelerations (n, 3) in m/s^2. ``p`` (9,) is in the order of ``NAMES``."""
    turn = np.array([[1.0, -p[0], p[1]], [0.0, 1.0, -p[2]], [0.0, 0.0, 1.0]])
    return ((raw - p[6:]) * p[3:6]) @ turn.T


def missing_poses(directions: Array) -> tuple[str, ...]:
    """Return the axis directions (of six) that no pose (unit rows, body frame) comes within 35 degrees of."""
    missing = []
    for axis, name in enumerate("xyz"):
        for sign, word in ((1.0, "up"), (-1.0, "down")):
            if not np.any(sign * directions[:, axis] > np.cos(np.radians(35.0))):
                missing.append(f"{name} {word}")
    return tuple(missing)


def fit_poses(
    mean: Array, weight: Array, gravity: float, threshold: float = 0.0, pose_noise: float = 0.0
) -> MultiPosition:
    """Fit the nine parameters to still means (n, 3); ``weight`` (n,) relative. ``InputError`` for too few poses.

    ``pose_noise`` (counts) is the error of one mean: with hardly more poses than parameters the residual says
    nothing of it, and intervals made from the residual alone would be far too narrow.
    """
    n = len(mean)
    if n < 9:
        raise InputError(f"{n} still poses: nine parameters need nine, and better eighteen; hold each for a second")
    offset = 0.5 * (mean.max(axis=0) + mean.min(axis=0))
    reach = 0.5 * (mean.max(axis=0) - mean.min(axis=0))
    if np.any(reach <= 0.0):
        raise InputError(f"axis {'xyz'[int(np.argmin(reach))]} never changes over {n} poses; turn it up and down")
    # parameters of order one: scale and bias relative to a first sphere
    unit = np.concatenate([np.ones(3), gravity / reach, reach])
    base = np.concatenate([np.zeros(3), gravity / reach, offset])
    root = np.sqrt(weight / weight.mean())
    pose_m_s2 = pose_noise * gravity / float(np.median(reach))

    def residual(x: Array) -> Array:
        seen = root * (np.linalg.norm(compensate(base + x * unit, mean), axis=1) - gravity)
        return np.append(seen, pose_m_s2 / MISALIGNMENT_RAD * x[:3])

    fit = least_squares(residual, np.zeros(9), x_scale="jac", method="lm", max_nfev=2000)
    values = base + fit.x * unit
    condition = float(np.linalg.cond(fit.jac / np.linalg.norm(fit.jac, axis=0)))
    freedom = max(1, n - 9 + (3 if pose_noise > 0.0 else 0))
    sigma2 = max(float(fit.fun @ fit.fun) / freedom, pose_m_s2**2)
    deviation = unit * np.sqrt(np.maximum(np.diag(sigma2 * np.linalg.pinv(fit.jac.T @ fit.jac)), 0.0))
    reach95 = float(student.ppf(0.975, freedom)) * deviation
    magnitude = np.linalg.norm(compensate(values, mean), axis=1)
    directions = compensate(values, mean) / magnitude[:, None]
    missing = missing_poses(directions)
    if condition > LARGEST_CONDITION or np.any(values[3:6] <= 0.0):
        raise InputError(
            f"{n} poses are too alike to tell nine parameters (condition {condition:.3g}, {LARGEST_CONDITION:g} is "
            f"allowed): turn the sensor over; no pose within 35 degrees of {', '.join(missing) or 'nothing'}"
        )
    return MultiPosition(
        estimates_of(NAMES, values, reach95),
        float(magnitude.mean()),
        float(np.sqrt(np.mean((magnitude - gravity) ** 2))),
        condition,
        n,
        missing,
        threshold,
    )


def identify_poses(raw: Array, rate_hz: float, gravity: float, shortest_s: float = 0.5) -> MultiPosition:
    """Find the still poses of a log (n, 3) and fit; of several thresholds the one with the least residual that keeps
    at least three quarters of the most poses found (Tedaldi sec. IV-B chooses by residual too)."""
    window = max(5, round(0.5 * rate_hz))
    level = quiet_level(raw, window)
    if level <= 0.0:
        raise InputError("the log does not change at all: is it the right column?")
    candidates = [find_poses(raw, window, factor * level, max(3, round(shortest_s * rate_hz))) for factor in FACTORS]
    most = max(len(poses.mean) for poses in candidates)
    fits = [
        fit_poses(
            poses.mean,
            np.minimum(poses.samples, 4.0 * window).astype(np.float64),
            gravity,
            poses.threshold,
            pose_noise=level / np.sqrt(3.0 * np.median(poses.samples)),
        )
        for poses in candidates
        if len(poses.mean) >= max(9, 0.75 * most)
    ]
    if not fits:
        raise InputError(f"at most {most} still poses of {shortest_s:g} s were found; nine are needed")
    return min(fits, key=lambda fit: fit.residual_m_s2 * np.sqrt(fit.poses / max(1, fit.poses - 9)))
