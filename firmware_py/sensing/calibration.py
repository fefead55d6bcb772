"""Converts volts to physical quantities: accelerometer axes, supply, temperature, magnetometer.

The ADXL-203 is ratiometric (data sheet, "Ratiometricity"): bias and scale follow the supply. Its outputs sit
behind the RC filter and the supply reading does not, so the supply passes the same filter here before it
divides; a supply ripple then cancels instead of being traded for a phase error.

Each axis is read twice: with its line (3.3), then with the bias and the scale factor that the lines of its neighbours
say, A = (L - g(L_y) - h(L_z)) / (1 + r(L_z)), which is Ang 2004 (3.11)-(3.14) with V_y and V_z counted from their zero.
"""

from __future__ import annotations

from math import exp

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import (
    ACCELEROMETER,
    ACCELEROMETER_MORE,
    AXES,
    COUNTS,
    MAGNETOMETER,
    MAGNETOMETER_RAW,
    MORE_AXES,
    SATURATED,
    SUPPLY,
    TEMPERATURE,
    VOLTS,
)
from firmware_py.records import Records, field, new, record
from firmware_py.sensing.config import MOST_AXES, SensingConfig
from hal.arrays import Array, IntArray
from hal.compiled import kernel
from hal.scratch import scratch

TEMPERATURE_SMOOTHING_S = 1.0


@record
class Calibration:
    """The numbers of ``n`` axes. A supply or temperature channel of -1 is not there."""

    lsb_V: float = field("V")
    channel: IntArray = field("1", "n")
    bias_V: Array = field("V", "n")
    scale_V: Array = field("V s^2/m", "n")
    bias_V_per_C: Array = field("V/K", "n")
    scale_per_C: Array = field("1/K", "n")
    in_plane: IntArray = field("1", "n")
    out_of_plane: IntArray = field("1", "n")
    bias_in_plane: Array = field("1, s^2/m", "n", 2)
    bias_out_of_plane: Array = field("1, s^2/m", "n", 2)
    scale_out_of_plane: Array = field("s^2/m, s^4/m^2", "n", 2)
    range: float = field("m/s^2")
    supply_channel: int = field("1")
    supply_divider: float = field("1")
    nominal_supply_V: float = field("V")
    supply_smoothing: float = field("1")
    temperature_channel: int = field("1")
    temperature_offset_V: float = field("V")
    temperature_C_per_V: float = field("degC/V")
    reference_C: float = field("degC")
    temperature_smoothing: float = field("1")
    magnetometer_bias_V: Array = field("V", 3)
    magnetometer_uT_per_V: Array = field("uT/V", 3, 3)  # misalignment included


def reading_names(axes: int) -> tuple[str, ...]:
    """Return the names of the calibrated readings, as recordings have them."""
    names = (*(f"accelerometer_{a}" for a in AXES), *(f"accelerometer_more_{a}" for a in MORE_AXES))
    return names[:axes]


def calibration_params(config: SensingConfig) -> Records[Calibration]:
    """Return the kernels' parameters from the configuration."""
    g = config.gravity_m_s2
    dt = 1.0 / config.tick_hz
    magnetometer_scale = np.array(config.magnetometer_scale_V_per_uT)
    return new(
        Calibration,
        lsb_V=config.lsb_V,
        channel=config.channels,
        bias_V=config.bias_V,
        scale_V=np.array(config.scale_V_per_g) / g,
        bias_V_per_C=config.bias_V_per_C,
        scale_per_C=config.scale_per_C,
        in_plane=config.in_plane,
        out_of_plane=config.out_of_plane,
        bias_in_plane=np.array(config.bias_in_plane) / (1.0, g),
        bias_out_of_plane=np.array(config.bias_out_of_plane) / (1.0, g),
        scale_out_of_plane=np.array(config.scale_out_of_plane) / (g, g * g),
        range=config.range_g * g,
        supply_channel=-1 if config.supply_channel is None else config.supply_channel,
        supply_divider=config.supply_divider,
        nominal_supply_V=config.nominal_supply_V,
        supply_smoothing=1.0 - exp(-config.cutoff_rad_s * dt),
        temperature_channel=-1 if config.temperature_channel is None else config.temperature_channel,
        temperature_offset_V=config.temperature_offset_V,
        temperature_C_per_V=1.0 / config.temperature_scale_V_per_C,
        reference_C=config.reference_temperature_C,
        temperature_smoothing=1.0 - exp(-dt / TEMPERATURE_SMOOTHING_S),
        magnetometer_bias_V=config.magnetometer_bias_V,
        # Ang 2004 (3.20): the rows of the inverted matrix are the sensing axes; scale first (erratum 33)
        magnetometer_uT_per_V=np.linalg.inv(np.array(config.magnetometer_axes)) / magnetometer_scale,
    )


