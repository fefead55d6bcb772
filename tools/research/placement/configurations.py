"""Published placements of six single axes, as positions (6, 3) m and unit directions (6, 3) in the body frame."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from hal.arrays import Array


@dataclass(frozen=True)
class Placement:
    """Single axes on a rigid body; two axes at one position are a dual-axis package."""

    name: str
    positions: Array
    axes: Array


_X, _Y, _Z = np.eye(3)


def micron_004(d1: float = 0.026, d2: float = 0.013, d3: float = 0.130) -> Placement:
    """Latt 2011 Fig. 8 with the missing d2 (erratum 131)."""
    first, second, third = np.array([d1 - d2, -d2, 0.0]), np.array([-d2, d1 - d2, 0.0]), np.array([0.0, 0.0, d3])
    return Placement(
        "Micron", np.array([first, first, second, second, third, third]), np.array([_X, _Z, _Y, _Z, _X, _Y])
    )


def micron_004_turned() -> Placement:
    """Latt 2011 Fig. 8 with the in-plane axes of both back packages turned by 45 degrees, across the line between them.

    All packages turned the same way would leave alpha_z unseen.
    """
    straight, across = micron_004(), (_X + _Y) / sqrt(2.0)
    return Placement("Micron, axes turned 45 deg", straight.positions, np.array([across, _Z, across, _Z, _X, _Y]))


def cube_004(d1: float = 0.026) -> Placement:
    """Six faces of a cube of edge d1, sensing along face diagonals (Latt 2011 (45), erratum 129)."""
    h = d1 / 2.0
    positions = h * np.array([_Z, _Y, _X, -_X, -_Y, -_Z])
    axes = np.array([(-1, -1, 0), (-1, 0, -1), (0, -1, -1), (0, 1, -1), (1, 0, -1), (1, -1, 0)]) / sqrt(2.0)
    return Placement("cube", positions, axes)


def proposed_004(d1: float = 0.026, d3: float = 0.130) -> Placement:
    """Latt 2011 Fig. 10 at its optimum k = 1, l = 0, n = 1: y and z at both back corners, x and y in front."""
    h = d1 / 2.0
    first, second, third = np.array([h, 0.0, 0.0]), np.array([-h, 0.0, 0.0]), np.array([0.0, 0.0, d3])
    return Placement(
        "proposed", np.array([first, first, second, second, third, third]), np.array([_Y, _Z] * 2 + [_X, _Y])
    )


def micron_000() -> Placement:
    """Ang 2004, second (2.54), with the front package on the axis (erratum 23)."""
    d1, d2, d3 = 0.0202, 0.0143, 0.116
    return micron_004(d1, d2, d3)
