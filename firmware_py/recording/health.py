"""Compares what a recording holds with what it should hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.recording.scan import Damage


class RowGap(NamedTuple):
    """``missing`` rows from row ``row0`` on were pushed but are not in the file."""

    row0: int
    missing: int


class TickGap(NamedTuple):
    """Describes ticks between which the instrument itself saw no scans (lost or skipped). The recording is not at
    fault."""

    after: int
    before: int


@dataclass(frozen=True, slots=True)
class Health:
    """``rows`` are readable; ``expected_rows`` is known only when the recorder could write its last words.

    ``finished``: the file has its index; ``ended``: the recorder's last words, empty when it had none.
    ``row_gaps`` and ``tick_gaps`` list at most the first 1000 of their kind, the counts are complete.
    ``dropped`` of the missing rows never reached the recorder (its ring was full).
    """

    path: Path
    size_bytes: int
    finished: bool
    ended: str
    rows: int
    expected_rows: int | None
    missing_rows: int
    dropped: int
    row_gaps: tuple[RowGap, ...]
    first_tick: int | None
    last_tick: int | None
    last_time_s: float | None
    tick_gaps: tuple[TickGap, ...]
    missing_ticks: int
    events: int
    missing_events: int
    damage: tuple[Damage, ...]
    being_recorded: bool = False

    @property
    def lost(self) -> bool:
        """True if rows, events or the end of the recording are missing, or may be."""
        return bool(
            self.missing_rows or self.missing_events or self.expected_rows is None or self.damage or not self.finished
        )

    def lines(self) -> list[str]:
        """Return lines of text for display: what is there, then what is missing."""
        lines = [f"{self.path}: {self.rows} ticks, {self.events} events, {self.size_bytes} bytes"]
        if self.last_tick is not None:
            at = f" at t = {self.last_time_s:.3f} s" if self.last_time_s is not None else ""
            lines.append(f"ticks {self.first_tick} to {self.last_tick}{at}")
        if self.ended and self.ended != "stopped":
            lines.append(f"the recording ended early: {self.ended}")
        if self.expected_rows is None and self.finished and not self.ended:
            lines.append(
                "the file is complete, but without the recorder's last words: another program has copied it without "
                "its metadata; whether ticks are missing at its end is not known"
            )
        elif self.being_recorded:
            lines.append("it is being recorded now: up to 0.2 s after the last tick are not in the file yet")
        elif self.expected_rows is None:
            lines.append(
                "the recorder was killed: it left no last words; up to 0.2 s after the last tick may be missing"
            )
        elif not self.finished:
            lines.append("the index at the end of the file is missing")
        for gap in self.row_gaps:
            lines.append(f"{gap.missing} ticks are missing from row {gap.row0} on")
        if self.dropped:
            lines.append(f"{self.dropped} of the missing ticks never reached the recorder: its ring was full")
        if self.missing_events:
            lines.append(f"{self.missing_events} events are missing")
        for damage in self.damage:
            lines.append(f"{damage.length} bytes from byte {damage.offset} on are lost: {damage.reason}")
        if self.missing_ticks:
            lines.append(
                f"the instrument itself lost or skipped {self.missing_ticks} scans in {len(self.tick_gaps)} places, "
                f"first after tick {self.tick_gaps[0].after}"
            )
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return {
            "path": str(self.path),
            "size_bytes": self.size_bytes,
            "finished": self.finished,
            "ended": self.ended,
            "lost": self.lost,
            "rows": self.rows,
            "expected_rows": self.expected_rows,
            "missing_rows": self.missing_rows,
            "dropped": self.dropped,
            "row_gaps": [gap._asdict() for gap in self.row_gaps],
            "first_tick": self.first_tick,
            "last_tick": self.last_tick,
            "last_time_s": self.last_time_s,
            "tick_gaps": [gap._asdict() for gap in self.tick_gaps],
            "missing_ticks": self.missing_ticks,
            "events": self.events,
            "missing_events": self.missing_events,
            "being_recorded": self.being_recorded,
            "damage": [{"offset": d.offset, "length": d.length, "reason": d.reason} for d in self.damage],
        }
