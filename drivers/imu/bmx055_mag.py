"""Converts the counts of the BMX055's magnetometer to tesla with the trim values and Hall resistance of the die.

Source: Bosch BMM050 API, to which BST-BMX055-DS000 refers ("Magnetic field data temperature compensation").
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

TRIM_BYTES = 21  # 0x5D .. 0x71
XY_OVERFLOW, Z_OVERFLOW = -4096, -16384
MICRO = 1e-6


@dataclass(frozen=True, slots=True)
class MagTrim:
    """Holds the factory values of one die. A ``blank`` die uses nominal steps: 0.3125 uT in x and y, half of that in
    z."""

    x1: int
    y1: int
    x2: int
    y2: int
    z1: int
    z2: int
    z3: int
    z4: int
    xy1: int
    xy2: int
    xyz1: int

    @property
    def blank(self) -> bool:
        return self.xyz1 == 0 or self.z1 == 0 or self.z2 == 0

    @staticmethod
    def decode(block: bytes) -> MagTrim:
        """Decode the trim values from the 21 bytes that begin at register 0x5D."""
        x1, y1, z4, x2, y2, z2, z1, xyz1, z3, xy2, xy1 = struct.unpack("<bb3xhbb2xhHHhbB", block)
        return MagTrim(x1, y1, x2, y2, z1, z2, z3, z4, xy1, xy2, xyz1 & 0x7FFF)

    def field_T(self, x: int, y: int, z: int, rhall: int) -> tuple[float, float, float]:
        """Return the field (3,) in T: NaN for an axis that overflowed, and for all axes without a Hall resistance."""
        if self.blank:
            values = 0.3125 * x, 0.3125 * y, 0.15625 * z
        elif rhall == 0:
            return math.nan, math.nan, math.nan
        else:
            t = self.xyz1 * 16384.0 / rhall - 16384.0
            gain = (self.xy2 * t * t / 2.0**28 + self.xy1 * t / 2.0**14 + 256.0) / 8192.0
            values = (
                (x * gain * (self.x2 + 160.0) + self.x1 * 8.0) / 16.0,
                (y * gain * (self.y2 + 160.0) + self.y1 * 8.0) / 16.0,
                ((z - self.z4) * 131072.0 - self.z3 * (rhall - self.xyz1))
                / (64.0 * (self.z2 + self.z1 * rhall / 32768.0)),
            )
        return (
            math.nan if x == XY_OVERFLOW else values[0] * MICRO,
            math.nan if y == XY_OVERFLOW else values[1] * MICRO,
            math.nan if z == Z_OVERFLOW else values[2] * MICRO,
        )


def counts(data: bytes) -> tuple[bool, int, int, int, int]:
    """Return from the eight data bytes: new, x (13 bit), y (13 bit), z (15 bit), Hall resistance (14 bit)."""
    x, y, z, rhall = struct.unpack("<hhhH", data)
    return bool(rhall & 1), x >> 3, y >> 3, z >> 1, rhall >> 2
