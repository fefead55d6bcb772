"""Opens recordings, finished, torn or damaged: columns, events, metadata, and exactly what is missing."""

from __future__ import annotations

import json
import zlib
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from mcap.records import Channel, Schema

from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import is_being_recorded
from firmware_py.recording.format import Block, ColumnInfo
from firmware_py.recording.health import Health, RowGap, TickGap
from firmware_py.recording.scan import (
    ChunkMessage,
    ChunkRecord,
    Damage,
    Finished,
    Item,
    MetadataRecord,
    Scanner,
    chunk_records,
    message_at,
    read_chunk,
)
from firmware_py.recording.unpack import FileTooExpansive
from hal.arrays import Array, IntArray

_MAX_LISTED = 1000
MOST_EVENT_BYTES = 1 << 20
MOST_EVENTS_BYTES = 1 << 26
_EVENT_COST_BYTES = 128
"""An event is counted as so many bytes more than its text: two bytes of JSON cost an object as well."""
_FREE_REREAD_BYTES = 1 << 28
_REREAD_RATIO = 8


@dataclass(frozen=True, slots=True)
class Event:
    """Event ``number`` of the run, received at ``time_ns`` since its start."""

    number: int
    time_ns: int
    text: bytes

    @property
    def content(self) -> dict[str, Any]:
        """The JSON object of the event; it was checked when the recording was opened."""
        return json.loads(self.text)


class Recording:
    """A recording on disk. Opening it reads it once and checks every CRC; data are read again when asked for.

    Another program may have copied it: chunks of any size, messages in any order, channels with other numbers. A block
    is addressed by its chunk and by the place of its message in it. Two equal copies of a block count as one; two
    different blocks with the same rows are an error.

    Raises ``RecordingError`` when the file is not a recording of this project, its layout is lost, or it contradicts
    itself.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.metadata: dict[str, Any] = {}
        self.events: list[Event] = []
        self._places = _Places()
        self._damage = _DamageList()
        self._finished = False
        self._layout: tuple[ColumnInfo, ...] | None = None
        self._crc = 0
        self._channels = {fmt.TICKS_CHANNEL: fmt.TICKS_TOPIC, fmt.EVENTS_CHANNEL: fmt.EVENTS_TOPIC}
        self._event_bytes = 0
        self._chunk_bytes: dict[int, int] = {}
        self._ticks = _TickCheck()
        try:
            with self.path.open("rb") as file:
                scanner = Scanner(file, self.path)
                for item in scanner.items():
                    self._take(item, scanner)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read ({error.strerror})") from error
        self._size_bytes = scanner.size
        self.columns = self._known_layout()
        self._places.sort(self.path)
        self.events = self._single_events()
        self.n_rows = self._places.n_rows
        self.health = self._health()

    # -- data --------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.columns)

    @property
    def tick_hz(self) -> float:
        """Ticks per second of the run; 1000 where the recording does not say. ``RecordingError`` for no rate."""
        stated: Any = self.metadata.get("tick_hz", 1000.0)
        try:
            rate_hz = float(stated) if isinstance(stated, int | float | str) else float("nan")
        except ValueError:
            rate_hz = float("nan")
        if not 0.0 < rate_hz < 1e9:
            raise RecordingError(f"{self.path}: its tick_hz is not a rate")
        return rate_hz

    def unit(self, name: str) -> str:
        return self.columns[self._index(name)].unit

    def blocks(self) -> Iterator[Block]:
        """Yield all blocks in the order of their rows, with one chunk in memory at a time.

        ``RecordingError`` when the rows are scattered over so many chunks that reading them in order would unpack the
        file many times, or when the file has changed since it was opened.
        """
        self._refuse_scattered()
        try:
            with self.path.open("rb") as file:
                chunk, content = -1, b""
                for offset, at in self._places.addresses():
                    if offset != chunk:
                        content = read_chunk(file, offset)
                        chunk = offset
                    yield fmt.decode_block(message_at(content, at).data, self._crc, len(self.columns))
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}") from error
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read ({error.strerror})") from error

    def array(self, names: Sequence[str]) -> Array:
        """``[n_rows, len(names)]``, the whole recording."""
        indices = [self._index(name) for name in names]
        result = np.empty((self.n_rows, len(indices)))
        start = 0
        for block in self.blocks():
            stop = start + block.data.shape[1]
            result[start:stop] = block.data[indices].T
            start = stop
        return result

    def column(self, name: str) -> Array:
        """Return one column (n_rows,)."""
        return self.array([name])[:, 0]

    def arrays(self) -> dict[str, Array]:
        """Return all columns (n_rows,) by name; this takes ``8 * n_rows * n_columns`` bytes of memory."""
        everything = np.ascontiguousarray(self.array(self.names).T)
        return dict(zip(self.names, everything, strict=True))

    def row_numbers(self) -> np.ndarray:
        """Number of every row, int64 ``[n_rows]``; a jump is a gap."""
        return self._places.row_numbers()

    def _index(self, name: str) -> int:
        try:
            return self.names.index(name)
        except ValueError:
            raise RecordingError(f"{self.path} has no column {name!r}; it has: {', '.join(self.names)}") from None

    def _refuse_scattered(self) -> None:
        """Every change from chunk to chunk unpacks one again; an ordinary file changes once per chunk."""
        unpacked = sum(self._chunk_bytes[offset] for offset in self._places.visits())
        if unpacked > _FREE_REREAD_BYTES + _REREAD_RATIO * sum(self._chunk_bytes.values()):
            raise RecordingError(
                f"{self.path}: its rows are scattered over its chunks; put them in order first ('mcap sort FILE')"
            )

    # -- opening -----------------------------------------------------------------------------------------

    def _take(self, item: Item, scanner: Scanner) -> None:
        match item:
            case MetadataRecord():
                self._take_metadata(item)
            case ChunkRecord():
                try:
                    self._take_chunk(item, scanner)
                except FileTooExpansive as error:
                    raise RecordingError(f"{self.path} is not read: {error}") from error
            case Damage():
                self._damage.add(item)
            case Finished():
                self._finished = True

    def _take_metadata(self, item: MetadataRecord) -> None:
        try:
            value = fmt.decode_metadata(item.name, item.metadata)
            if item.name == fmt.LAYOUT_METADATA:
                self._take_layout(fmt.layout_of_text(value) if isinstance(value, str) else fmt.layout_of(value))
            elif item.name in self.metadata and self.metadata[item.name] != value:
                raise RecordingError("it is there twice, with different texts; the first one is used")
            else:
                self.metadata.setdefault(item.name, _check_end(value) if item.name == fmt.END_METADATA else value)
        except RecordingError as error:
            self._damage.add(Damage(item.offset, 0, f"metadata {item.name[:60]!r}: {error}"))

    def _take_layout(self, layout: tuple[ColumnInfo, ...]) -> None:
        if self._layout is None:
            self._layout = layout
            names = [c.name for c in layout]
            self._ticks.use(names)
            self._crc = fmt.layout_crc(layout)
        elif layout != self._layout:
            raise RecordingError("the file holds two different layouts: it was made of several recordings")

    def _known_layout(self) -> tuple[ColumnInfo, ...]:
        if self._layout is None:
            raise RecordingError(
                f"{self.path} is not a recording of this instrument: it has no column layout. What 'micron export'"
                " made for viewers has none; export with --raw to replay"
            )
        return self._layout

    def _take_chunk(self, chunk: ChunkRecord, scanner: Scanner) -> None:
        records = chunk_records(chunk.content, scanner.budget)
        self._chunk_bytes[chunk.offset] = len(chunk.content)
        while True:
            try:
                record = next(records, None)
            except FileTooExpansive:
                raise
            except RecordingError as error:
                self._damage.add(Damage(chunk.offset, chunk.length, f"a chunk is not read to its end: {error}"))
                return
            match record:
                case None:
                    return
                case Schema():
                    if record.name == fmt.TICKS_SCHEMA:
                        self._take_schema(record)
                case Channel():
                    self._channels[record.id] = record.topic
                case ChunkMessage():
                    topic = self._channels.get(record.channel_id)
                    if topic == fmt.TICKS_TOPIC:
                        self._take_block(chunk, record)
                    elif topic == fmt.EVENTS_TOPIC:
                        self._take_event(chunk, record)

    def _take_schema(self, schema: Schema) -> None:
        if self._layout is not None:
            return  # a block of another layout is refused by its CRC
        try:
            content: object = fmt.load_json(schema.data)
            table = cast("dict[str, object]", content) if isinstance(content, dict) else {}
            self._take_layout(fmt.layout_of(table.get("x-layout")))
        except RecordingError as error:
            raise RecordingError(f"{self.path}: the schema of the ticks is not one of ours: {error}") from error

    def _take_block(self, chunk: ChunkRecord, message: ChunkMessage) -> None:
        columns = self._known_layout()
        try:
            block = fmt.decode_block(message.data, self._crc, len(columns))
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}") from error
        self._places.add(chunk.offset, message.at, block.row0, block.data.shape[1], zlib.crc32(message.data))
        self._ticks.take(block)

    def _take_event(self, chunk: ChunkRecord, message: ChunkMessage) -> None:
        text = bytes(message.data)
        self._event_bytes += len(text) + _EVENT_COST_BYTES
        try:
            if len(text) > MOST_EVENT_BYTES or self._event_bytes > MOST_EVENTS_BYTES:
                raise RecordingError(f"the events are longer than {MOST_EVENTS_BYTES >> 20} MiB, or one is than 1 MiB")
            if not isinstance(fmt.load_json(text), dict):
                raise RecordingError("it is not a JSON object")
        except RecordingError as error:
            self._damage.add(Damage(chunk.offset, 0, f"event {message.sequence} is not read: {error}"))
            return
        self.events.append(Event(message.sequence, message.log_time, text))

    def _single_events(self) -> list[Event]:
        """The events in order; of two with one number the first, and damage when they differ."""
        single: dict[int, Event] = {}
        for event in self.events:
            known = single.setdefault(event.number, event)
            if known is not event and known != event:
                self._damage.add(Damage(0, 0, f"two different events have the number {event.number}"))
        return [single[number] for number in sorted(single)]

    def _health(self) -> Health:
        end: dict[str, Any] = self.metadata.get(fmt.END_METADATA, {})
        expected: int | None = end.get("rows_pushed")
        for name in end.get("metadata", ()):
            if name != fmt.LAYOUT_METADATA and name not in self.metadata:
                self._damage.add(Damage(0, 0, f"metadata {name[:60]!r} is missing"))
        gaps, missing = self._places.gaps(expected)
        ticks = self._ticks.result(self._places.order, self._places.row0, self._places.n)
        seen_events = self.events[-1].number + 1 if self.events else 0
        expected_events = max(end.get("events_pushed", 0), seen_events)
        return Health(
            path=self.path,
            size_bytes=self._size_bytes,
            finished=self._finished,
            ended=end.get("ended", ""),
            rows=self.n_rows,
            expected_rows=expected,
            missing_rows=missing,
            dropped=end.get("rows_dropped", 0),
            row_gaps=gaps,
            first_tick=ticks.first,
            last_tick=ticks.last,
            last_time_s=ticks.last_time_s,
            tick_gaps=ticks.gaps,
            missing_ticks=ticks.missing,
            events=len(self.events),
            missing_events=expected_events - len(self.events),
            damage=self._damage.listed(),
            being_recorded=is_being_recorded(self.path),
        )


def _check_end(value: object) -> dict[str, Any]:
    """Return the recorder's ``end`` record. Raises ``RecordingError`` when it is not what a recorder writes."""
    table = cast("dict[str, Any]", value)
    if not isinstance(value, dict) or not isinstance(table.get("ended", ""), str):
        raise RecordingError("the record is not the last words of a recorder")
    for key in ("rows_pushed", "rows_dropped", "rows_written", "events_pushed", "events_dropped"):
        count = table.get(key, 0)
        may_be_unknown = key == "rows_pushed" and count is None
        if not may_be_unknown and (type(count) is not int or not 0 <= count < fmt.MOST_ROW):
            raise RecordingError(f"{key} is not a count")
    names = table.get("metadata", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in cast("list[object]", names)):
        raise RecordingError("the names of the metadata are not a list of names")
    return table


class _DamageList:
    """Damage as it is found, neighbours of one reason joined, at most ``_MAX_LISTED`` entries."""

    def __init__(self) -> None:
        self._found: list[Damage] = []
        self._more = self._more_bytes = 0

    def add(self, item: Damage) -> None:
        last = self._found[-1] if self._found else None
        if last and last.length and last.reason == item.reason and last.offset + last.length == item.offset:
            self._found[-1] = Damage(last.offset, last.length + item.length, item.reason, item.torn)
        elif len(self._found) < _MAX_LISTED:
            self._found.append(item)
        else:
            self._more += 1
            self._more_bytes += item.length

    def listed(self) -> tuple[Damage, ...]:
        if not self._more:
            return tuple(self._found)
        return (*self._found, Damage(0, self._more_bytes, f"{self._more} more places are damaged"))


class _Places:
    """Stores the place of every block: chunk, place in the chunk, first row, number of rows, CRC-32 of the message."""

    def __init__(self) -> None:
        self._raw = array("q")
        self.n_rows = 0
        self.order: IntArray = np.empty(0, dtype=np.int64)
        self.row0: IntArray = self.order
        self.n: IntArray = self.order
        self._chunk: IntArray = self.order
        self._at: IntArray = self.order

    def add(self, chunk: int, at: int, row0: int, n_rows: int, crc: int) -> None:
        self._raw.extend((chunk, at, row0, n_rows, crc))

    def sort(self, path: Path) -> None:
        """Put the blocks in order of their rows; equal copies count once. ``RecordingError`` when two differ."""
        places = np.frombuffer(self._raw, dtype=np.int64).reshape(-1, 5)
        self.order = np.lexsort((places[:, 1], places[:, 0], places[:, 2]))
        what = places[self.order, 2:]
        self.order = self.order[np.concatenate(([True], (what[1:] != what[:-1]).any(axis=1)))[: len(self.order)]]
        self._chunk, self._at, self.row0, self.n, _ = places[self.order].T
        self.n_rows = int(self.n.sum())
        overlaps = np.flatnonzero(self.row0[1:] < self.row0[:-1] + self.n[:-1])
        if len(overlaps):
            raise RecordingError(
                f"{path} holds two different versions of row {self.row0[overlaps[0] + 1]}: it was made of several "
                "recordings, whose rows cannot be told apart; use the originals"
            )

    def addresses(self) -> Iterator[tuple[int, int]]:
        """Chunk and place in the chunk of every block, in order of the rows."""
        return zip(self._chunk.tolist(), self._at.tolist(), strict=True)

    def visits(self) -> list[int]:
        """The chunks in the order in which the rows ask for them."""
        changes = np.concatenate(([True], self._chunk[1:] != self._chunk[:-1]))[: len(self._chunk)]
        return self._chunk[changes].tolist()

    def row_numbers(self) -> IntArray:
        """Return the number of every row, ``[n_rows]``."""
        starts = np.cumsum(self.n) - self.n
        return np.arange(self.n_rows) + np.repeat(self.row0 - starts, self.n)

    def gaps(self, expected: int | None) -> tuple[tuple[RowGap, ...], int]:
        """Return the first gaps, and how many rows are missing in all."""
        ends = np.concatenate(([0], self.row0 + self.n))
        starts = np.concatenate((self.row0, [max(ends[-1], expected or 0)]))
        missing = starts - ends
        first = np.flatnonzero(missing)[:_MAX_LISTED]
        return tuple(RowGap(int(ends[k]), int(missing[k])) for k in first), int(missing.sum())


@dataclass(frozen=True, slots=True)
class _Ticks:
    """Holds the result of checking the tick numbers of a file: first and last tick, and the gaps."""

    first: int | None
    last: int | None
    last_time_s: float | None
    gaps: tuple[TickGap, ...]
    missing: int


class _TickCheck:
    """Follows the tick numbers through the blocks of a file, which need not come in order."""

    def __init__(self) -> None:
        self._tick_row: int | None = None
        self._time_row: int | None = None
        self._edges = array("q")  # first and last tick of every block, scans missing inside it; -1 without ticks
        self._last_t_s: array[float] = array("d")
        self._inside: list[TickGap] = []

    def use(self, names: Sequence[str]) -> None:
        self._tick_row = names.index(fmt.TICK_COLUMN) if fmt.TICK_COLUMN in names else None
        self._time_row = names.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in names else None

    def take(self, block: Block) -> None:
        """Count the scans that the instrument missed inside one block."""
        self._last_t_s.append(float(block.data[self._time_row, -1]) if self._time_row is not None else np.nan)
        ticks = block.data[self._tick_row] if self._tick_row is not None else None
        if ticks is None or not np.all((ticks >= 0) & (ticks < fmt.MOST_ROW)):  # NaN is neither
            self._edges.extend((-1, -1, 0))
            return
        ticks = ticks.astype(np.int64)
        steps = np.diff(ticks)
        jumps = np.flatnonzero(steps > 1)
        self._edges.extend((int(ticks[0]), int(ticks[-1]), int((steps[jumps] - 1).sum())))
        self._inside.extend(
            TickGap(int(ticks[at]), int(ticks[at + 1])) for at in jumps[: _MAX_LISTED - len(self._inside)]
        )

    def result(self, order: IntArray, row0: IntArray, n: IntArray) -> _Ticks:
        """Return the result over the blocks ``order``, which begin at ``row0`` and hold ``n`` rows. Nothing is
        concluded across missing rows."""
        first, last, inside = np.frombuffer(self._edges, dtype=np.int64).reshape(-1, 3)[order].T
        sound = first >= 0
        joined = sound[1:] & sound[:-1] & (row0[1:] == row0[:-1] + n[:-1])
        jumps = np.where(joined, first[1:] - last[:-1] - 1, 0)
        at = np.flatnonzero(jumps > 0)
        between = [TickGap(int(last[k]), int(first[k + 1])) for k in at[:_MAX_LISTED]]
        ticks = np.flatnonzero(sound)
        return _Ticks(
            first=int(first[ticks[0]]) if len(ticks) else None,
            last=int(last[ticks[-1]]) if len(ticks) else None,
            last_time_s=self._last_t_s[int(order[-1])] if len(order) and self._time_row is not None else None,
            gaps=tuple(sorted([*self._inside, *between], key=lambda gap: gap.after)[:_MAX_LISTED]),
            missing=int(inside.sum() + jumps[at].sum()),
        )
