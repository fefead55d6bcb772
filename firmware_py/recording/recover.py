"""Makes a finished recording of what a killed run or a damaged file left, and says what is missing."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_py.exit_codes import Exit
from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import new_file
from firmware_py.recording.health import Health
from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter


@dataclass(frozen=True, slots=True)
class RecoverReport:
    """``health`` is that of the original; ``out`` holds ``rows`` and ``events``, all of them checked."""

    path: Path
    out: Path
    rows: int
    events: int
    health: Health

    @property
    def exit_code(self) -> Exit:
        """3 when anything is missing, or may be."""
        return Exit.DATA_LOST if self.health.lost else Exit.DONE

    def lines(self) -> list[str]:
        """Return lines of text for display."""
        verdict = "something is missing" if self.health.lost else "nothing is missing"
        return [*self.health.lines(), f"{self.out}: {self.rows} ticks, {self.events} events; {verdict}"]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return {
            "path": str(self.path),
            "out": str(self.out),
            "rows": self.rows,
            "events": self.events,
            "health": self.health.as_dict(),
        }


def recover(path: Path, out: Path, *, overwrite: bool = False) -> RecoverReport:
    """Copy every sound block, event and text of ``path`` into a finished recording ``out``.

    The original is not touched. ``RecordingError`` when ``path`` is not a recording or ``out`` cannot be written.
    """
    if out.exists() and out.samefile(path):
        raise RecordingError(f"{out}: a recording is not recovered onto itself; name another file")
    recording = Recording(path)
    health = recording.health
    late = (fmt.END_METADATA, fmt.STATISTICS_METADATA)
    early = {name: value for name, value in recording.metadata.items() if name not in late}
    with new_file(out, overwrite=overwrite) as part:
        writer = RecordingWriter(part, recording.columns, {**early, "recovered": health.as_dict()})
        waiting = deque(recording.events)
        time_row = recording.names.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in recording.names else None
        for block in recording.blocks():
            # beside the ticks of their time: an index whose chunks are not in order of time cannot be searched
            end_s = math.inf if time_row is None else float(block.data[time_row, -1])
            while waiting and not waiting[0].time_ns * 1e-9 > end_s:
                event = waiting.popleft()
                writer.write_event(event.number, event.content, event.time_ns)
            writer.write_block(block.row0, block.data.T)
        for event in waiting:
            writer.write_event(event.number, event.content, event.time_ns)
        if fmt.STATISTICS_METADATA in recording.metadata:
            writer.write_metadata(fmt.STATISTICS_METADATA, recording.metadata[fmt.STATISTICS_METADATA])
        missing = (
            "whether ticks are missing at the end is not known"
            if health.finished
            else ("up to 0.2 s after the last tick may be missing")
        )
        unknown = {
            "ended": f"recovered from a file without last words; {missing}",
            "rows_pushed": None,
        }
        writer.finish(recording.metadata.get(fmt.END_METADATA, unknown))
    return RecoverReport(path, out, recording.n_rows, len(recording.events), health)
