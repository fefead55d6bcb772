"""Provides operations on quaternions: scalar first, Hamilton, body to world (docs/references.md, conventions)."""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel


@kernel
def rotate_by(q: NDArray[np.float64], x: float, y: float, z: float) -> None:
    """q <- q x exp(theta/2) in place: turn by the body-frame rotation vector (x, y, z) rad, and renormalise."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        scale = 0.5 - angle2 / 48.0  # erratum 38: the limit is 1/2
        c = 1.0 - angle2 / 8.0
    else:
        angle = sqrt(angle2)
        scale = sin(0.5 * angle) / angle
        c = cos(0.5 * angle)
    x *= scale
    y *= scale
    z *= scale
    w0, x0, y0, z0 = q[0], q[1], q[2], q[3]
    q[0] = w0 * c - x0 * x - y0 * y - z0 * z
    q[1] = w0 * x + x0 * c + y0 * z - z0 * y
    q[2] = w0 * y - x0 * z + y0 * c + z0 * x
    q[3] = w0 * z + x0 * y - y0 * x + z0 * c
    norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        norm = -norm  # q and -q are one attitude; w >= 0 is reported
    for i in range(4):
        q[i] /= norm


@kernel
def to_matrix(q: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Set ``out`` (3, 3) to C_WB, Ang 2004 (2.13)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0] = w * w + x * x - y * y - z * z
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = w * w - x * x + y * y - z * z
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = w * w - x * x - y * y + z * z


@kernel
def from_matrix(c: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Set ``out`` (4,) from C_WB (3, 3), by its largest component, so that it is safe at all angles (erratum 45)."""
    trace = c[0, 0] + c[1, 1] + c[2, 2]
    largest = 0
    best = trace
    for i in range(3):
        if c[i, i] > best:
            best = c[i, i]
            largest = i + 1
    if largest == 0:
        s = 2.0 * sqrt(1.0 + trace)
        out[0] = 0.25 * s
        out[1] = (c[2, 1] - c[1, 2]) / s
        out[2] = (c[0, 2] - c[2, 0]) / s
        out[3] = (c[1, 0] - c[0, 1]) / s
    else:
        i = largest - 1
        j = (i + 1) % 3
        k = (i + 2) % 3
        s = 2.0 * sqrt(1.0 + c[i, i] - c[j, j] - c[k, k])
        out[0] = (c[k, j] - c[j, k]) / s
        out[1 + i] = 0.25 * s
        out[1 + j] = (c[j, i] + c[i, j]) / s
        out[1 + k] = (c[k, i] + c[i, k]) / s
    if out[0] < 0.0:
        for n in range(4):
            out[n] = -out[n]
