"""Opens recordings, finished, torn or damaged: columns, events, metadata, and exactly what is missing."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import McapRecord, Message, Schema

from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.format import Block, ColumnInfo, Float64Array
from firmware_py.recording.health import Health, RowGap, TickGap
from firmware_py.recording.scan import ChunkRecord, Damage, Finished, MetadataRecord, read_chunk, scan

_MAX_LISTED = 1000


@dataclass(frozen=True, slots=True)
class Event:
    """Event ``number`` of the run, received at ``time_ns`` since its start."""

    number: int
    time_ns: int
    content: dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a block is."""

    offset: int
    row0: int
    n_rows: int


class Recording:
    """A recording on disk. Opening it reads it once and checks every CRC; data are read again when asked for.

    Raises ``RecordingError`` when the file is not a recording of this project or its layout is lost.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.metadata: dict[str, Any] = {}
        self.events: list[Event] = []
        self._places: list[_Place] = []
        self._damage: list[Damage] = []
        self._finished = False
        self._layout: tuple[ColumnInfo, ...] | None = None
        self._ticks = _TickCheck()
        for item in scan(self.path):
            match item:
                case MetadataRecord():
                    self._take_metadata(item)
                case ChunkRecord():
                    self._take_chunk(item)
                case Damage():
                    self._damage.append(item)
                case Finished():
                    self._finished = True
        self.columns = self._known_layout()
        self._places.sort(key=lambda place: place.row0)
        self.events.sort(key=lambda event: event.number)
        self.n_rows = sum(place.n_rows for place in self._places)
        self.health = self._health()

    # -- data --------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.columns)

    def unit(self, name: str) -> str:
        return self.columns[self._index(name)].unit

    def blocks(self) -> Iterator[Block]:
        """All blocks in order of their rows; one block of memory at a time."""
        with self.path.open("rb") as file:
            for place in self._places:
                yield self._block_of(read_chunk(file, place.offset))

    def array(self, names: Sequence[str]) -> Float64Array:
        """``[n_rows, len(names)]``, the whole recording."""
        indices = [self._index(name) for name in names]
        result = np.empty((self.n_rows, len(indices)))
        start = 0
        for block in self.blocks():
            stop = start + block.data.shape[1]
            result[start:stop] = block.data[indices].T
            start = stop
        return result

    def column(self, name: str) -> Float64Array:
        """One column, ``[n_rows]``."""
        return self.array([name])[:, 0]

    def arrays(self) -> dict[str, Float64Array]:
        """All columns by name: ``8 * n_rows * n_columns`` bytes of memory."""
        everything = np.ascontiguousarray(self.array(self.names).T)
        return dict(zip(self.names, everything, strict=True))

    def row_numbers(self) -> np.ndarray:
        """Number of every row, int64 ``[n_rows]``; a jump is a gap."""
        parts = [np.arange(place.row0, place.row0 + place.n_rows) for place in self._places]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)

    def _index(self, name: str) -> int:
        try:
            return self.names.index(name)
        except ValueError:
            raise RecordingError(f"{self.path} has no column {name!r}; it has: {', '.join(self.names)}") from None

    # -- opening -----------------------------------------------------------------------------------------

    def _take_metadata(self, item: MetadataRecord) -> None:
        try:
            value = fmt.decode_metadata(item.name, item.metadata)
            if item.name == fmt.LAYOUT_METADATA:
                self._take_layout(fmt.layout_of_text(value))
            else:
                self.metadata[item.name] = value
        except (RecordingError, ValueError, KeyError, TypeError) as error:
            self._damage.append(Damage(0, 0, f"metadata {item.name!r}: {error}"))

    def _take_layout(self, layout: tuple[ColumnInfo, ...]) -> None:
        if self._layout is None:
            self._layout = layout
            names = [c.name for c in layout]
            self._ticks.use(names)
            self._crc = fmt.layout_crc(layout)

    def _known_layout(self) -> tuple[ColumnInfo, ...]:
        if self._layout is None:
            raise RecordingError(f"{self.path} is not a recording of this instrument: it has no column layout")
        return self._layout

    def _take_chunk(self, chunk: ChunkRecord) -> None:
        for record in chunk.records:
            if isinstance(record, Schema) and record.name == fmt.TICKS_SCHEMA:
                stored = json.loads(record.data)["x-layout"]
                self._take_layout(tuple(ColumnInfo(entry["name"], entry["unit"]) for entry in stored))
            elif isinstance(record, Message) and record.channel_id == fmt.TICKS_CHANNEL:
                self._known_layout()
                block = self._block_of((record,))
                self._places.append(_Place(chunk.offset, block.row0, block.data.shape[1]))
                self._ticks.take(block)
            elif isinstance(record, Message) and record.channel_id == fmt.EVENTS_CHANNEL:
                self.events.append(Event(record.sequence, record.log_time, json.loads(record.data)))

    def _block_of(self, records: Sequence[McapRecord]) -> Block:
        """The block in a chunk; the writer puts at most one there."""
        for record in records:
            if isinstance(record, Message) and record.channel_id == fmt.TICKS_CHANNEL:
                try:
                    return fmt.decode_block(record.data, self._crc)
                except RecordingError as error:
                    raise RecordingError(f"{self.path}: {error}") from error
        raise RecordingError(f"{self.path}: a chunk that had a block has none now; the file was changed")

    def _health(self) -> Health:
        end: dict[str, Any] = self.metadata.get(fmt.END_METADATA, {})
        expected: int | None = end.get("rows_pushed")
        for name in end.get("metadata", ()):
            if name != fmt.LAYOUT_METADATA and name not in self.metadata:
                self._damage.append(Damage(0, 0, f"metadata {name!r} is missing"))
        gaps: list[RowGap] = []
        next_row = 0
        for place in self._places:
            if place.row0 != next_row:
                gaps.append(RowGap(next_row, place.row0 - next_row))
            next_row = place.row0 + place.n_rows
        if expected is not None and expected > next_row:
            gaps.append(RowGap(next_row, expected - next_row))
        seen_events = self.events[-1].number + 1 if self.events else 0
        expected_events = max(end.get("events_pushed", 0), seen_events)
        return Health(
            path=self.path,
            size_bytes=self.path.stat().st_size,
            finished=self._finished,
            ended=end.get("ended", ""),
            rows=self.n_rows,
            expected_rows=expected,
            missing_rows=sum(gap.missing for gap in gaps),
            dropped=end.get("rows_dropped", 0),
            row_gaps=tuple(gaps[:_MAX_LISTED]),
            first_tick=self._ticks.first,
            last_tick=self._ticks.last,
            last_time_s=self._ticks.last_time_s,
            tick_gaps=tuple(self._ticks.gaps),
            missing_ticks=self._ticks.missing,
            events=len(self.events),
            missing_events=expected_events - len(self.events),
            damage=tuple(self._damage),
        )


class _TickCheck:
    """Follows the tick numbers through the blocks of a file."""

    def __init__(self) -> None:
        self._tick_row: int | None = None
        self._time_row: int | None = None
        self._next_row = 0
        self.first: int | None = None
        self.last: int | None = None
        self.last_time_s: float | None = None
        self.gaps: list[TickGap] = []
        self.missing = 0

    def use(self, names: Sequence[str]) -> None:
        self._tick_row = names.index(fmt.TICK_COLUMN) if fmt.TICK_COLUMN in names else None
        self._time_row = names.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in names else None

    def take(self, block: Block) -> None:
        """Count the scans that the instrument missed; across a gap of rows nothing can be said."""
        if self._time_row is not None:
            self.last_time_s = float(block.data[self._time_row, -1])
        if self._tick_row is None:
            return
        ticks = block.data[self._tick_row]
        if not np.all(np.isfinite(ticks)):
            return
        ticks = ticks.astype(np.int64)
        if self.first is None:
            self.first = int(ticks[0])
        if self.last is not None and block.row0 == self._next_row:
            ticks = np.concatenate(([self.last], ticks))
        for at in np.flatnonzero(np.diff(ticks) > 1):
            self.missing += int(ticks[at + 1] - ticks[at]) - 1
            if len(self.gaps) < _MAX_LISTED:
                self.gaps.append(TickGap(int(ticks[at]), int(ticks[at + 1])))
        self.last = int(ticks[-1])
        self._next_row = block.row0 + block.data.shape[1]
