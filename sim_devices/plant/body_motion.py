"""Motion of a rigid body at one instant, as a sensor on it measures it, and the sensor's place on that body."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hal.arrays import Array
from hal.compiled import kernel


def _zeros() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class BodyMotion:
    """Holds the state of a body at an instant. Vectors are in the body frame unless their name says otherwise.

    ``attitude`` (3, 3) maps body to world. ``specific_force_m_s2`` (3,) is felt at ``origin_m`` (3,), body frame:
    +g on an axis that points up at rest (errata no. 2). ``field_world_uT`` (3,) in the world frame.
    """

    attitude: Array
    rate_rad_s: Array
    specific_force_m_s2: Array
    angular_acceleration_rad_s2: Array = field(default_factory=_zeros)
    origin_m: Array = field(default_factory=_zeros)
    field_world_uT: Array = field(default_factory=_zeros)
    temperature_C: float = 25.0


MotionSource = Callable[[int], BodyMotion]  # bench time in ns -> motion at that instant


def rotation(angles_deg: tuple[float, float, float]) -> Array:
    """Return the matrix (3, 3) Rz(yaw) Ry(pitch) Rx(roll) for ``angles_deg`` = (roll, pitch, yaw): child to parent."""
    (sx, cx), (sy, cy), (sz, cz) = ((math.sin(math.radians(a)), math.cos(math.radians(a))) for a in angles_deg)
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


@kernel
def _felt(moves, mount, felt, turned):
    """``moves``: specific force, rate, angular acceleration and where they are felt; ``mount``: position and turn."""
    (f, w, alpha, origin), (position, turn) = moves, mount
    rx, ry, rz = position[0] - origin[0], position[1] - origin[1], position[2] - origin[2]
    along = w[0] * rx + w[1] * ry + w[2] * rz
    w2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    gx = f[0] + alpha[1] * rz - alpha[2] * ry + w[0] * along - w2 * rx
    gy = f[1] + alpha[2] * rx - alpha[0] * rz + w[1] * along - w2 * ry
    gz = f[2] + alpha[0] * ry - alpha[1] * rx + w[2] * along - w2 * rz
    for i in range(3):
        felt[i] = turn[0, i] * gx + turn[1, i] * gy + turn[2, i] * gz
        turned[i] = turn[0, i] * w[0] + turn[1, i] * w[1] + turn[2, i] * w[2]


@dataclass(frozen=True)
class Mount:
    """Place of a sensor: ``position_m`` (3,) is in the body frame, ``turn`` (3, 3) maps sensor to body axes."""

    position_m: Array = field(default_factory=_zeros)
    turn: Array = field(default_factory=lambda: np.eye(3))

    def felt(self, motion: BodyMotion) -> tuple[Array, Array]:
        """Return the specific force (3,) in m/s^2 and the rate (3,) in rad/s along the sensor's axes.

        f = f0 + alpha x r + omega x (omega x r), r from the point where f0 is felt to the sensor.
        """
        f, w = motion.specific_force_m_s2, motion.rate_rad_s
        felt, turned = np.empty(3), np.empty(3)
        moves = f, w, motion.angular_acceleration_rad_s2, motion.origin_m
        _felt(moves, (self.position_m, self.turn), felt, turned)
        return felt, turned

    def field_uT(self, motion: BodyMotion) -> Array:
        """Return the magnetic field (3,) in uT along the sensor's axes."""
        return (motion.field_world_uT @ motion.attitude) @ self.turn
