"""Sensor logs: a folder or .npz of one array per column, as recorded by the lab, exported, or re-packed."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.cli.common import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorLog:
    """Columns of equal length (n,), the rate if it is known, and what the folder's TOML says."""

    path: Path
    columns: dict[str, Array]
    rate_hz: float | None
    meta: dict[str, Any]

    def matrix(self, names: tuple[str, ...]) -> Array:
        """(n, len(names)); ``InputError`` names a column that is missing or not finite."""
        for name in names:
            if name not in self.columns:
                raise InputError(f"{self.path}: no column '{name}'; there are: {', '.join(self.columns)}")
        data = np.stack([self.columns[name] for name in names], axis=1)
        if not np.all(np.isfinite(data)):
            row, column = np.argwhere(~np.isfinite(data))[0]
            raise InputError(f"{self.path}: '{names[column]}' is not finite at sample {row}")
        return data

    def need_rate(self) -> float:
        if self.rate_hz is None:
            raise InputError(f"{self.path}: no time column and no rate_hz beside it; give --rate-hz")
        return self.rate_hz


def load_log(path: Path, rate_hz: float | None = None) -> SensorLog:
    """Read ``path`` (folder with data.npz, or .npz); ``rate_hz`` overrides what the file says."""
    file = path / "data.npz" if path.is_dir() else path
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as .npz ({error})") from error
    meta: dict[str, Any] = {}
    for name in ("meta.toml", "recording.toml"):
        beside = file.parent / name
        if beside.is_file():
            try:
                meta = tomllib.loads(beside.read_text())
            except tomllib.TOMLDecodeError as error:
                raise InputError(f"{beside}: {error}") from error
            break
    lengths = {len(array) for array in arrays.values() if array.ndim == 1}
    if not lengths:
        raise InputError(f"{file}: holds no columns (one-dimensional arrays)")
    length = max(lengths)
    columns = {
        name: array.astype(np.float64) for name, array in arrays.items() if array.ndim == 1 and len(array) == length
    }
    for name, array in arrays.items():
        if array.ndim == 2 and len(array) == length and array.shape[1] <= 16:
            columns.update({f"{name}_{i}": array[:, i].astype(np.float64) for i in range(array.shape[1])})
    if rate_hz is None and "t_s" in columns:
        rate_hz = float(1.0 / np.median(np.diff(columns["t_s"])))
    if rate_hz is None and isinstance(meta.get("rate_hz"), int | float):
        rate_hz = float(meta["rate_hz"])
    return SensorLog(file, columns, rate_hz, meta)
