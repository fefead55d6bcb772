"""Checks that the readers of this folder share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hal.arrays import Array
from tools.errors import RecordingError

MOST_SAMPLES = 50_000_000
"""Samples of a column, checked before anything of the size that a file claims is allocated."""


def check_size(path: Path, samples: int) -> None:
    """Raise RecordingError for more samples than ``MOST_SAMPLES``."""
    if samples > MOST_SAMPLES:
        raise RecordingError(f"{path}: {samples} samples, at most {MOST_SAMPLES} are read; cut it into parts")


def as_numbers(path: Path, name: str, values: object) -> Array:
    """Return float64 (n,). Times are seconds since the first one. Raises RecordingError for anything but numbers."""
    array = np.asarray(values)
    if array.ndim == 1 and array.dtype.kind == "M":
        steps = (array - array[:1]) / np.timedelta64(1, "ns")
        return np.asarray(steps * 1e-9, np.float64)
    if array.ndim == 1 and array.dtype.kind == "m":
        return np.asarray(array / np.timedelta64(1, "ns") * 1e-9, np.float64)
    if array.ndim != 1 or array.dtype.kind not in "fiub":
        raise RecordingError(
            f"{path}: column '{name}' is {array.dtype} of shape {array.shape}; needed: numbers, one dimension"
        )
    return np.ascontiguousarray(array, np.float64)
