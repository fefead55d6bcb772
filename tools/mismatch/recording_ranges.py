"""Reads the ranges of samples that a recording states: runs (``segments``) and ``[split]``; and its conditions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np

from hal.trust import path_inside
from tools.errors import RecordingError, refuse_unknown_keys
from tools.mismatch.recording import Condition, Split
from tools.mismatch.recording_clock import CUT
from tools.numbers import is_finite_number

MIN_SPAN = 30  # least samples of a run, and of a [split] range
SPLIT_KEYS = ("fit", "test", "initialization")
FURTHER_TEST = "test_"
"""Beginning of the names of further test ranges, which benchmarks state; they are checked and not used."""
APART = ("state_space", "mechanical_axis", "ode", "piezo_stack", "accelerometer", "magnetometer")
"""Kinds of twins whose plants restart at a segment, or have no state."""


def _enough(path: Path, found: Mapping[str, tuple[int, int] | Path], initialization: int) -> None:
    """Check that the ranges are long enough for a fit and a score and share no samples."""
    for key, skip in (("fit", 0), ("test", initialization)):
        span = found.get(key)
        if isinstance(span, tuple) and span[1] - span[0] - skip < MIN_SPAN:
            raise RecordingError(
                f"{path}: [split] {key}: {span[1] - span[0] - skip} samples to go by; at least {MIN_SPAN} are needed"
            )
        if isinstance(span, Path) and span.resolve() == path.resolve():
            raise RecordingError(f"{path}: [split] {key} names this recording itself; give a range of samples")
    fit, test = found.get("fit"), found.get("test")
    if isinstance(fit, tuple) and isinstance(test, tuple) and fit[0] < test[1] and test[0] < fit[1]:
        raise RecordingError(f"{path}: [split] fit {list(fit)} and test {list(test)} share samples; move one of them")


def read_begins(path: Path, value: object) -> list[int]:
    """Return the samples of ``segments``, unchecked but for their type. Raises RecordingError."""
    if value is None:
        return []
    if not isinstance(value, list) or not all(isinstance(i, int) and not isinstance(i, bool) for i in value):
        raise RecordingError(f"{path}: segments must be a list of samples at which a new run begins, got {value!r}")
    return value


def read_segments(path: Path, value: object, n: int, kind: str, resampled: bool) -> tuple[int, ...]:
    """Return the samples at which further runs begin."""
    begins = read_begins(path, value)
    if value is None:
        return ()
    lengths = np.diff([0, *begins, n])
    if 0 in begins:
        raise RecordingError(f"{path}: segments {value}: the first run begins at 0 in any case; leave the 0 out")
    if np.any(lengths < MIN_SPAN):
        raise RecordingError(
            f"{path}: segments {value} leave a run of {int(lengths.min())} of the {n} samples; each needs {MIN_SPAN},"
            " in rising order"
        )
    if kind not in APART:
        raise RecordingError(f"{path}: a twin of kind '{kind}' runs through; make a recording of each of the segments")
    if resampled:
        raise RecordingError(f"{path}: segments count samples, which an irregular time column does not keep; {CUT}")
    return tuple(begins)


def read_conditions(where: str, value: object) -> dict[str, Condition]:
    """Return the conditions of the recording. Dates become days since 1970; one without an offset is read as UTC."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise RecordingError(f"{where}: [conditions] must be a table of numbers, texts or dates, got {value!r}")
    found: dict[str, Condition] = {}
    for key, item in value.items():
        if isinstance(item, date):
            full = item if isinstance(item, datetime) else datetime(item.year, item.month, item.day)
            found[key] = (full if full.tzinfo else full.replace(tzinfo=UTC)).timestamp() / 86400.0
        elif isinstance(item, str):
            found[key] = item
        elif is_finite_number(item):
            found[key] = float(item)
        else:
            raise RecordingError(f"{where}: [conditions] {key} must be a number, a text or a date, got {item!r}")
    return found


def read_split(path: Path, value: object, n: int) -> Split:
    if value is None:
        return Split()
    if not isinstance(value, Mapping):
        raise RecordingError(f"{path}: [split] must be a table")
    refuse_unknown_keys(f"{path}: [split]", (k for k in value if not k.startswith(FURTHER_TEST)), SPLIT_KEYS)
    found: dict[str, tuple[int, int] | Path] = {}
    initialization: int | None = None
    for key, v in value.items():
        at = f"{path}: [split] {key}"
        if key == "initialization":
            if isinstance(v, bool) or not isinstance(v, int) or not 0 <= v < n:
                raise RecordingError(f"{at} must be a number of samples below {n}, got {v!r}")
            initialization = v
        elif isinstance(v, str) and re.search(r"\.toml$", v):
            found[key] = path_inside(path, v)
        elif isinstance(v, list) and len(v) == 2 and all(isinstance(i, int) and not isinstance(i, bool) for i in v):
            if not 0 <= v[0] < v[1] <= n:
                raise RecordingError(f"{at}: [{v[0]}, {v[1]}] must rise and lie in the {n} samples of the recording")
            found[key] = (v[0], v[1])
        else:
            raise RecordingError(f"{at} must be [start, stop] in samples or the name of another .toml, got {v!r}")
    _enough(path, found, initialization or 0)
    return Split(found.get("fit"), found.get("test"), initialization)
