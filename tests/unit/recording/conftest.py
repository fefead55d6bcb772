"""Recordings on disk for the tests of this folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from firmware_py.recording.writer import RecordingWriter
from tests.unit.recording.samples import COLUMNS, METADATA, make_rows


@pytest.fixture
def write_file(tmp_path: Path) -> Callable[..., tuple[Path, np.ndarray]]:
    """Write ``n`` rows in blocks of 100 with an event after every third block; returns path and rows."""

    def write(n: int = 1000, *, name: str = "run.mcap", close: bool = True) -> tuple[Path, np.ndarray]:
        rows = make_rows(n)
        path = tmp_path / name
        writer = RecordingWriter(path, COLUMNS, METADATA)
        events = 0
        for block, start in enumerate(range(0, n, 100)):
            if block % 3 == 1:
                writer.write_event(events, {"event": "mark", "t_ns": start})
                events += 1
            writer.write_block(start, rows[start : start + 100])
        if close:
            writer.write_metadata("statistics", {"ticks": n})
            end = {"ended": "stopped", "rows_pushed": n, "rows_dropped": 0}
            writer.finish({**end, "events_pushed": events, "events_dropped": 0})
        else:
            writer.abandon()  # as if it had been killed
        return path, rows

    return write
