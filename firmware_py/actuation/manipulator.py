"""Three-legged manipulator: strokes of the three actuators <-> displacement of the tip (Ang 2004, ch. 6; errata 58-70).

Each ball joint stays in the vertical plane of its leg, which makes the star's orientation a rotation about a
horizontal axis: n_z = -a_x, o_z = -a_y, and moves the star's centre sideways in second order (erratum 68):
x_c = r (a_y^2 - a_x^2) / (2 (1 + a_z)), y_c = r a_x a_y / (1 + a_z). Forward is closed; inverse is Newton's method on
(a_x, a_y) with the analytic Jacobian. With a = a_x + i a_y the equation is l a - r conj(a)^2 / (2 (1 + a_z)) = d: in
polar form a sextic (cos 3 phi stays), so no closed form is used.
Frame: x toward leg 1, z along the shaft; a is the shaft's direction. Ball i is at rest_i + lever_i * stroke_i.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from firmware_py.records import field, record
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch, scratch_matrix

NEWTON_PASSES = 3
HALF_SQRT3 = 0.5 * sqrt(3.0)
SQRT3 = sqrt(3.0)


@record
class Geometry:
    """The numbers of the manipulator."""

    circle_m: float = field("m")  # R = r, pins and balls
    shaft_m: float = field("m")  # l
    lever: Array = field("1", 3)
    rest_m: Array = field("m", 3)  # ball heights at neutral
    rest_tip: Array = field("m", 3)  # what those heights do to the tip


@kernel
def star_tip(heights: Array, circle_m: float, shaft_m: float, out: Array) -> None:
    """``out`` (3,) m: tip for ball ``heights`` (3,) m, from where a level star at height 0 puts it."""
    ax = -(2.0 * heights[0] - heights[1] - heights[2]) / (3.0 * circle_m)
    ay = -(heights[1] - heights[2]) / (SQRT3 * circle_m)
    flat = ax * ax + ay * ay
    az = sqrt(1.0 - flat)
    out[0] = shaft_m * ax + 0.5 * circle_m * (ay * ay - ax * ax) / (1.0 + az)
    out[1] = shaft_m * ay + circle_m * ax * ay / (1.0 + az)
    out[2] = (heights[0] + heights[1] + heights[2]) / 3.0 - shaft_m * flat / (1.0 + az)


@kernel
def tip_from_strokes(strokes: Array, geometry: Geometry, out: Array) -> None:
    """Forward kinematics: ``out`` (3,) m tip displacement from neutral for ``strokes`` (3,) m, manipulator frame."""
    heights = scratch(3)
    for i in range(3):
        heights[i] = geometry.rest_m[i] + geometry.lever[i] * strokes[i]
    star_tip(heights, geometry.circle_m, geometry.shaft_m, out)
    for i in range(3):
        out[i] -= geometry.rest_tip[i]


@kernel
def tilt_jacobian(ax: float, ay: float, circle_m: float, shaft_m: float, out: Array) -> None:
    """``out`` (2, 2): derivative of the tip's (x, y) by the shaft's (a_x, a_y)."""
    az = sqrt(1.0 - ax * ax - ay * ay)
    g = 1.0 / (1.0 + az)
    h = g * g / az  # d g / d a_x = a_x h
    half = 0.5 * (ay * ay - ax * ax)
    out[0, 0] = shaft_m + circle_m * (half * ax * h - ax * g)
    out[0, 1] = circle_m * (half * ay * h + ay * g)
    out[1, 0] = circle_m * ay * (g + ax * ax * h)
    out[1, 1] = shaft_m + circle_m * ax * (g + ay * ay * h)


@kernel
def tip_jacobian(strokes: Array, geometry: Geometry, out: Array) -> None:
    """``out`` (3, 3): derivative of the tip displacement by the strokes, m/m."""
    r, shaft = geometry.circle_m, geometry.shaft_m
    z = scratch(3)
    for i in range(3):
        z[i] = geometry.rest_m[i] + geometry.lever[i] * strokes[i]
    ax = -(2.0 * z[0] - z[1] - z[2]) / (3.0 * r)
    ay = -(z[1] - z[2]) / (SQRT3 * r)
    az = sqrt(1.0 - ax * ax - ay * ay)
    m = scratch_matrix(2, 2)
    tilt_jacobian(ax, ay, r, shaft, m)
    for i in range(3):
        # how ball i turns the shaft
        bx = -2.0 / (3.0 * r) if i == 0 else 1.0 / (3.0 * r)
        by = 0.0
        if i == 1:
            by = -1.0 / (SQRT3 * r)
        elif i == 2:
            by = 1.0 / (SQRT3 * r)
        out[0, i] = geometry.lever[i] * (m[0, 0] * bx + m[0, 1] * by)
        out[1, i] = geometry.lever[i] * (m[1, 0] * bx + m[1, 1] * by)
        out[2, i] = geometry.lever[i] * (1.0 / 3.0 - shaft * (ax * bx + ay * by) / az)


@kernel
def strokes_from_tip(tip: Array, geometry: Geometry, warm: Array, out: Array) -> int:
    """Inverse kinematics: ``out`` (3,) = actuator strokes m from neutral for ``tip`` (3,) m, manipulator frame.

    ``warm`` (2,): tilt to start from, the solution when it returns. Returns the number of Newton steps (0 to
    ``NEWTON_PASSES``), or -1 with nan in ``out`` and a level ``warm`` when no tilt gives that displacement.
    """
    r, shaft = geometry.circle_m, geometry.shaft_m
    x = tip[0] + geometry.rest_tip[0]
    y = tip[1] + geometry.rest_tip[1]
    ax, ay = warm[0], warm[1]
    m = scratch_matrix(2, 2)
    passes = 0
    good = True
    while True:
        flat = ax * ax + ay * ay
        # also for nan
        if not flat < 1.0:
            good = False
            break
        g = 1.0 / (1.0 + sqrt(1.0 - flat))
        ex = x - shaft * ax - 0.5 * r * (ay * ay - ax * ax) * g
        ey = y - shaft * ay - r * ax * ay * g
        # a picometre
        if abs(ex) + abs(ey) < 1e-12:
            break
        if passes == NEWTON_PASSES:
            good = abs(ex) + abs(ey) < 1e-9
            break
        tilt_jacobian(ax, ay, r, shaft, m)
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        ax += (m[1, 1] * ex - m[0, 1] * ey) / det
        ay += (m[0, 0] * ey - m[1, 0] * ex) / det
        passes += 1
    if not good:
        warm[0] = warm[1] = 0.0
        for i in range(3):
            out[i] = np.nan
        return -1
    warm[0], warm[1] = ax, ay
    flat = ax * ax + ay * ay
    centre = tip[2] + geometry.rest_tip[2] + shaft * flat / (1.0 + sqrt(1.0 - flat))
    out[0] = (centre - r * ax - geometry.rest_m[0]) / geometry.lever[0]
    out[1] = (centre + r * (0.5 * ax - HALF_SQRT3 * ay) - geometry.rest_m[1]) / geometry.lever[1]
    out[2] = (centre + r * (0.5 * ax + HALF_SQRT3 * ay) - geometry.rest_m[2]) / geometry.lever[2]
    return passes
