"""Rows of a recording in larger parts than its blocks, for writers that stream, and the times of its events."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from firmware_py.recording.format import TICK_COLUMN, TIME_COLUMN
from firmware_py.recording.reader import Recording
from hal.arrays import Array


def batches(recording: Recording, n_blocks: int) -> Iterator[tuple[int, Array]]:
    """Yield the index of the first row in the file, and ``n_blocks`` blocks at a time (columns, rows)."""
    waiting: list[Array] = []
    start = rows = 0
    for block in recording.blocks():
        waiting.append(block.data)
        rows += block.data.shape[1]
        if len(waiting) == n_blocks:
            yield start, np.concatenate(waiting, axis=1)
            start += rows
            rows = 0
            waiting.clear()
    if waiting:
        yield start, np.concatenate(waiting, axis=1)


def event_times_ns(recording: Recording) -> list[int]:
    """Return the time of each event on the clock of the column ``t``: that of the tick which the event names, else when
    it was recorded. The bench clock of ``t_ns`` has another zero.
    """
    first = next(recording.blocks(), None)
    names = recording.names
    if first is None or not {TICK_COLUMN, TIME_COLUMN} <= set(names):
        return [event.time_ns for event in recording.events]
    tick0, t0_s = (float(first.data[names.index(name), 0]) for name in (TICK_COLUMN, TIME_COLUMN))
    found: list[int] = []
    for event in recording.events:
        tick = event.content.get("tick")
        t_s = t0_s + (tick - tick0) / recording.tick_hz if isinstance(tick, int) else math.nan
        found.append(round(t_s * 1e9) if 0.0 <= t_s < 9e9 else event.time_ns)
    return found
