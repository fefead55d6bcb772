"""Reads a recording once from end to end, in a process of its own: extremes of every column, holds, notes.

``python -m tools.bench.overview RECORDING FOLDER`` writes ``extremes.f32`` in ``FOLDER``: float32 [2, columns,
entries], smallest and largest value of every ``BLOCK`` ticks of time, NaN where there are none; at last
``spans.json``. Each line of its output is a JSON object with the number of entries that are ready.
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.layouts import layout_of_recording
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.index import IndexedRecording
from firmware_py.recording.reader import Recording
from tools.bench.history import BLOCK
from tools.bench.hold_spans import HoldSpans
from tools.errors import OutputError
from tools.output import write_text_atomic

EXTREMES, SPANS = "extremes.f32", "spans.json"
STEP = 64
"""Chunks that are reduced at a time."""
MOST_NOTES = 500


def entries_of(recording: IndexedRecording, rate_hz: float) -> int:
    """Return how many entries of ``BLOCK`` ticks the recording spans."""
    return round((recording.end_s - recording.start_s) * rate_hz) // BLOCK + 1


def summarize(path: Path, folder: Path, rate_hz: float) -> None:
    """Write the overview of ``path`` into ``folder``, telling on standard output how far it is."""
    recording = IndexedRecording(path)
    n = entries_of(recording, rate_hz)
    shape = (2, len(recording.columns), n)
    extremes = np.memmap(folder / EXTREMES, dtype=np.float32, mode="w+", shape=shape)
    extremes[:] = np.nan
    _tell(entries=n, ready=0)
    holds = HoldSpans()
    layout = layout_of_recording(recording.metadata)
    with warnings.catch_warnings(action="ignore"):  # entries whose every value is NaN stay NaN
        for start in range(0, recording.n_chunks, STEP):
            rows = [recording.chunk(k) for k in range(start, min(start + STEP, recording.n_chunks))]
            t_s = np.concatenate([r.t_s for r in rows])
            values = np.concatenate([r.values for r in rows], axis=1)
            holds.follow(t_s, layout.read_holds(recording.names, values.T))
            entry = np.clip(np.round((t_s - recording.start_s) * rate_hz), 0, n * BLOCK - 1).astype(np.int64) // BLOCK
            order = np.argsort(entry, kind="stable")
            entry, values = entry[order], values[:, order]
            begins = np.flatnonzero(np.concatenate(([True], np.diff(entry) > 0)))[: len(entry)]
            at = entry[begins]
            extremes[0][:, at] = np.fmin(extremes[0][:, at], np.fmin.reduceat(values, begins, axis=1))
            extremes[1][:, at] = np.fmax(extremes[1][:, at], np.fmax.reduceat(values, begins, axis=1))
            _tell(ready=int(at[-1]) if len(at) else 0)
    extremes.flush()
    recording.close()
    _tell(ready=n)
    whole = Recording(path)  # reads it again: events, and what is missing
    holds.name_by_events(whole.events)
    notes = [_note(event.time_ns, event.content) for event in whole.events if event.content.get("event") == "note"]
    table = {"holds": holds.as_list(), "notes": notes[:MOST_NOTES], "health": whole.health.lines()}
    write_text_atomic(folder / SPANS, json.dumps({**table, "lost": whole.health.lost}))
    _tell(done=True)


def _note(time_ns: int, content: dict[str, Any]) -> dict[str, Any]:
    return {"t_s": time_ns * 1e-9, "text": str(content.get("text", ""))[:500]}


def _tell(**values: Any) -> None:
    print(json.dumps(values), flush=True)


if __name__ == "__main__":
    try:
        summarize(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
    except (RecordingError, OutputError, OSError) as error:
        sys.exit(str(error))
