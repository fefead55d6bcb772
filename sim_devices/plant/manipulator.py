"""Computes the tip displacement of the three-legged manipulator from its ball heights (Ang 2004 ch. 6, errata nos. 58
to 70).

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
    """Holds one manipulator: ``lever`` (3,) gains, ``rest_m`` (3,) ball heights at neutral, ``mount`` (3, 3) its frame
    to the body's, and its play ``play_m`` there."""

    circle_m: float
    shaft_m: float
    lever: NDArray[np.float64]
    rest_m: NDArray[np.float64]
    mount: NDArray[np.float64]
    play_m: float


def manipulator_unit(config: ManipulatorConfig, seed: int) -> ManipulatorUnit:
    draw = stream(seed, "manipulator").standard_normal(4)
    more = stream(seed, "manipulator.geometry").standard_normal(7)
    turn = np.radians([*(config.tilt_spread_deg * more[:2]), config.mount_spread_deg * draw[3]])
    return ManipulatorUnit(
        circle_m=config.circle_mm * 1e-3 * (1.0 + config.length_spread * more[2]),
        shaft_m=config.shaft_mm * 1e-3 * (1.0 + config.length_spread * more[3]),
        lever=config.lever_gain * (1.0 + config.lever_spread * draw[:3]),
        rest_m=config.rest_spread_um * 1e-6 * more[4:],
        mount=rotation(turn),
        play_m=config.mount_play_um * 1e-6,
    )


def rotation(turn_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of a rotation vector (3,) in rad (Rodrigues)."""
    x, y, z = turn_rad
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(turn_rad))
    if angle < 1e-12:
        return np.eye(3)
    return np.eye(3) + math.sin(angle) / angle * cross + (1.0 - math.cos(angle)) / angle**2 * (cross @ cross)


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


@kernel
def take_up(play_m, seat_m, e):
    """Change the displacement ``e`` (3,) in m to what is left of it behind a play; ``seat_m`` (3,) is its memory.

    A second call with the same ``e`` changes nothing.
    """
    for i in range(3):
        seat_m[i] = min(max(seat_m[i], e[i] - 0.5 * play_m), e[i] + 0.5 * play_m)
        e[i] = seat_m[i]
