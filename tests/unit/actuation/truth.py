"""Independent truth for the actuation tests: the manipulator's constraints, and play operators by definition."""

from __future__ import annotations

import numpy as np
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from firmware_py.actuation.config import ActuationConfig
from hal.arrays import Array

PINS = np.array([[1.0, 0.0], [-0.5, np.sqrt(3) / 2], [-0.5, -np.sqrt(3) / 2]])  # Ang 2004 (6.1), (6.2) for R = r = 1


def tip_at_heights(heights: Array, ball_circle_m: float, shaft_m: float) -> Array:
    """Tip (3,) m by solving the constraints for the star's pose: each ball stays in the vertical plane of its leg
    (6.13) and at its height. Unknowns: rotation vector and centre. Counted from a level star at height 0."""
    r = ball_circle_m
    balls = np.column_stack([r * PINS, np.zeros(3)])

    def constraint(pose: Array) -> Array:
        rotation = Rotation.from_rotvec(pose[:3])
        at = rotation.apply(balls) + r * pose[3:]
        out_of_plane = at[:, 0] * PINS[:, 1] - at[:, 1] * PINS[:, 0]
        return np.concatenate([out_of_plane, at[:, 2] - heights]) / r

    pose, _, found, message = fsolve(constraint, np.zeros(6), full_output=True, xtol=1e-14)
    assert found == 1 or np.max(np.abs(constraint(pose))) < 1e-12, message
    shaft = np.array([0.0, 0.0, shaft_m])
    return Rotation.from_rotvec(pose[:3]).apply(shaft) + r * pose[3:] - shaft


def tip_from_strokes(strokes: Array, config: ActuationConfig) -> Array:
    """Tip displacement (3,) m from neutral, manipulator frame."""
    rest = np.array(config.rest_heights_m)
    there = tip_at_heights(rest + np.array(config.lever_gain) * strokes, config.ball_circle_m, config.shaft_m)
    return there - tip_at_heights(rest, config.ball_circle_m, config.shaft_m)


class Plays:
    """w . H_r of Ang 2004 (7.1)-(7.4), one operator after the other."""

    def __init__(self, r: Array, w: Array, start: Array) -> None:
        self.r, self.w, self.y = r, w, start.copy()

    def step(self, x: float) -> float:
        for i, r in enumerate(self.r):
            self.y[i] = max(x - r, min(x + r, self.y[i]))
        return float(self.w @ self.y)
