"""Workspace analysis (Ang 2004, 6.4; Table 6.1, Fig. 6.7) of a configured manipulator.

The workspace is the image of the box of strokes that every stack reaches whatever came before. It has no singularity
inside: the determinant of the Jacobian keeps its sign as far as the tilt at which the shaft's direction and the tip no
longer determine each other, far beyond any stroke. Its borders are the ends of the strokes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.manipulator import strokes_from_tip, tilt_jacobian, tip_from_strokes, tip_jacobian
from firmware_py.actuation.stage import actuate_params
from firmware_py.records import attributes
from hal.arrays import Array


@dataclass(frozen=True)
class Workspace:
    """``strokes_m`` (3, 2) from neutral; ``extent_m`` (3,) of the tip over corners and edges; ``sphere_m``: diameter of
    the largest sphere inside, ``sphere_at_m`` its centre; ``neutral_sphere_m``: the same around neutral.
    ``condition``: largest condition number of the Jacobian; ``determinant``: smallest, relative to that at neutral;
    ``singular_deg``: tilt of the shaft at the nearest singularity, ``tilt_deg`` the largest in use; ``identity_m``:
    largest |forward(inverse(tip)) - tip|; ``newton``: most steps it took from a level start."""

    strokes_m: Array
    extent_m: Array
    sphere_m: float
    sphere_at_m: Array
    neutral_sphere_m: float
    condition: float
    determinant: float
    singular_deg: float
    tilt_deg: float
    identity_m: float
    newton: int


def analyse(config: ActuationConfig, grid: int = 15) -> Workspace:
    """Figures of the workspace; ``grid`` strokes per axis are sampled."""
    params = actuate_params(config)
    param = attributes(params)[0]
    low, high = np.array(param.stroke_low), np.array(param.stroke_high)
    geometry = params["geometry"][0]
    axes = [np.linspace(low[i], high[i], grid) for i in range(3)]
    tips, worst, newton = [], 0.0, 0
    conditions, determinants, tilts = [], [], []
    jacobian, tip, back, at = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for point in itertools.product(*axes):
        strokes = np.array(point)
        tip_from_strokes(strokes, geometry, tip)
        warm = np.zeros(2)
        newton = max(newton, strokes_from_tip(tip, geometry, warm, back))
        tip_from_strokes(back, geometry, at)
        worst = max(worst, float(np.max(np.abs(at - tip))))
        tip_jacobian(strokes, geometry, jacobian)
        conditions.append(np.linalg.cond(jacobian))
        determinants.append(np.linalg.det(jacobian))
        tilts.append(np.hypot(warm[0], warm[1]))
        tips.append(tip.copy())
    tip_jacobian(np.zeros(3), geometry, jacobian)
    cloud = np.array(tips)
    centre, radius = largest_sphere(config, low, high)
    return Workspace(
        strokes_m=np.stack([low, high], axis=1),
        extent_m=np.ptp(cloud, axis=0),
        sphere_m=2.0 * radius,
        sphere_at_m=centre,
        neutral_sphere_m=2.0 * distance_to_border(config, np.zeros(3), low, high),
        condition=float(max(conditions)),
        determinant=float(min(determinants) / np.linalg.det(jacobian)),
        singular_deg=singular_tilt_deg(config),
        tilt_deg=float(np.degrees(np.arcsin(max(tilts)))),
        identity_m=worst,
        newton=newton,
    )


def distance_to_border(config: ActuationConfig, tip: Array, low: Array, high: Array) -> float:
    """Distance m from ``tip`` (inside) to the nearest of the six faces of the workspace; negative when outside.

    stroke_i(tip) is nearly linear: distance to the face = (end - stroke) / |gradient|, gradient at the foot point.
    """
    geometry = actuate_params(config)["geometry"][0]
    strokes, jacobian = np.empty(3), np.empty((3, 3))
    if strokes_from_tip(tip, geometry, np.zeros(2), strokes) < 0:
        return -np.inf
    nearest = np.inf
    for i in range(3):
        for end, sign in ((high[i], 1.0), (low[i], -1.0)):
            at, foot, gradient = tip.copy(), strokes.copy(), np.zeros(3)
            for _ in range(3):
                tip_jacobian(foot, geometry, jacobian)
                gradient = np.linalg.inv(jacobian)[i]
                # along the gradient of the foot point, from the tip
                here = np.empty(3)
                strokes_from_tip(at, geometry, np.zeros(2), here)
                at = at + gradient * (end - here[i]) / (gradient @ gradient)
                along = gradient / np.linalg.norm(gradient)
                at = tip + along * ((at - tip) @ along)
                strokes_from_tip(at, geometry, np.zeros(2), foot)
            side = sign * float((at - tip) @ (gradient / np.linalg.norm(gradient)))
            nearest = min(nearest, side)
    return nearest


def largest_sphere(config: ActuationConfig, low: Array, high: Array) -> tuple[Array, float]:
    """Centre and radius m of the largest sphere that fits."""
    geometry = actuate_params(config)["geometry"][0]
    start = np.empty(3)
    tip_from_strokes(0.5 * (low + high), geometry, start)
    found = minimize(
        lambda c: -1e6 * distance_to_border(config, c * 1e-6, low, high),
        start * 1e6,
        method="Nelder-Mead",
        options={"xatol": 0.05, "fatol": 1e-3, "maxfev": 120},
    )
    return np.asarray(found.x) * 1e-6, float(-found.fun) * 1e-6


def singular_tilt_deg(config: ActuationConfig) -> float:
    """Smallest tilt of the shaft, over all directions, at which the tip's (x, y) no longer fixes the tilt."""
    jacobian = np.empty((2, 2))
    for tilt in np.radians(np.arange(1.0, 90.0, 0.5)):
        for direction in np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False):
            ax, ay = np.sin(tilt) * np.cos(direction), np.sin(tilt) * np.sin(direction)
            tilt_jacobian(float(ax), float(ay), config.ball_circle_m, config.shaft_m, jacobian)
            if np.linalg.det(jacobian) <= 0.0:
                return float(np.degrees(tilt))
    return 90.0


def border_faces(config: ActuationConfig, grid: int = 12) -> list[Array]:
    """Six faces of the workspace as (grid, grid, 3) tip positions, m."""
    params = actuate_params(config)
    param = attributes(params)[0]
    low, high = np.array(param.stroke_low), np.array(param.stroke_high)
    faces = []
    share = np.linspace(0.0, 1.0, grid)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for end in (low[i], high[i]):
            face = np.empty((grid, grid, 3))
            for a, b in itertools.product(range(grid), range(grid)):
                strokes = np.empty(3)
                strokes[i] = end
                strokes[j] = low[j] + share[a] * (high[j] - low[j])
                strokes[k] = low[k] + share[b] * (high[k] - low[k])
                tip_from_strokes(strokes, params["geometry"][0], face[a, b])
            faces.append(face)
    return faces
