"""Computes the outputs of one set of sensors, whose errors the seed draws.

ADXL-203 (data sheet: ratiometric, 1 V/g and 2.5 V at 5 V, 110 ug/rtHz, internal 32 kOhm against 0.33 uF), TMP36
(0.5 V + 10 mV/degC), supply through a 2:1 divider, HMC-2003 (1 V/gauss, 2.5 V at zero field), DAQ inputs. Cross-axis
terms have the form of Ang 2004 (3.8), (3.10), (3.12), and on top of them three that no polynomial in the other axes'
outputs describes: a fold, a product with the in-plane axis and a hardening spring. Not simulated: the accelerometer's
resonance (5.5 kHz), 1/f noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.compiled import kernel
from sim_devices.config import EnvironmentConfig, InstrumentConfig, SensorConfig
from sim_devices.plant.streams import stream

LOCATION = (0, 0, 1, 1, 2, 2)
DIRECTION = (0, 2, 1, 2, 0, 1)
IN_PLANE = (2, 0, 2, 1, 1, 0)
OUT_OF_PLANE = (1, 1, 0, 0, 2, 2)
STANDARD_GRAVITY = 9.80665

ACCELEROMETER = np.dtype(
    [
        ("location", "i8"),
        ("in_plane", "i8"),
        ("out_of_plane", "i8"),
        ("axis", "f8", (3,)),
        ("bias_V", "f8"),
        ("scale_V_per_g", "f8"),
        ("bias_V_per_K", "f8"),
        ("scale_per_K", "f8"),
        ("in_plane_1", "f8"),
        ("in_plane_2", "f8"),
        ("out_of_plane_1", "f8"),
        ("out_of_plane_2", "f8"),
        ("scale_per_g", "f8"),
        ("fold_V", "f8"),
        ("product", "f8"),
        ("spring", "f8"),
        ("range_V", "f8"),
        ("rc_s", "f8"),
        ("rc_keep", "f8"),
        ("rc_from", "f8"),
        ("rc_to", "f8"),
        ("noise_V", "f8"),
    ]
)


@dataclass(frozen=True)
class SensorUnit:
    """Everything but the accelerometers, which are rows of ACCELEROMETER in ``accelerometers`` (6,).

    ``magnetometer`` (3, 3): V per gauss along body axes, soft iron, scale and misalignment together.
    """

    accelerometers: NDArray[np.void]
    positions_m: Array
    supply_V: float
    divider: float
    temperature_offset_K: float
    magnetometer: Array
    magnetometer_offset_V: Array
    hard_iron_G: Array
    piezo_G_per_A: Array
    daq_gain: Array
    daq_offset_V: Array


def rc_weights(tau_s: float, step_s: float) -> tuple[float, float, float]:
    """Exact step of v' = (u - v) / tau with u linear over the step: v <- keep v + from u_before + to u_after."""
    keep = math.exp(-step_s / tau_s)
    mean = tau_s / step_s * (1.0 - keep)
    return keep, mean - keep, 1.0 - mean


