"""Rows of a recording in larger parts than its blocks, for writers that stream."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from firmware_py.recording.format import Float64Array
from firmware_py.recording.reader import Recording


def batches(recording: Recording, n_blocks: int) -> Iterator[tuple[int, Float64Array]]:
    """Yield the index of the first row in the file, and ``n_blocks`` blocks at a time, [columns, rows]."""
    waiting: list[Float64Array] = []
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
