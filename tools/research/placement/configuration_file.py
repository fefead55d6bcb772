"""Configurations of accelerometers by name, from a file, from a bench, or from ``micron placement --json``."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hal.types import STANDARD_GRAVITY
from hal.validation import describe_validation_error
from tools.errors import InputError
from tools.research.placement.configurations import (
    Placement,
    cube_004,
    micron_000,
    micron_004,
    micron_004_turned,
    proposed_004,
)

Vector = tuple[float, float, float]
RC_HZ_FACTOR = (np.pi / 2.0 * 15.07) ** 0.5
NAMED = {
    "micron-000": micron_000,
    "micron-004": micron_004,
    "micron-004-turned": micron_004_turned,
    "cube-004": cube_004,
    "proposed-004": proposed_004,
}


class ConfigurationFile(BaseModel):
    """N axes: places in mm (or, as ``micron placement`` writes them, ``positions_m``), unit directions, own noise."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    format: Annotated[int, Field(ge=1, le=1)]
    name: str = ""
    positions_mm: tuple[Vector, ...] = ()
    positions_m: tuple[Vector, ...] = ()
    axes: tuple[Vector, ...]
    noise_mg: tuple[Annotated[float, Field(gt=0.0)], ...] | None = None

    @model_validator(mode="after")
    def _alike(self) -> ConfigurationFile:
        places = len(self.positions_mm) or len(self.positions_m)
        if places != len(self.axes) or (self.positions_mm and self.positions_m):
            raise ValueError(f"{places} positions for {len(self.axes)} axes; give positions_mm, one for each axis")
        if self.noise_mg is not None and len(self.noise_mg) != len(self.axes):
            raise ValueError(f"noise_mg has {len(self.noise_mg)} values for {len(self.axes)} axes")
        if any(not 0.99 < float(np.linalg.norm(axis)) < 1.01 for axis in self.axes):
            raise ValueError("axes must be unit vectors")
        return self


def load_configuration(given: str, noise_mg: float) -> tuple[Placement, NDArray[np.float64]]:
    """Placement and rms noise (N,) m/s^2 of ``given``; ``noise_mg`` where the file does not say."""
    noise = noise_mg * 1e-3 * STANDARD_GRAVITY
    if given in NAMED:
        placement = NAMED[given]()
        return placement, np.full(len(placement.axes), noise)
    path = Path(given)
    table = _read(path)
    if "firmware" in table or "device" in table:
        from tools.calibrate.instrument_log import bench_sensing

        sensing = bench_sensing(path)
        own = 1e-6 * np.array(sensing.noise_ug_per_rtHz) * STANDARD_GRAVITY * RC_HZ_FACTOR
        return Placement(str(path), sensing.axis_positions(), np.array(sensing.axes)), own
    try:
        file = ConfigurationFile.model_validate(table)
    except ValidationError as error:
        raise InputError(describe_validation_error(error, str(path))) from error
    places = np.array(file.positions_mm) * 1e-3 if file.positions_mm else np.array(file.positions_m)
    own = np.full(len(file.axes), noise)
    if file.noise_mg is not None:
        own = np.array(file.noise_mg) * 1e-3 * STANDARD_GRAVITY
    return Placement(file.name or path.stem, places, np.array(file.axes)), own


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        names = ", ".join(NAMED)
        raise InputError(f"'{path}' is no configuration: a file ({error.strerror}), or one of {names}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file: {error}") from error
    try:
        table = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: {error}") from error
    if not isinstance(table, dict):
        raise InputError(f"{path}: a table with format, positions_mm and axes is needed")
    return table
