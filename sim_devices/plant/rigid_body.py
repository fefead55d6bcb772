"""Computes the kinematics of the rigid instrument: pose, body rates, specific force and fields at its sensors.

Conventions of the errata, section 5: C_WB maps body to world, quaternions scalar first, an accelerometer at rest reads
+g on an axis that points up (errata no. 2: f = C_WB^T (a - g)).
"""

from __future__ import annotations

import math

from hal.compiled import kernel


@kernel
def attitude(frame, angles, c):
    """Fill ``c`` (3, 3) with frame Rz(angles[2]) Ry(angles[1]) Rx(angles[0])."""
    sx, cx = math.sin(angles[0]), math.cos(angles[0])
    sy, cy = math.sin(angles[1]), math.cos(angles[1])
    sz, cz = math.sin(angles[2]), math.cos(angles[2])
    m00, m01, m02 = cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx
    m10, m11, m12 = sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx
    m20, m21, m22 = -sy, cy * sx, cy * cx
    for i in range(3):
        f0, f1, f2 = frame[i, 0], frame[i, 1], frame[i, 2]
        c[i, 0] = f0 * m00 + f1 * m10 + f2 * m20
        c[i, 1] = f0 * m01 + f1 * m11 + f2 * m21
        c[i, 2] = f0 * m02 + f1 * m12 + f2 * m22


@kernel
def body_rates(angles, rates, accelerations, omega, alpha):
    """Fill the body rate ``omega`` (3,) in rad/s and its derivative ``alpha`` (3,) from ``attitude``'s angles and their
    derivatives."""
    sx, cx = math.sin(angles[0]), math.cos(angles[0])
    sy, cy = math.sin(angles[1]), math.cos(angles[1])
    x1, y1, z1 = rates[0], rates[1], rates[2]
    x2, y2, z2 = accelerations[0], accelerations[1], accelerations[2]
    omega[0] = x1 - z1 * sy
    omega[1] = y1 * cx + z1 * cy * sx
    omega[2] = -y1 * sx + z1 * cy * cx
    alpha[0] = x2 - z2 * sy - z1 * y1 * cy
    alpha[1] = y2 * cx - y1 * x1 * sx + z2 * cy * sx - z1 * y1 * sy * sx + z1 * x1 * cy * cx
    alpha[2] = -y2 * sx - y1 * x1 * cx + z2 * cy * cx - z1 * y1 * sy * cx - z1 * x1 * cy * sx


@kernel
def specific_force(moves, gravity, arm, f):
    """Fill ``f`` (3,) body, m/s^2, at ``arm`` (body, m) from a point. ``moves``: attitude C, the point's world
    acceleration, rate omega and angular acceleration alpha.

    f = C^T (a - g) + alpha x r + omega x (omega x r), g = (0, 0, -gravity).
    """
    c, acceleration, omega, alpha = moves
    ax, ay, az = acceleration[0], acceleration[1], acceleration[2] + gravity
    wx, wy, wz = omega[0], omega[1], omega[2]
    rx, ry, rz = arm[0], arm[1], arm[2]
    along = wx * rx + wy * ry + wz * rz
    w2 = wx * wx + wy * wy + wz * wz
    f[0] = c[0, 0] * ax + c[1, 0] * ay + c[2, 0] * az + alpha[1] * rz - alpha[2] * ry + wx * along - w2 * rx
    f[1] = c[0, 1] * ax + c[1, 1] * ay + c[2, 1] * az + alpha[2] * rx - alpha[0] * rz + wy * along - w2 * ry
    f[2] = c[0, 2] * ax + c[1, 2] * ay + c[2, 2] * az + alpha[0] * ry - alpha[1] * rx + wz * along - w2 * rz


@kernel
def quaternion(c, q):
    """Fill ``q`` (4,), scalar first, q0 >= 0, from ``c`` (3, 3). The largest component comes first, so it is exact
    everywhere."""
    trace = c[0, 0] + c[1, 1] + c[2, 2]
    if trace >= c[0, 0] and trace >= c[1, 1] and trace >= c[2, 2]:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = c[2, 1] - c[1, 2], c[0, 2] - c[2, 0], c[1, 0] - c[0, 1]
    elif c[0, 0] >= c[1, 1] and c[0, 0] >= c[2, 2]:
        q[0], q[1] = c[2, 1] - c[1, 2], 1.0 + c[0, 0] - c[1, 1] - c[2, 2]
        q[2], q[3] = c[0, 1] + c[1, 0], c[0, 2] + c[2, 0]
    elif c[1, 1] >= c[2, 2]:
        q[0], q[1] = c[0, 2] - c[2, 0], c[0, 1] + c[1, 0]
        q[2], q[3] = 1.0 - c[0, 0] + c[1, 1] - c[2, 2], c[1, 2] + c[2, 1]
    else:
        q[0], q[1] = c[1, 0] - c[0, 1], c[0, 2] + c[2, 0]
        q[2], q[3] = c[1, 2] + c[2, 1], 1.0 - c[0, 0] - c[1, 1] + c[2, 2]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm
