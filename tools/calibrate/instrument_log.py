"""Reads a recording of the whole instrument as calibrated readings: from ``micron run``, or volts from the lab.

Volts (``analog_V_0`` ... and ``magnetometer_V_0`` ..., or ``volts_0`` ... and ``magnetometer_raw_x`` ... of a run) pass
the firmware's own calibration with the bench's numbers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from firmware_py.control.plan import load_plan
from firmware_py.frame import COUNTS, LAYOUT, MAGNETOMETER_RAW, XYZ
from firmware_py.sensing.calibration import calibrate, calibrate_magnetometer, calibration_params, reading_names
from firmware_py.sensing.config import SensingConfig
from hal.arrays import Array
from hal.bench import load_bench
from hal.compiled import kernel
from tools.calibrate.logs import SensorLog, what_there_is
from tools.errors import InputError

INPUTS = 8
_FIELD = LAYOUT.start("magnetometer")


@kernel
def calibrate_rows(counts, field_V, params, smoothed, frame, out):
    """``out``: readings (n, N) m/s^2, field (n, 3) uT from counts (n, 8), volts (n, 3); the first bad row or -1."""
    p = params[0]
    readings, field = out
    for k in range(len(counts)):
        for i in range(counts.shape[1]):
            frame[COUNTS + i] = counts[k, i]
        for i in range(3):
            frame[MAGNETOMETER_RAW + i] = field_V[k, i]
        if calibrate(frame, smoothed, p, readings[k]) < 0:
            return k
        if calibrate_magnetometer(frame, p):
            for i in range(3):
                field[k, i] = frame[_FIELD + i]
    return -1


def bench_sensing(path: Path) -> SensingConfig:
    """Return the sensing configuration of a bench's firmware. ``BenchError`` names the fault in the file."""
    bench = load_bench(path)
    scan = next(iter(bench.description.devices_with("di4108", "nidaqmx")), None)
    if scan is None:
        raise InputError(f"{path}: this bench has no DAQ, so no instrument whose sensors could be calibrated")
    return load_plan(bench).stages.sensing


def calibrated_log(log: SensorLog, bench: Path) -> SensorLog:
    """``log`` with the readings of the instrument's axes and magnetometer as its only columns."""
    config = bench_sensing(bench)
    readings, field = instrument_readings(log, config)
    names = (*reading_names(readings.shape[1]), *(f"magnetometer_{axis}" for axis in XYZ))
    columns = dict(zip(names, np.hstack([readings, field]).T, strict=True))
    units = {name: "m/s^2" if name.startswith("a") else "uT" for name in names}
    return replace(log, columns=columns, units=units, time_column=None)


def instrument_readings(log: SensorLog, config: SensingConfig) -> tuple[Array, Array]:
    """Return readings (n, N) in m/s^2 and field (n, 3) in uT. Raises ``InputError`` for a log of another instrument."""
    for analog, magnet in (
        (tuple(f"analog_V_{i}" for i in range(INPUTS)), tuple(f"magnetometer_V_{i}" for i in range(3))),
        (tuple(f"volts_{i}" for i in range(INPUTS)), tuple(f"magnetometer_raw_{axis}" for axis in XYZ)),
    ):
        if analog[0] in log.columns:
            counts, volts = log.matrix(analog) / config.lsb_V, log.matrix(magnet)
            readings, field = np.zeros((len(counts), len(config.channels))), np.zeros((len(counts), 3))
            frame, smoothed = LAYOUT.new_frame(), np.full(2, np.nan)
            bad = calibrate_rows(counts, volts, calibration_params(config), smoothed, frame, (readings, field))
            if bad >= 0:
                raise InputError(
                    f"{log.path}: the supply (input {config.supply_channel}) of sample {bad} is no positive voltage;"
                    " cut the log there, or check the wiring of this input"
                )
            return readings, field
    names = reading_names(len(config.channels))
    if names[0] not in log.columns:
        raise InputError(
            f"{log.path}: no recording of the instrument: neither analog_V_0 ..., volts_0 ... nor {names[0]} ... is "
            f"there; {what_there_is(log.columns)}"
        )
    return log.matrix(names), log.matrix(tuple(f"magnetometer_{axis}" for axis in XYZ))
