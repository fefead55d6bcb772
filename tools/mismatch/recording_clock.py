"""Reads the clock of a recording: its time step, and the uniform grid to which an irregular time column is brought."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tools.errors import RecordingError
from tools.mismatch import units
from tools.mismatch.guess_roles import split_clock
from tools.mismatch.recording import Array

LONGEST_GAP = 20.0  # longest gap that is filled, in usual steps of a time column
MOST_MISSING = 0.02  # of the time
CUT = "'micron mismatch cut RECORDING --out FOLDER' keeps the longest stretch without gaps"


def in_seconds(column: str, stamps: Array, unit_in_file: str = "", notes: list[str] | None = None) -> Array:
    """Return the time stamps (n,) in s: converted, with a note, where the column's name or the file states another unit
    of time."""
    unit = unit_in_file if units.is_unit(unit_in_file) else split_clock(column)[1]
    if not unit or not units.same_dimension(unit, "s") or units.parse(unit).factor == 1.0:
        return stamps
    if notes is not None:
        notes.append(f"time column '{column}' is in {unit}: converted to s")
    return stamps * units.parse(unit).factor


def time_step(path: Path, name: str, stamps: Array, rate: float | None, notes: list[str]) -> tuple[float, Array | None]:
    """Return the time step of a monotonic time column, and the uniform grid to resample it to.

    A grid is needed where the column is not uniform to half a sample, because of a few short gaps or a wandering clock.
    """
    d = np.diff(stamps)
    back = d <= 0
    if back.any():
        i = int(np.argmax(back)) + 1
        what = "stands still" if d[i - 1] == 0 else "runs backwards"
        raise RecordingError(
            f"{path}: time column '{name}' {what} at sample {i} ({stamps[i - 1]:g} then {stamps[i]:g} s);"
            " 'micron mismatch cut RECORDING --out FOLDER' sorts it"
        )
    dt, median = float(stamps[-1] - stamps[0]) / d.size, float(np.median(d))
    gap = d > 1.5 * median
    missing = float(np.sum(d[gap] - median))
    if gap.any() and (d.max() > LONGEST_GAP * median or missing > MOST_MISSING * (stamps[-1] - stamps[0])):
        i = int(np.argmax(d)) + 1
        raise RecordingError(
            f"{path}: time column '{name}' jumps by {d[i - 1]:g} s at sample {i}, the usual step is {median:g} s; {CUT}"
        )
    grid: Array | None = None
    off = np.abs(stamps - (stamps[0] + dt * np.arange(stamps.size)))
    if gap.any() or off.max() > 0.5 * dt:
        # the mean step between the gaps: the median is quantised like the stamps
        dt = float(np.mean(d[~gap]))
        count = round(float(stamps[-1] - stamps[0]) / dt)
        dt = float(stamps[-1] - stamps[0]) / count
        grid = stamps[0] + dt * np.arange(count + 1)
        lost = f"{int(gap.sum())} gaps, {missing:.3g} s in all, filled by straight lines" if gap.any() else "no gaps"
        notes.append(f"time column '{name}' is not uniform: brought to a grid of {dt:.6g} s ({lost})")
    elif off.max() > 0.01 * dt:
        notes.append(f"time stamps scatter by up to {off.max() / dt:.2g} of a step; taken as uniform")
    if rate is not None and abs(rate * dt - 1) > 0.2:
        raise RecordingError(
            f"{path}: rate_hz {rate:g} contradicts the time column '{name}' ({1 / dt:g} Hz); leave one of them out"
        )
    if rate is not None and abs(rate * dt - 1) > 1e-3:
        notes.append(f"rate_hz {rate:g} differs from the time column ({1 / dt:.6g} Hz); the time column is used")
    return dt, grid


def uniform(
    path: Path, columns: Mapping[str, Array], time_column: str | None, rate_hz: float | None
) -> tuple[float, dict[str, Array]]:
    """Return the time step in s and the columns (n,) at that step. Raises RecordingError for a broken time column."""
    if time_column is None:
        if rate_hz is None or not 0 < rate_hz < np.inf:
            raise RecordingError(f"{path}: neither 'rate_hz' nor 'time'; give one of them")
        return 1.0 / rate_hz, dict(columns)
    stamps = columns[time_column]
    dt, grid = time_step(path, time_column, stamps, rate_hz, [])
    if grid is None:
        return dt, dict(columns)
    return dt, {name: on_grid(grid, dt, stamps, x) for name, x in columns.items()}


def on_grid(grid: Array, dt: float, stamps: Array, x: Array) -> Array:
    """Take the nearest sample per grid point (interpolation would smooth the noise), and a straight line in gaps."""
    after = np.clip(np.searchsorted(stamps, grid), 1, stamps.size - 1)
    nearest = np.where(grid - stamps[after - 1] < stamps[after] - grid, after - 1, after)
    near = np.abs(stamps[nearest] - grid) <= 0.75 * dt
    return np.where(near, x[nearest], np.interp(grid, stamps, x))
