"""Converts the JSON of ``micron noise`` into the part of [firmware.sensing] that the filters' covariances use.

Columns are found by name: ``accelerometer_1x`` ... in m/s^2; ``magnetometer_x`` ... in uT may be absent. N becomes the
white noise of an axis; flicker, random walk and ramp together become its drift over 100 s.
"""

from __future__ import annotations

import json
from math import log, pi, sqrt
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from firmware_py.frame import XYZ
from firmware_py.sensing.calibration import reading_names
from firmware_py.sensing.config import DRIFT_S, SensingConfig
from hal.errors import BenchError
from hal.types import STANDARD_GRAVITY
from hal.validation import describe_validation_error

FLAT = 2.0 * log(2.0) / pi
"""Allan variance of flicker noise over B^2 (IEEE 952)."""
LEAST_RC_TIMES = 3.0


class _Coefficient(BaseModel):
    value: float = Field(ge=0.0, allow_inf_nan=False)


class _Model(BaseModel):
    white: _Coefficient
    flicker: _Coefficient
    walk: _Coefficient
    ramp: _Coefficient

    def drift(self) -> float:
        """Rms change over ``DRIFT_S``: random walk, ramp, and for flicker between averages as long as that."""
        walk, ramp = self.walk.value**2 * DRIFT_S, (self.ramp.value * DRIFT_S) ** 2
        return sqrt(2.0 * FLAT * self.flicker.value**2 + walk + ramp)


class _Column(BaseModel):
    model: _Model


class _NoiseFile(BaseModel):
    model_config = ConfigDict(extra="ignore")

    format: int
    scale: float
    shortest_s: float
    columns: dict[str, _Column]


def noise_table(path: Path, config: SensingConfig) -> dict[str, Any]:
    """Keys of [firmware.sensing] from the file; ``config`` has axes and filter of this instrument.

    Raises ``BenchError`` naming the file and what is wrong with it.
    """
    try:
        found = _NoiseFile.model_validate(json.loads(path.read_text(encoding="utf-8-sig")))
    except OSError as error:
        raise BenchError(f"{path}: noise file cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise BenchError(f"{path}: not the JSON of `micron noise --json`: {error}") from error
    except ValidationError as error:
        where = f"{path}: not the JSON of `micron noise --json`"
        raise BenchError(describe_validation_error(error, where)) from error
    if found.format != 1 or found.scale != 1.0:
        raise BenchError(f"{path}: noise file needs format = 1 and scale = 1 (units come from the columns' names)")
    least_s = LEAST_RC_TIMES / config.cutoff_rad_s
    if found.shortest_s < least_s:
        raise BenchError(
            f"{path}: averages from {found.shortest_s:g} s on were used, below {least_s:.3f} s the sensors' RC filter "
            "bends them; run `micron noise` again with --shortest-s 0.1"
        )
    names = reading_names(len(config.channels))
    for name in names:
        if name not in found.columns:
            raise BenchError(
                f"{path}: the noise of '{name}' is missing; there are: {', '.join(found.columns)}. Make the file with "
                "`micron noise RECORDING --bench BENCH`"
            )
    axes = [found.columns[name].model for name in names]
    table: dict[str, Any] = {
        "noise_ug_per_rtHz": [1e6 * sqrt(2.0) * model.white.value / STANDARD_GRAVITY for model in axes],
        "axis_drift_m_s2": [model.drift() for model in axes],
    }
    field = [f"magnetometer_{axis}" for axis in XYZ]
    if all(name in found.columns for name in field):
        table["magnetometer_noise_uT"] = max(found.columns[name].model.white.value for name in field)
    return table
