"""Computes the tip's acceleration without gravity, and its displacement in the tremor band with known phase.

Displacement is the acceleration through s^2 / (s^2 + 2 d w s + w^2)^2 with w = 2 pi 2 Hz: a double integral above
the corner that forgets bias (zero at s = 0) and drift. What that and the RC filter do to amplitude and phase at
any frequency is ``displacement_response``; nothing is compensated here.
"""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from firmware_py.biquads import cascade_response, cascade_step
from firmware_py.designs import design
from firmware_py.records import Records, field, new, record
from firmware_py.sensing.config import SensingConfig
from hal.arrays import Array
from hal.compiled import kernel

CORNER_HZ = 2.0
DAMPING = 0.7


@record
class Translation:
    """The numbers of the tip's translation."""

    tip_m: Array = field("m", 3)
    gravity: float = field("m/s^2")
    sections: Array = field("1", 2, 5)  # the integrator's biquads, rows b0 b1 b2 a1 a2


def translation_params(config: SensingConfig) -> Records[Translation]:
    """Return the numbers of the tip's translation from the configuration."""
    return new(
        Translation,
        tip_m=config.tip_m,
        gravity=config.gravity_m_s2,
        sections=integrator_sections(config.tick_hz),
    )


def integrator_sections(tick_hz: float, corner_hz: float = CORNER_HZ) -> NDArray[np.float64]:
    """Return two biquads (2, 5) from m/s^2 to m: the first takes out bias, the second integrates twice."""
    w = 2.0 * pi * corner_hz
    poles = w * np.array([-DAMPING + 1j * (1 - DAMPING**2) ** 0.5, -DAMPING - 1j * (1 - DAMPING**2) ** 0.5])
    rows: list[list[float]] = []
    for zeros in (np.zeros(2), np.zeros(0)):
        z, p, k = design("bilinear_zpk", zeros, poles, 1.0, tick_hz)
        b, a = np.real(float(k) * np.poly(z)), np.real(np.poly(p))
        rows.append([*b, a[1], a[2]])
    return np.array(rows)


def displacement_response(
    frequency_hz: NDArray[np.float64], tick_hz: float, cutoff_rad_s: float
) -> NDArray[np.complex128]:
    """Return the complex gain from true tip displacement to the ``tip_displacement`` column, RC filter included."""
    s = 2j * pi * np.asarray(frequency_hz, dtype=np.float64)
    gain = s**2 * cutoff_rad_s / (s + cutoff_rad_s)
    return gain * cascade_response(integrator_sections(tick_hz), frequency_hz, tick_hz)


@kernel
def point_force(
    motion: NDArray[np.float64],
    bias: NDArray[np.float64],
    rate: NDArray[np.float64],
    point: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """``out`` (3,) = specific force at a body point (3,) m: f + alpha x r + omega x (omega x r) (Latt 2011 (31)).

    ``motion`` is (f, alpha) of the origin, ``bias`` of alpha.
    """
    x, y, z = point[0], point[1], point[2]
    ax, ay, az = motion[3] - bias[0], motion[4] - bias[1], motion[5] - bias[2]
    wx, wy, wz = rate[0], rate[1], rate[2]
    along = wx * x + wy * y + wz * z
    square = wx * wx + wy * wy + wz * wz
    out[0] = motion[0] + ay * z - az * y + wx * along - x * square
    out[1] = motion[1] + az * x - ax * z + wy * along - y * square
    out[2] = motion[2] + ax * y - ay * x + wz * along - z * square


@kernel
def tip_acceleration(
    motion: NDArray[np.float64],
    bias: NDArray[np.float64],
    rate: NDArray[np.float64],
    up: NDArray[np.float64],
    params: Translation,
    out: NDArray[np.float64],
) -> None:
    """``out`` (3,) = acceleration of the tip, body frame: its specific force minus g ``up``, the third row of C_WB."""
    point_force(motion, bias, rate, params.tip_m, out)
    for i in range(3):
        out[i] -= params.gravity * up[i]


@kernel
def integrate_band(
    acceleration: NDArray[np.float64],
    memory: NDArray[np.float64],
    sections: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """``out`` (3,) = band displacement m; ``memory`` (3, 2, 2) of the biquads, direct form II transposed."""
    for i in range(3):
        out[i] = cascade_step(acceleration[i], memory[i], sections)
