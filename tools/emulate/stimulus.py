"""Reads a column of a recording as a stimulus: ``daq.0=out/run.csv:acc1_x_V``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_py.recording.errors import RecordingError as OwnRecordingError
from tools.errors import InputError, RecordingError
from tools.mismatch.recording_columns import column_names, read_columns

FORM = "PART.CHANNEL=FILE:COLUMN, or FILE:COLUMN@RATE where the file has no time column"
TIMES = {"t": 1.0, "t_s": 1.0, "time": 1.0, "time_s": 1.0, "t_ms": 1e-3, "time_ms": 1e-3, "t_us": 1e-6, "t_ns": 1e-9}
"""Names of time columns, in the order in which they are looked for, and their units in s."""


@dataclass(frozen=True)
class Stimulus:
    """Holds one column for one channel: ``t_s`` (n,) from zero, ``values`` (n,) in the unit of the channel."""

    channel: str
    t_s: NDArray[np.float64]
    values: NDArray[np.float64]


def read_stimulus(text: str) -> Stimulus:
    """Read what ``--stimulus`` names. Raises ``InputError``."""
    match = re.fullmatch(r"([^=]+\.[^=.]+)=(.+):([^:@]+)(?:@([0-9.eE+]+))?", text)
    if match is None:
        raise InputError(f"--stimulus {text}: write it as {FORM}")
    channel, file, column, rate = match.groups()
    path = Path(file)
    try:
        columns = _columns(path, column, needs_time=rate is None)
    except (RecordingError, OwnRecordingError, OSError) as error:
        raise InputError(f"--stimulus {text}: {error}") from error
    values = columns[column]
    if rate is not None:
        rate_hz = _number(rate)
        if not 0.0 < rate_hz < 1e7:
            raise InputError(f"--stimulus {text}: {rate} is not a rate in Hz above 0")
        t_s = np.arange(len(values)) / rate_hz
    else:
        name = next(name for name in TIMES if name in columns)
        t_s = (columns[name] - columns[name][0]) * TIMES[name]
    if not (np.isfinite(values).all() and np.isfinite(t_s).all() and (np.diff(t_s) > 0).all()):
        raise InputError(f"--stimulus {text}: times must rise, and times and values must be finite; cut or repair it")
    return Stimulus(channel, t_s, values)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _columns(path: Path, column: str, *, needs_time: bool) -> dict[str, NDArray[np.float64]]:
    names = column_names(path)
    time = next((name for name in TIMES if name in names and name != column), None)
    if needs_time and time is None:
        raise RecordingError(
            f"{path}: no time column ({', '.join(TIMES)}); add its rate in Hz, {path.name}:{column}@1000"
        )
    return read_columns(path, [column] if time is None or not needs_time else [column, time])