@kernel
def calibrate(
    frame: NDArray[np.float64], smoothed: NDArray[np.float64], params: Calibration, readings: NDArray[np.float64]
) -> int:
    """Fill volts, supply, temperature, accelerometer columns and ``readings`` (N,); returns status bits, or -1 for a
    reading that is not finite (nothing but ``volts`` is written then).

    ``smoothed`` holds supply V and temperature degC; nan means not started.
    """
    for i in range(8):
        frame[VOLTS + i] = frame[COUNTS + i] * params.lsb_V
        if not np.isfinite(frame[VOLTS + i]):
            return -1
    supply, warm = params.nominal_supply_V, params.reference_C
    if params.supply_channel >= 0:
        supply = frame[VOLTS + params.supply_channel] * params.supply_divider
    if supply < 0.2 * params.nominal_supply_V:
        return -1
    if params.temperature_channel >= 0:
        volts = frame[VOLTS + params.temperature_channel] - params.temperature_offset_V
        warm = volts * params.temperature_C_per_V
    if np.isnan(smoothed[0]):
        smoothed[0] = supply
        smoothed[1] = warm
    else:
        smoothed[0] += params.supply_smoothing * (supply - smoothed[0])
        smoothed[1] += params.temperature_smoothing * (warm - smoothed[1])
    frame[SUPPLY] = smoothed[0]
    frame[TEMPERATURE] = smoothed[1]
    ratio = params.nominal_supply_V / smoothed[0]
    rise = smoothed[1] - params.reference_C
    bits = 0
    n = len(readings)
    line = scratch(MOST_AXES)[:n]
    for i in range(n):
        volts = frame[VOLTS + params.channel[i]] * ratio - params.bias_V[i] - params.bias_V_per_C[i] * rise
        line[i] = volts / (params.scale_V[i] * (1.0 + params.scale_per_C[i] * rise))
        if abs(line[i]) > params.range:
            bits = SATURATED
    composite(line, params, readings)
    for i in range(6):
        frame[ACCELEROMETER + i] = readings[i]
    for i in range(6, n):
        frame[ACCELEROMETER_MORE + i - 6] = readings[i]
    return bits


@kernel
def composite(line: NDArray[np.float64], params: Calibration, out: NDArray[np.float64]) -> None:
    """``out`` (N,) m/s^2 from the axes' lines (N,) m/s^2: bias B(V_y, V_z), scale SF(V_z) (Ang 2004 (3.4))."""
    for i in range(len(line)):
        y, z = line[params.in_plane[i]], line[params.out_of_plane[i]]
        g, h, r = params.bias_in_plane[i], params.bias_out_of_plane[i], params.scale_out_of_plane[i]
        bias = y * (g[0] + g[1] * y) + z * (h[0] + h[1] * z)
        out[i] = (line[i] - bias) / (1.0 + z * (r[0] + r[1] * z))


@kernel
def calibrate_magnetometer(frame: NDArray[np.float64], params: Calibration) -> bool:
    """Fill the magnetometer columns from its volts. Return False, and write nothing, when they are not finite."""
    for i in range(3):
        if not np.isfinite(frame[MAGNETOMETER_RAW + i]):
            return False
    for i in range(3):
        field = 0.0
        for j in range(3):
            field += params.magnetometer_uT_per_V[i, j] * (frame[MAGNETOMETER_RAW + j] - params.magnetometer_bias_V[j])
        frame[MAGNETOMETER + i] = field
    return True
