"""Reads sensor logs: a folder (recording.toml, meta.toml or data.npz in it), a descriptor, or a data file alone.

A data file has any format that ``recording_columns`` reads, recordings of ``micron run`` among them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hal.arrays import Array
from tools.errors import InputError
from tools.mismatch.recording_columns import SUFFIXES, column_names, column_units, read_columns

TIMES = ("t_s", "t", "time_s")
LOST = 1.5
"""A step of time longer than this many samples is a gap."""


@dataclass(frozen=True)
class SensorLog:
    """Columns of equal length (n,), the rate if it is known, what the folder's TOML says, units where it gives them.

    ``gaps``: how often time jumps ahead.
    """

    path: Path
    columns: dict[str, Array]
    rate_hz: float | None
    meta: dict[str, Any]
    units: dict[str, str] = field(default_factory=dict[str, str])
    gaps: int = 0
    time_column: str | None = None

    def matrix(self, names: tuple[str, ...]) -> Array:
        """(n, len(names)); ``InputError`` names a column that is missing or not finite."""
        for name in names:
            if name not in self.columns:
                raise InputError(f"{self.path}: no column '{name}'; {what_there_is(self.columns)}")
        data = np.stack([self.columns[name] for name in names], axis=1)
        if not np.all(np.isfinite(data)):
            row, column = np.argwhere(~np.isfinite(data))[0]
            raise InputError(f"{self.path}: '{names[column]}' is not finite at sample {row}")
        return data

    def need_rate(self) -> float:
        if self.rate_hz is None:
            raise InputError(f"{self.path}: no time column and no rate_hz beside it; give --rate-hz")
        return self.rate_hz


def what_there_is(columns: Collection[str], most: int = 16) -> str:
    """Return the names as text for a message, only the first ones where there are many."""
    more = f" and {len(columns) - most} more" if len(columns) > most else ""
    return f"there are: {', '.join(list(columns)[:most])}{more}"


def load_log(path: Path, rate_hz: float | None = None) -> SensorLog:
    """Read ``path``; ``rate_hz`` overrides what the file says. ``InputError`` for everything that is wrong with it."""
    file, descriptor = _find(path)
    meta = _toml(descriptor) if descriptor is not None else {}
    channels = [c for c in meta.get("channels", []) if isinstance(c, dict) and isinstance(c.get("column"), str)]
    units = {str(c["column"]): str(c["unit"]) for c in channels if "unit" in c}
    names = column_names(file)
    if not names:
        raise InputError(f"{file}: no columns of numbers; a log needs a line of names and lines of numbers below it")
    columns = read_columns(file, names)
    if next(iter(columns.values())).size == 0:
        raise InputError(f"{file}: its columns hold no samples; record again, or name another file")
    units = {**column_units(file), **units}
    named = meta.get("time_column")
    time = named if isinstance(named, str) else next((name for name in TIMES if name in columns), None)
    if time is None:
        time = next((name for name in columns if name.endswith(".log_time_s")), None)
    gaps = 0
    if time is not None:
        if time not in columns:
            raise InputError(
                f"{descriptor}: time_column '{time}' is no column of {file}; it has {', '.join(list(columns)[:8])}"
            )
        step = np.diff(columns[time])
        if len(step) == 0 or not np.all(np.isfinite(step)) or np.min(step) <= 0.0:
            where = int(np.argmin(np.where(np.isfinite(step), step, -np.inf))) if len(step) else 0
            raise InputError(
                f"{file}: time column '{time}' does not run forward at sample {where + 1}; sort the log or cut it"
            )
        usual = float(np.median(step))
        gaps = int(np.sum(step > LOST * usual))
        rate_hz = rate_hz or 1.0 / usual
    if rate_hz is None and isinstance(meta.get("rate_hz"), int | float) and float(meta["rate_hz"]) > 0.0:
        rate_hz = float(meta["rate_hz"])
    return SensorLog(file, columns, rate_hz, meta, units, gaps, time)


def _find(path: Path) -> tuple[Path, Path | None]:
    """Return the data file and its descriptor: a ``recording.toml`` that names it, or the ``meta.toml`` of a set."""
    if path.is_dir():
        for name in ("recording.toml", "meta.toml"):
            if (path / name).is_file():
                return _data(path / name), path / name
        return path / "data.npz", None
    if path.suffix.lower() == ".toml":
        return _data(path), path
    descriptor, about_all = path.parent / "recording.toml", path.parent / "meta.toml"
    if descriptor.is_file() and _data(descriptor) == path:
        return path, descriptor
    return path, about_all if about_all.is_file() else None


def _data(descriptor: Path) -> Path:
    name = _toml(descriptor).get("data", "data.npz")
    if not isinstance(name, str):
        raise InputError(f"{descriptor}: 'data' must name the data file ({', '.join(SUFFIXES)}), got {name!r}")
    return descriptor.parent / name


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
