"""Three-legged manipulator: displacement of the tip -> extensions of the three actuators (000, ch. 6; ERRATA 68).

Each ball joint stays in the vertical plane of its leg, which makes the star's orientation a rotation about a
horizontal axis: n_z = -a_x, o_z = -a_y, and the star's centre moves sideways only in second order. The inverse
is therefore a fixed point that converges by a factor r a / l (about 1e-4) per pass.
Frame: x toward leg 1, z along the shaft; a is the shaft's direction.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel

PASSES = 6
HALF_SQRT3 = 0.5 * sqrt(3.0)


@kernel
def strokes_from_tip(
    tip: NDArray[np.float64], ball_circle_m: float, shaft_m: float, lever_gain: float, out: NDArray[np.float64]
) -> None:
    """``out`` (3,) = actuator extensions m from neutral for tip displacement ``tip`` (3,) m, manipulator frame.

    A displacement that would lay the shaft flat gives nan.
    """
    r = ball_circle_m
    ax = tip[0] / shaft_m
    ay = tip[1] / shaft_m
    az = sqrt(1.0 - ax * ax - ay * ay)
    for _ in range(PASSES):
        xc = 0.5 * r * (ay * ay - ax * ax) / (1.0 + az)
        yc = r * ax * ay / (1.0 + az)
        new_x = (tip[0] - xc) / shaft_m
        new_y = (tip[1] - yc) / shaft_m
        change = abs(new_x - ax) + abs(new_y - ay)
        ax = new_x
        ay = new_y
        az = sqrt(1.0 - ax * ax - ay * ay)
        if change < 1e-16:
            break
    # 1 - a_z without cancellation
    centre = tip[2] + shaft_m * (ax * ax + ay * ay) / (1.0 + az)
    out[0] = (centre - r * ax) / lever_gain
    out[1] = (centre + r * (0.5 * ax - HALF_SQRT3 * ay)) / lever_gain
    out[2] = (centre + r * (0.5 * ax + HALF_SQRT3 * ay)) / lever_gain
