"""Error of the sensed tip displacement in the tremor band (8 to 12 Hz), and what each error source has in it.

Every variant of the emulated instrument is calibrated anew (rotary stage, 100 poses) and held in the default hand. The
displacement that the firmware puts out is freed of its known response (``displacement_response``: band integrator and
nominal RC filter) and compared with the true path of the tip, body axes, both cut to the band.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.translation import displacement_response
from hal.arrays import Array
from sim_devices.config import EmulationConfig, InstrumentConfig, SensorConfig
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.lab import measure_tumble
from tools.calibrate.tumble import identify
from tools.research.reproduce.rows import Row
from tools.research.reproduce.scene import SceneResult, run_scene
from tools.research.reproduce.sensing_static import drawing

BAND_HZ = (8.0, 12.0)
SECONDS = 40.0
SETTLE_S = 8.0
EDGE_S = 1.0
GOAL_UM = 5.0
SOURCES: dict[str, tuple[str, ...]] = {
    "sensor noise": ("noise_ug_per_rtHz",),
    "bias, scale, direction of axes": ("bias_spread_V", "scale_spread", "misalignment_deg"),
    "cross-axis terms, known form or not": (
        "cross_quadratic_V_per_g2",
        "cross_linear_V_per_g",
        "scale_variation_per_g",
        "cross_fold_V",
        "cross_product_V_per_g2",
        "spring_per_g2",
    ),
    "spread of the RC filters": ("rc_spread",),
    "temperature": ("bias_temperature_mg_per_K", "scale_temperature_per_K", "temperature_offset_K"),
    "supply": ("supply_spread", "supply_wander_mV", "divider_spread"),
    "converter noise, offset, gain": ("daq_noise_uV", "daq_offset_uV", "daq_gain_spread"),
    "magnetometer": (
        "magnetometer_noise_uG",
        "magnetometer_offset_V",
        "magnetometer_scale_spread",
        "magnetometer_misalignment_deg",
        "hard_iron_mG",
        "soft_iron",
    ),
    "sensor positions": (),
}
POSITIONS = "sensor positions"
NOTHING, EVERYTHING = "none: filters and quantisation alone", "all sources"


@dataclass(frozen=True)
class Share:
    """Error rms in um with this source alone, and with all but this one; vector over the body axes."""

    source: str
    alone_um: float
    without_um: float
    share: float


@dataclass(frozen=True)
class Budget:
    """``total_um`` and ``floor_um``: all sources, none. ``axes_um``: total by body axis, ``tremor_um``: the truth."""

    total_um: float
    floor_um: float
    axes_um: tuple[float, float, float]
    tremor_um: tuple[float, float, float]
    shares: tuple[Share, ...]


def variant(on: set[str]) -> EmulationConfig:
    """The bench's unit 1 with only these sources; the magnetic field of the stacks is absent."""
    off: dict[str, Any] = {name: 0.0 for source, names in SOURCES.items() if source not in on for name in names}
    spread = InstrumentConfig().position_spread_mm if POSITIONS in on else 0.0
    return EmulationConfig(
        unit=1, seed=1, sensors=SensorConfig(**off), instrument=InstrumentConfig(position_spread_mm=spread)
    )


def calibrated_config(config: EmulationConfig) -> SensingConfig:
    """Return what the firmware knows after a tumble of this unit."""
    table = identify(measure_tumble(config, 100, 5.0)[0]).table
    return SensingConfig.model_validate(drawing(config) | table)


def _band(signal: Array, cutoff_rad_s: float | None = None) -> Array:
    """(n, 3) cut to the band; with ``cutoff_rad_s`` also divided by the displacement's known response."""
    spectrum = np.fft.rfft(signal - signal.mean(axis=0), axis=0)
    f: Array = np.fft.rfftfreq(len(signal), 1e-3).astype(np.float64)
    inside = (f >= BAND_HZ[0]) & (f <= BAND_HZ[1])
    spectrum[~inside] = 0.0
    if cutoff_rad_s is not None:
        spectrum[inside] /= displacement_response(f[inside], 1000.0, cutoff_rad_s)[:, None]
    return np.asarray(np.fft.irfft(spectrum, len(signal), axis=0))


def tip_error_um(result: SceneResult, cutoff_rad_s: float) -> tuple[Array, Array]:
    """Rms (3,) of the error and of the truth in the band, body axes."""
    rows = slice(round(SETTLE_S / result.step_s), None)
    attitude = Rotation.from_quat(np.roll(result["true_quaternion"][rows], -1, axis=1))
    true = attitude.inv().apply(_band(result["true_tip_m"][rows]))
    edge = round(EDGE_S / result.step_s)
    error = (_band(result["tip_displacement_m"][rows], cutoff_rad_s) - true)[edge:-edge]
    rms = [1e6 * np.sqrt(np.mean(x**2, axis=0)) for x in (error, true[edge:-edge])]
    return rms[0], rms[1]


def _measure(on: set[str], seconds: float) -> tuple[Array, Array]:
    config = variant(on)
    sensing = calibrated_config(config)
    return tip_error_um(run_scene(config, sensing, SyntheticHand(config.hand, 1), seconds), sensing.cutoff_rad_s)


@cache
def budget(seconds: float = SECONDS) -> Budget:
    """Every source alone and left out."""
    everything = set(SOURCES)
    axes, tremor = _measure(everything, seconds)
    total = float(np.linalg.norm(axes))
    floor = float(np.linalg.norm(_measure(set(), seconds)[0]))
    shares = []
    for source in SOURCES:
        alone = float(np.linalg.norm(_measure({source}, seconds)[0]))
        without = float(np.linalg.norm(_measure(everything - {source}, seconds)[0]))
        shares.append(Share(source, alone, without, 1.0 - (without / total) ** 2))
    x, y, z = (float(v) for v in axes)
    tx, ty, tz = (float(v) for v in tremor)
    return Budget(total, floor, (x, y, z), (tx, ty, tz), tuple(shares))


def rows() -> list[Row]:
    """The goal. The shares of the sources have no published counterpart: `micron sensing budget` prints them."""
    axes, truth = _measure(set(SOURCES), SECONDS)
    condition = (
        f"8 to 12 Hz, default hand, {SECONDS - SETTLE_S:g} s, all sensor errors on, after calibration; "
        "delay and gain of the firmware's band filter and of the nominal RC filter are taken off"
    )
    tremor = ", ".join(f"{v:.1f}" for v in truth)
    return [
        Row(
            "Ang 2004, sec. 2.1.1 (ii)",
            f"rms error of tip displacement, {what}",
            "um",
            condition,
            GOAL_UM,
            value,
            "lower",
            "emulated",
            why=f"tremor in the band: {tremor} um rms",
        )
        for what, value in (("worst axis", float(axes.max())), ("vector", float(np.linalg.norm(axes))))
    ]