def sensor_unit(config: SensorConfig, instrument: InstrumentConfig, seed: int, step_s: float) -> SensorUnit:
    rng, curves = stream(seed, "accelerometers"), stream(seed, "accelerometers.curves")
    rows = np.zeros(6, ACCELEROMETER)
    for i in range(6):
        row, draw, curve = rows[i], rng.standard_normal(12), curves.standard_normal(3)
        row["location"], row["in_plane"], row["out_of_plane"] = LOCATION[i], IN_PLANE[i], OUT_OF_PLANE[i]
        axis = np.eye(3)[DIRECTION[i]]
        axis[IN_PLANE[i]] += math.radians(config.misalignment_deg) * draw[0]
        axis[OUT_OF_PLANE[i]] += math.radians(config.misalignment_deg) * draw[1]
        row["axis"] = axis / np.linalg.norm(axis)
        row["bias_V"] = config.bias_spread_V * draw[2]
        row["scale_V_per_g"] = 1.0 + config.scale_spread * draw[3]
        row["bias_V_per_K"] = config.bias_temperature_mg_per_K * 1e-3 * draw[4]
        row["scale_per_K"] = config.scale_temperature_per_K * draw[5]
        row["in_plane_1"], row["out_of_plane_1"] = config.cross_linear_V_per_g * draw[6:8]
        row["in_plane_2"], row["out_of_plane_2"] = config.cross_quadratic_V_per_g2 * draw[8:10]
        row["scale_per_g"] = config.scale_variation_per_g * draw[10]
        row["fold_V"] = config.cross_fold_V * curve[0]
        row["product"] = config.cross_product_V_per_g2 * curve[1]
        row["spring"] = config.spring_per_g2 * curve[2]
        row["range_V"] = config.range_g
        row["rc_s"] = config.rc_ohm * config.rc_farad * (1.0 + config.rc_spread * draw[11])
        row["rc_keep"], row["rc_from"], row["rc_to"] = rc_weights(row["rc_s"], step_s)
        # one-sided density D as a held value per step: rms D / sqrt(2 step)
        row["noise_V"] = config.noise_ug_per_rtHz * 1e-6 / math.sqrt(2.0 * step_s)
    positions = np.array(instrument.positions_mm) * 1e-3
    positions += instrument.position_spread_mm * 1e-3 * stream(seed, "positions").standard_normal((3, 3))

    rng = stream(seed, "magnetometer")
    turn = math.radians(config.magnetometer_misalignment_deg)
    sensitivity = np.diag(1.0 + config.magnetometer_scale_spread * rng.standard_normal(3))
    soft_iron = np.eye(3) + config.soft_iron * rng.standard_normal((3, 3))
    axes = np.eye(3) + turn * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
    board, daq = stream(seed, "board").standard_normal(3), stream(seed, "daq").standard_normal((2, 8))
    return SensorUnit(
        accelerometers=rows,
        positions_m=positions,
        supply_V=config.supply_V * (1.0 + config.supply_spread * board[0]),
        divider=0.5 * (1.0 + config.divider_spread * board[1]),
        temperature_offset_K=config.temperature_offset_K * board[2],
        magnetometer=sensitivity @ axes @ soft_iron,
        magnetometer_offset_V=config.magnetometer_offset_V * rng.standard_normal(3),
        hard_iron_G=config.hard_iron_mG * 1e-3 * rng.standard_normal(3),
        piezo_G_per_A=config.piezo_coupling_G_per_A * rng.standard_normal((3, 3)),
        daq_gain=1.0 + config.daq_gain_spread * daq[0],
        daq_offset_V=config.daq_offset_uV * 1e-6 * daq[1],
    )


def field_gauss(config: EnvironmentConfig) -> Array:
    """Return the earth field (3,) in gauss in the world frame: x north, z up."""
    dip = math.radians(config.dip_deg)
    return config.field_uT * 1e-2 * np.array([math.cos(dip), 0.0, -math.sin(dip)])


@kernel
def accelerometer_V(a, f, supply_V, temperature_C):
    """Return the output before the RC filter, in V, for the specific force ``f`` (3,) in m/s^2 at the sensor, body
    axes."""
    g = STANDARD_GRAVITY
    along = (a["axis"][0] * f[0] + a["axis"][1] * f[1] + a["axis"][2] * f[2]) / g
    other, across = f[a["in_plane"]] / g, f[a["out_of_plane"]] / g
    warm = temperature_C - 25.0
    v = (
        a["bias_V"]
        + a["bias_V_per_K"] * warm
        + a["scale_V_per_g"]
        * (1.0 + a["scale_per_K"] * warm)
        * (1.0 + a["scale_per_g"] * across + a["spring"] * along * along)
        * along
        + a["product"] * other * along
        + a["fold_V"] * (math.sqrt(1.0 + 6.25 * other * other) - 1.0)
        + other * (a["in_plane_1"] + a["in_plane_2"] * other)
        + across * (a["out_of_plane_1"] + a["out_of_plane_2"] * across)
    )
    v = min(max(v, -a["range_V"]), a["range_V"])
    return supply_V / 5.0 * (2.5 + v)
