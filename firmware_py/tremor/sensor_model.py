"""Converts a sensor's samples to displacement at one frequency, by inverting its known gain and phase.

A sensor sees the tip's displacement (or its second derivative) through the RC filter. At one frequency both are a
complex factor; its inverse, turned on by the phase that passes in the loop's delay, takes the weights of a Fourier
model of the samples to displacement ahead.
"""

from __future__ import annotations

from cmath import exp
from math import isfinite

from firmware_py.records import Records, field, new, record
from firmware_py.tremor.config import TremorConfig
from hal.compiled import kernel


@record
class SensorModel:
    """Describes the sensor and its filter, between the tip and the samples."""

    tick_hz: float = field("Hz")
    lag_s: float = field("s")  # of the RC filter, 0 without one
    accelerates: int = field("1")  # 1: the sensor sees acceleration
    delay_s: float = field("s")  # of the loop


def sensor_params(config: TremorConfig) -> Records[SensorModel]:
    """Return the kernels' parameters of the sensor."""
    return new(
        SensorModel,
        tick_hz=config.tick_hz,
        lag_s=1.0 / config.filter_cutoff_rad_s if isfinite(config.filter_cutoff_rad_s) else 0.0,
        accelerates=int(config.sees == "acceleration"),
        delay_s=config.loop_delay_s,
    )


@kernel
def invert_sensor(omega_rad_s: float, ahead_s: float, sensor: SensorModel) -> complex:
    """Return the factor from a sample's phasor to the displacement's phasor (m) ``ahead_s`` later."""
    factor = (1.0 + 1j * omega_rad_s * sensor.lag_s) * exp(1j * omega_rad_s * ahead_s)
    if sensor.accelerates:
        return -factor / (omega_rad_s * omega_rad_s)
    return factor
