"""Computes attitude from up (specific force at rest) and magnetic north (Ang 2004 (2.22)-(2.25), errata 2, 9)."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel


@kernel
def triad(force: NDArray[np.float64], field: NDArray[np.float64], out: NDArray[np.float64]) -> bool:
    """Set ``out`` (3, 3) to C_WB with world z along ``force`` (up) and world x along ``field``'s horizontal part.

    Both vectors in the body frame, any unit. Without a usable field (zero or along ``force``) the body axis
    that is most horizontal takes its place, and the result is False.
    """
    norm = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    for i in range(3):
        out[2, i] = force[i] / norm
    zx, zy, zz = out[2, 0], out[2, 1], out[2, 2]
    bx, by, bz = field[0], field[1], field[2]
    size = sqrt(bx * bx + by * by + bz * bz)
    yx, yy, yz = zy * bz - zz * by, zz * bx - zx * bz, zx * by - zy * bx
    norm = sqrt(yx * yx + yy * yy + yz * yz)
    found = size > 0.0 and norm > 0.02 * size
    if not found:
        bx, by, bz = 1.0, 0.0, 0.0
        if abs(zx) > 0.9:
            bx, by = 0.0, 1.0
        yx, yy, yz = zy * bz - zz * by, zz * bx - zx * bz, zx * by - zy * bx
        norm = sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / norm, yy / norm, yz / norm
    out[1, 0], out[1, 1], out[1, 2] = yx, yy, yz
    out[0, 0], out[0, 1], out[0, 2] = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    return found
