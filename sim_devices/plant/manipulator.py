"""The three-legged manipulator: ball heights to tip displacement (000 ch. 6, errata nos. 58 to 70).

Balls sit on a circle of radius r in the planes y = 0, y = -sqrt3 x, y = +sqrt3 x and move up and down, so the heights
give the pose in closed form (errata nos. 68, 69): no iteration, exact to rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel
from sim_devices.config import ManipulatorConfig
from sim_devices.plant.streams import stream


@dataclass(frozen=True)
class ManipulatorUnit:
    """One manipulator: ``lever`` (3,) gains; ``mount_rad`` turns its frame against the body about z."""

    circle_m: float
    shaft_m: float
    lever: NDArray[np.float64]
    mount_rad: float


def manipulator_unit(config: ManipulatorConfig, seed: int) -> ManipulatorUnit:
    draw = stream(seed, "manipulator").standard_normal(4)
    return ManipulatorUnit(
        circle_m=config.circle_mm * 1e-3,
        shaft_m=config.shaft_mm * 1e-3,
        lever=config.lever_gain * (1.0 + config.lever_spread * draw[:3]),
        mount_rad=math.radians(config.mount_spread_deg * draw[3]),
    )


@kernel
def tip_displacement(z, circle_m, shaft_m, out):
    """``out`` (3,) tip displacement from rest in the manipulator frame, m, for ball heights ``z`` (3,) above rest, m.

    Includes the parasitic motion of the star's centre, x_c = r (a_y^2 - a_x^2) / (2 (1 + a_z)),
    y_c = r a_x a_y / (1 + a_z).
    """
    ax = -(2.0 * z[0] - z[1] - z[2]) / (3.0 * circle_m)
    ay = -(z[1] - z[2]) / (math.sqrt(3.0) * circle_m)
    drop = ax * ax + ay * ay
    az = math.sqrt(1.0 - drop)
    out[0] = circle_m * (ay * ay - ax * ax) / (2.0 * (1.0 + az)) + shaft_m * ax
    out[1] = circle_m * ax * ay / (1.0 + az) + shaft_m * ay
    out[2] = (z[0] + z[1] + z[2]) / 3.0 - shaft_m * drop / (1.0 + az)
