"""Computes stability, drift and noise of a motionless sensor: Tables 5.4 to 5.8 of Erat 2018."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.imu.series import Array, Series


@dataclass(frozen=True)
class Stability:
    """Holds figures (3,) for axes x, y, z. Accelerations in g after the offset was taken off (gravity stays), rates in
    deg/s.

    ``drift_before`` and ``drift_after`` are the gyroscope's integral in deg per minute, without and with the offset
    taken off; ``noise_dps`` its rms about the offset.
    """

    accel_max_g: Array
    accel_min_g: Array
    gyro_offset_dps: Array | None
    drift_before_deg_min: Array | None
    drift_after_deg_min: Array | None
    noise_dps: Array | None

    @property
    def accel_difference_g(self) -> Array:
        return self.accel_max_g - self.accel_min_g


def stability(series: Series, accel_offset_g: Array, gyro_offset_dps: Array | None) -> Stability:
    """Compute the figures from a motionless ``series`` and offsets that were measured before it."""
    accel = series.accel_g - accel_offset_g
    gyro = series.gyro_dps
    if gyro is None or gyro_offset_dps is None:
        return Stability(accel.max(axis=0), accel.min(axis=0), None, None, None, None)
    minutes = series.seconds / 60.0
    turned = gyro.sum(axis=0) / series.rate_hz  # (5.3)
    corrected = turned - gyro_offset_dps * series.seconds
    noise = np.sqrt(np.mean((gyro - gyro_offset_dps) ** 2, axis=0))
    return Stability(
        accel.max(axis=0), accel.min(axis=0), gyro_offset_dps, turned / minutes, corrected / minutes, noise
    )
