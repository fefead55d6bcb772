"""Lag of the accelerometers from a shaker: their RC filter and a delay behind it.

The shaker moves one axis of the world at each of some frequencies. The readings that the calibration predicts without a
filter are compared with those that were recorded, line by line and over all sensors; a first-order lag and a delay are
fitted to the complex ratios.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from firmware_py.sensing.config import SensingConfig
from hal.arrays import Array


@dataclass(frozen=True)
class SensorLag:
    """``filter_s``: time constant of the filter; ``delay_s`` behind it; ``ratio``: recorded over unfiltered readings at
    ``hz`` (n,).
    """

    filter_s: float
    delay_s: float
    hz: Array
    ratio: NDArray[np.complex128]


def lag_at(filter_s: float, delay_s: float, hz: Array | float) -> NDArray[np.complex128]:
    """The complex gain of filter and delay at ``hz``."""
    iw = 2j * np.pi * np.asarray(hz, np.float64)
    return np.exp(-iw * delay_s) / (1.0 + iw * filter_s)


def unfiltered_V(sensing: SensingConfig, force_g: Array) -> Array:
    """Readings (n, 6) in V about their bias, which the calibration predicts of a body-frame force (n, 3) in g."""
    return np.asarray(np.array(sensing.scale_V_per_g) * (force_g @ np.array(sensing.axes).T), np.float64)


def identify_lag(predicted_V: Array, analog_V: Array, dt: float, hz: Array) -> SensorLag:
    """Fit filter and delay to predicted (n, 6) and recorded (n, 6) readings that have lines at ``hz`` (k,)."""
    t = np.arange(len(predicted_V)) * dt
    angle = 2.0 * np.pi * t[:, None] * hz
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(t))])

    def lines(x: Array) -> NDArray[np.complex128]:
        found = np.linalg.lstsq(columns, x, rcond=None)[0]
        return found[: len(hz)] - 1j * found[len(hz) : 2 * len(hz)]

    predicted, recorded = lines(predicted_V), lines(analog_V)
    ratio = np.sum(np.conj(predicted) * recorded, axis=1) / np.sum(np.abs(predicted) ** 2, axis=1)

    def away(p: Array) -> Array:
        left = ratio - p[2] * lag_at(float(np.exp(p[0])), float(p[1]), hz)
        return np.concatenate([left.real, left.imag])

    found = least_squares(away, np.array([np.log(0.01), 0.0, 1.0]), x_scale=(0.1, 1e-3, 0.1)).x
    return SensorLag(float(np.exp(found[0])), float(found[1]), hz, ratio)
