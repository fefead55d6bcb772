"""Holds readings of one inertial sensor at an even rate, from a recording or a bench, in the units of Erat 2018's
tables.

Accelerations in g (specific force, +1 g on an axis that points up), rates in deg/s, temperature in degC.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hal.arrays import Array
from hal.types import STANDARD_GRAVITY
from tools.calibrate.logs import SensorLog, load_log
from tools.errors import InputError

AXES = ("x", "y", "z")
ACCEL_UNITS = {"g": 1.0, "m_s2": 1.0 / STANDARD_GRAVITY, "mg": 1e-3, "g_as_logged": 1.0}
GYRO_UNITS = {"deg_s": 1.0, "dps": 1.0, "rad_s": 180.0 / np.pi}
_TEMPERATURE = re.compile(r"temperature_(deg)?C")


@dataclass(frozen=True)
class Series:
    """``accel_g`` (n, 3), ``gyro_dps`` (n, 3) or None where there is none, ``temperature_C`` (n,) or None."""

    name: str
    rate_hz: float
    accel_g: Array
    gyro_dps: Array | None
    temperature_C: Array | None = None
    lost: int = 0

    @property
    def seconds(self) -> float:
        return len(self.accel_g) / self.rate_hz

    def part(self, start_s: float, stop_s: float | None = None) -> Series:
        """Samples from ``start_s`` up to ``stop_s``."""
        use = slice(round(start_s * self.rate_hz), None if stop_s is None else round(stop_s * self.rate_hz))
        return Series(
            self.name,
            self.rate_hz,
            self.accel_g[use],
            None if self.gyro_dps is None else self.gyro_dps[use],
            None if self.temperature_C is None else self.temperature_C[use],
            self.lost,
        )


@dataclass(frozen=True)
class Scales:
    """Holds the scales of raw counts and badly scaled columns. ``accel_factor`` repairs a range error of a logger."""

    accel_lsb_per_g: float | None = None
    gyro_lsb_per_dps: float | None = None
    accel_factor: float = 1.0


def load_series(path: Path, scales: Scales | None = None, rate_hz: float | None = None) -> Series:
    """Load a recording, a folder or .npz with columns ``acc_x_UNIT``, ``gyro_x_UNIT``, ``temperature_C``.

    Units: raw (counts), g, mg, m_s2; raw, deg_s, dps, rad_s. ``InputError`` says what is missing. ``rate_hz`` is
    for recordings without a time column: several recordings share it.
    """
    log = load_log(path)
    if log.time_column is None and rate_hz is not None:
        log = replace(log, rate_hz=rate_hz)
    scales = scales or Scales()
    accel = _triad(log, "acc", {**ACCEL_UNITS, "raw": _per(scales.accel_lsb_per_g)}, "--accel-lsb-per-g")
    if accel is None:
        raise InputError(f"{log.path}: no columns acc_x_UNIT ... acc_z_UNIT; there are {', '.join(log.columns)}")
    gyro = _triad(log, "gyro", {**GYRO_UNITS, "raw": _per(scales.gyro_lsb_per_dps)}, "--gyro-lsb-per-dps")
    warm = next((values for name, values in log.columns.items() if _TEMPERATURE.fullmatch(name)), None)
    return Series(path.name, log.need_rate(), accel * scales.accel_factor, gyro, warm)


def _per(lsb: float | None) -> float | None:
    return None if lsb is None else 1.0 / lsb


def _triad(log: SensorLog, stem: str, units: dict[str, float] | dict[str, float | None], option: str) -> Array | None:
    for unit, factor in units.items():
        names = tuple(f"{stem}_{axis}_{unit}" for axis in AXES)
        if names[0] not in log.columns:
            continue
        if factor is None:
            raise InputError(f"{log.path}: {names[0]} holds counts; say what they are worth with {option}")
        return log.matrix(names) * factor
    return None


def join_series(parts: list[Series]) -> Series:
    """Join series one after the other. All must have the same rate and the same columns."""
    first = parts[0]
    for other in parts[1:]:
        if other.rate_hz != first.rate_hz:
            raise InputError(
                f"{other.name}: {other.rate_hz:g} Hz, and {first.name} {first.rate_hz:g} Hz: give one rate"
            )

    def stack(columns: list[Array | None]) -> Array | None:
        present = [c for c in columns if c is not None]
        if len(present) not in (0, len(parts)):
            raise InputError(
                f"{', '.join(p.name for p in parts)}: the files do not have the same columns;"
                " give recordings of one sensor and one format"
            )
        return np.concatenate(present) if present else None

    return Series(
        "+".join(p.name for p in parts),
        first.rate_hz,
        np.concatenate([p.accel_g for p in parts]),
        stack([p.gyro_dps for p in parts]),
        stack([p.temperature_C for p in parts]),
        sum(p.lost for p in parts),
    )
