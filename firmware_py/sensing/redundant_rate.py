"""Combinations of more than six accelerometer axes that contain neither the specific force nor its angular part.

They contain products of rates alone (Ang 2004 (2.3)), so what is left of them after the known rate is noise unless an
axis is wrong.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record
from firmware_py.sensing.config import MOST_AXES
from firmware_py.sensing.kinematics import observation_matrix
from hal.compiled import kernel
from hal.scratch import scratch_matrix


def parity_rows(
    positions: NDArray[np.float64], axes: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N - 6, N) combinations of readings free of f and alpha, of unit noise; ``noise`` (N,) rms per sample, m/s^2."""
    whitened = observation_matrix(positions, axes) / noise[:, None]
    left, _, _ = np.linalg.svd(whitened)
    return left[:, 6:].T / noise


@kernel
def parity(readings: NDArray[np.float64], rate: NDArray[np.float64], params: Record, out: NDArray[np.float64]) -> None:
    """Set ``out`` (M,) to what the combinations ``params.null`` (M, N) leave of readings (N,) without their centripetal
    part."""
    slope = scratch_matrix(MOST_AXES, 3)[: len(readings)]
    centripetal_slope(rate, params.kinematics, slope)
    for m in range(len(out)):
        out[m] = 0.0
        for i in range(len(readings)):
            # c(omega) is of second degree without lower terms: slope omega = 2 c
            c = 0.5 * (slope[i, 0] * rate[0] + slope[i, 1] * rate[1] + slope[i, 2] * rate[2])
            out[m] += params.null[m, i] * (readings[i] - c)


@kernel
def centripetal_slope(rate: NDArray[np.float64], kinematics: Record, out: NDArray[np.float64]) -> None:
    """``out`` (N, 3): derivative of s.(omega x (omega x r)) of each axis with the rate."""
    for i in range(len(out)):
        r, a = kinematics.positions[i], kinematics.axes[i]
        along = rate[0] * r[0] + rate[1] * r[1] + rate[2] * r[2]
        across = rate[0] * a[0] + rate[1] * a[1] + rate[2] * a[2]
        radial = a[0] * r[0] + a[1] * r[1] + a[2] * r[2]
        for k in range(3):
            out[i, k] = a[k] * along + across * r[k] - 2.0 * radial * rate[k]
