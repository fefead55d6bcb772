"""Copies the part of a recording between two times into a recording of its own."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import new_file
from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter


def cut(recording: Recording, out: Path, from_s: float, to_s: float, *, overwrite: bool = False) -> int:
    """Write the rows with ``from_s <= t < to_s`` (times of the column ``t``) and the events between them into ``out``.

    Returns the number of rows. Times stay those of the original, rows are numbered from 0; the name of the
    original and the span become metadata.
    ``RecordingError`` when there are no such rows or ``out`` cannot be written.
    """
    if fmt.TIME_COLUMN not in recording.names:
        raise RecordingError(f"{recording.path} has no column {fmt.TIME_COLUMN!r}: a span of time cannot be cut out")
    time_row = recording.names.index(fmt.TIME_COLUMN)
    late = (fmt.END_METADATA, fmt.STATISTICS_METADATA)
    kept = {name: value for name, value in recording.metadata.items() if name not in late}
    kept["cut"] = {"of": recording.path.name, "from_s": from_s, "to_s": to_s}
    rows = events = first_row = stop_row = 0
    with new_file(out, overwrite=overwrite) as part:
        writer = RecordingWriter(part, recording.columns, kept)
        waiting = deque(event for event in recording.events if from_s <= event.time_ns * 1e-9 < to_s)
        for block in recording.blocks():
            t_s = block.data[time_row]
            inside = np.flatnonzero((t_s >= from_s) & (t_s < to_s))
            if not len(inside):
                continue
            first, stop = int(inside[0]), int(inside[-1]) + 1
            if not rows:
                first_row = block.row0 + first
            stop_row = block.row0 + stop
            # beside the ticks of their time: an index whose chunks are not in order of time cannot be searched
            while waiting and waiting[0].time_ns * 1e-9 <= t_s[stop - 1]:
                event = waiting.popleft()
                writer.write_event(events, event.content, event.time_ns)
                events += 1
            writer.write_block(block.row0 + first - first_row, np.ascontiguousarray(block.data[:, first:stop].T))
            rows += stop - first
        for event in waiting:
            writer.write_event(events, event.content, event.time_ns)
            events += 1
        if not rows:
            raise RecordingError(f"{recording.path} has no ticks between {from_s:g} and {to_s:g} s")
        end = {"ended": "cut out of a longer recording", "rows_pushed": stop_row - first_row, "rows_written": rows}
        writer.finish({**end, "events_pushed": events})
    return rows
