"""Compares the lab's measurements of stacks, manipulator and sensors with the firmware's models of them.

Each part is compared on a recording of its own before anything is identified; the remedy is the calibration that
``micron calibrate`` would write from the lab's set of recordings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.actuation.manipulator import star_tip
from firmware_py.control.plan import load_plan
from hal.bench import BenchFile
from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import holding_frame
from sim_devices.plant.lab import (
    CALIBRATION_SET,
    INTERFEROMETER_RMS_UM,
    in_place,
    measure_piezo,
    measure_tumble,
    write_recording,
)
from sim_devices.plant.lab_motion import NODE_S, SHAKES_HZ, measure_motion
from sim_devices.plant.lab_scan import measure_scan
from sim_devices.plant.streams import stream
from tools.calibrate.calibration_file import calibration_toml
from tools.calibrate.manipulator import identify_manipulator, load_scan, manipulator_calibration
from tools.calibrate.piezo import identify_stack, piezo_calibration
from tools.calibrate.piezo_prediction import simulate as predict_stroke
from tools.calibrate.sensor_lag import SensorLag, identify_lag, lag_at, unfiltered_V
from tools.calibrate.tumble import identify as identify_sensors
from tools.calibrate.tumble import load_tumble
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import from_table, load

AMPLITUDE_V = 41.7
CHECK_S, CHECK_HZ = 8.0, 250.0
"""Length of the recording by which a stack is compared, and the rate at which it is diagnosed."""
PROFILES = (("loops", 10.0), ("sawtooth", 2.0))
"""Inputs of the comparison: minor loops about every level, then one speed between those of the calibration."""
POSITIONS, POSITION_S = 100, 5.0
SHAKE_S = 20.0
TREMOR_HZ = 10.0
GRID = 5


@dataclass(frozen=True)
class Lab:
    """Holds the emulated bench and its reference instruments. ``seed`` draws their noise."""

    bench: BenchFile
    config: EmulationConfig
    folder: Path


@dataclass(frozen=True)
class Comparison:
    """Holds the ``rms`` of measured less modelled values, in ``unit``.

    ``recording`` is for the engine; the modelled course is its simulated column. ``axis`` is the stack
    that differs most.
    """

    rms: float
    unit: str
    recording: Recording | None = None
    axis: int | None = None


@dataclass(frozen=True)
class Part:
    """Describes a part: ``compare`` measures and compares it, ``identify`` writes its calibration to a folder."""

    name: str
    compare: Callable[[Lab], Comparison]
    identify: Callable[[Lab], Path]


def _measured_stack(lab: Lab, axis: int, profile: str, rate_hz: float, seconds: float, volts: float) -> dict[str, Any]:
    twin = in_place(lab.config, lab.bench.path, axis, None)
    return measure_piezo(lab.config, axis, profile, rate_hz, seconds, volts, twin=twin)[0]


def compare_stacks(lab: Lab) -> Comparison:
    """Compare each stack with the firmware's model of it, about the mean of both, and return the worst."""
    worst: tuple[float, Recording, int] | None = None
    for axis, believed in enumerate(load_plan(lab.bench).stages.actuation.stacks):
        parts = [_measured_stack(lab, axis, p, hz, CHECK_S, AMPLITUDE_V) for p, hz in PROFILES]
        predicted = [predict_stroke(believed, p["command_V"]) for p in parts]
        for part, modelled in zip(parts, predicted, strict=True):
            away = part["displacement_um"] - modelled
            rms = float(np.std(away))
            if worst is None or rms > worst[0]:
                worst = (rms, _as_columns(lab, axis, part, modelled), axis)
    assert worst is not None
    return Comparison(worst[0], "um", worst[1], worst[2])


def _as_columns(lab: Lab, axis: int, part: dict[str, Any], modelled: np.ndarray) -> Recording:
    step = round(1000.0 / CHECK_HZ)
    columns = {
        "command_V": part["command_V"][::step],
        "believed_um": modelled[::step] - modelled.mean() + part["displacement_um"].mean(),
        "displacement_um": part["displacement_um"][::step],
    }
    text = {
        "format": 1, "rate_hz": CHECK_HZ, "title": f"stack {axis + 1} against the firmware's model",
        "twin": {"kind": "columns"},
        "channels": [
            {"column": "command_V", "role": "input", "signal": "command", "unit": "V"},
            {"column": "believed_um", "role": "input", "signal": "simulated_displacement", "unit": "um"},
            {"column": "displacement_um", "role": "output", "signal": "displacement", "unit": "um",
             "noise_rms": INTERFEROMETER_RMS_UM},
        ],
    }  # fmt: skip
    return from_table(lab.folder / f"stack{axis + 1}", text, columns)


def identify_stacks(lab: Lab) -> Path:
    """Identify all three stacks from the lab's set of recordings and return the calibration file."""
    fits: list[Any] = []
    for axis in range(3):
        recordings: list[Recording] = []
        for profile, rate_hz, seconds, share in CALIBRATION_SET:
            twin = in_place(lab.config, lab.bench.path, axis, None)
            columns, text = measure_piezo(lab.config, axis, profile, rate_hz, seconds, share * AMPLITUDE_V, twin=twin)
            folder = lab.folder / f"stack{axis + 1}" / f"{profile}-{rate_hz:g}Hz-{share:g}"
            write_recording(folder, columns, text)
            recordings.append(load(folder))
        fits.append(identify_stack(recordings))
    file = lab.folder / "piezo.toml"
    file.write_text(piezo_calibration(fits, "piezo stacks"))
    return file


def compare_manipulator(lab: Lab) -> Comparison:
    """Compare the tip with the firmware's geometry at a grid of voltages."""
    a = load_plan(lab.bench).stages.actuation
    data = load_scan(scan_tip(lab))
    rest, at, zero = np.array(a.rest_heights_m), np.empty((len(data["tip_um"]), 3)), np.empty(3)
    star_tip(rest, a.ball_circle_m, a.shaft_m, zero)
    for k, stroke in enumerate(data["stroke_um"]):
        star_tip(rest + np.array(a.lever_gain) * stroke * 1e-6, a.ball_circle_m, a.shaft_m, at[k])
    # rows of the mounting are the manipulator's axes in the body
    away = data["tip_um"] - 1e6 * (at - zero) @ np.array(a.mounting)
    return Comparison(float(np.sqrt(np.mean((away - away.mean(axis=0)) ** 2))), "um")


def scan_tip(lab: Lab) -> Path:
    """Scan the tip over a grid of voltages and return the recording."""
    folder = lab.folder / "scan"
    columns, text = measure_scan(lab.config, GRID, stream(lab.config.seed, "lab.manipulator"))
    write_recording(folder, columns, text)
    return folder


def identify_geometry(lab: Lab) -> Path:
    """Identify the manipulator from a scan of its workspace and return the calibration file."""
    file = lab.folder / "manipulator.toml"
    file.write_text(manipulator_calibration(identify_manipulator(load_scan(scan_tip(lab))), "manipulator"))
    return file


def compare_sensors(lab: Lab) -> Comparison:
    """Compare the accelerometer axes with the firmware's calibration at resting attitudes."""
    sensing = load_plan(lab.bench).stages.sensing
    data = load_tumble(_tumble(lab))
    gravity = lab.config.environment.gravity_m_s2
    force = data["attitude"].transpose(0, 2, 1) @ np.array([0.0, 0.0, 1.0])
    ratio = data["analog_V"][:, 6] * sensing.supply_divider / sensing.nominal_supply_V
    modelled = np.array(sensing.bias_V) + np.array(sensing.scale_V_per_g) * (force @ np.array(sensing.axes).T)
    away = (data["analog_V"][:, :6] / ratio[:, None] - modelled) / np.array(sensing.scale_V_per_g)
    return Comparison(gravity * float(np.sqrt(np.mean(away**2))), "m/s^2")


def _tumble(lab: Lab) -> Path:
    folder = lab.folder / "tumble"
    columns, text = measure_tumble(lab.config, POSITIONS, POSITION_S)
    write_recording(folder, columns, text)
    return folder


def identify_tumble(lab: Lab) -> Path:
    """Identify the sensors from resting attitudes and return the calibration file."""
    found = identify_sensors(load_tumble(_tumble(lab)), quadratic=True, fit_drift=False)
    table = {"sensing": {**found.table, "gravity_m_s2": lab.config.environment.gravity_m_s2}}
    file = lab.folder / "sensors.toml"
    file.write_text(calibration_toml("sensors", "micron mismatch heal", table))
    return file


def compare_lag(lab: Lab) -> Comparison:
    """Compare the delay of the accelerometers at 10 Hz with that of the filter in which the firmware believes."""
    sensing = load_plan(lab.bench).stages.sensing
    believed = lag_at(1.0 / sensing.cutoff_rad_s, 0.0, TREMOR_HZ)
    found = _lag(lab)
    measured = lag_at(found.filter_s, found.delay_s, TREMOR_HZ)
    return Comparison(1e3 * abs(float(np.angle(measured / believed))) / (2.0 * np.pi * TREMOR_HZ), "ms at 10 Hz")


def _lag(lab: Lab) -> SensorLag:
    columns, text = measure_motion(lab.config, "shake", SHAKE_S)
    write_recording(lab.folder / "shake", columns, text)
    gravity = lab.config.environment.gravity_m_s2
    attitude = holding_frame(lab.config.hand)
    force_g = (columns["acceleration_m_s2"] + np.array([0.0, 0.0, gravity])) @ attitude / gravity
    unfiltered = unfiltered_V(load_plan(lab.bench).stages.sensing, force_g)
    settled = slice(round(1.0 / NODE_S), None)
    return identify_lag(unfiltered[settled], columns["analog_V"][settled, :6], NODE_S, np.array(SHAKES_HZ))


def identify_timing(lab: Lab) -> Path:
    """Write the calibration of the accelerometers' filter and of the delay behind it, from a shaker."""
    found = _lag(lab)
    stages = load_plan(lab.bench).stages
    table = {
        "sensing": {"filter_farad": found.filter_s / stages.sensing.filter_ohm},
        "tremor": {"loop_delay_s": stages.tremor.loop_delay_s + found.delay_s},
    }
    file = lab.folder / "timing.toml"
    file.write_text(calibration_toml("filter and delay of the sensors", "micron mismatch heal", table))
    return file


PARTS = (
    Part("stacks", compare_stacks, identify_stacks),
    Part("manipulator", compare_manipulator, identify_geometry),
    Part("sensors", compare_sensors, identify_tumble),
    Part("timing", compare_lag, identify_timing),
)
"""Parts in the order in which they are healed: first those that move the tip, then those that measure it."""
