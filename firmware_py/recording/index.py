"""Opens a finished recording by its index alone, and reads any part of it without reading what is before.

``reader.Recording`` reads the whole file and checks everything; this reads the chunks that a part needs and checks
their CRCs. A torn file has no index: ``micron recover`` makes a whole one of it.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.format import ColumnInfo
from firmware_py.recording.scan import (
    Channel,
    ChunkMessage,
    ChunkRecord,
    MetadataRecord,
    Scanner,
    chunk_records,
    read_chunk,
)
from hal.arrays import Array

_FRAME = struct.Struct("<BQ")
_FOOTER = struct.Struct("<QQI")
_CHUNK_INDEX = struct.Struct("<QQQQ")  # first and last log time, place and length of the chunk
_FOOTER_BYTES = _FRAME.size + _FOOTER.size + len(MCAP0_MAGIC)
MOST_INDEX_BYTES = 1 << 28
CACHED_CHUNKS = 1500
"""Chunks kept unpacked: 2.5 minutes at 1 kHz, about 100 MB."""


class Rows(NamedTuple):
    """Times [n] in s and values [columns, n] of consecutive rows."""

    t_s: Array
    values: NDArray[np.float32]


class IndexedRecording:
    """A finished recording that is read in parts. Use it from one thread at a time.

    Raises ``RecordingError`` when the file is no recording, has no index, or its rows have no increasing times.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, Any] = {}
        self.columns: tuple[ColumnInfo, ...]
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
        try:
            self._read_head()
            self._offset, self._end_s = self._read_index()
            self._cache: OrderedDict[int, Rows] = OrderedDict()
            self._ticks_channel = fmt.TICKS_CHANNEL
            self._time_row = [c.name for c in self.columns].index(fmt.TIME_COLUMN)
            first, last = self.chunk(0), self.chunk(self.n_chunks - 1)
            if not len(first.t_s) or not len(last.t_s):
                raise RecordingError(f"{path} holds no ticks at its start or end; 'micron recover' makes it whole")
            self.start_s, self.end_s = float(first.t_s[0]), float(last.t_s[-1])
        except BaseException as error:
            self._file.close()
            if isinstance(error, OSError):
                raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
            raise

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.columns)

    @property
    def n_chunks(self) -> int:
        return len(self._offset)

    def close(self) -> None:
        self._file.close()

    def chunks_between(self, from_s: float, to_s: float) -> range:
        """Return the chunks that hold every row from ``from_s`` to ``to_s``, found in the index alone."""
        first = int(np.searchsorted(self._end_s, from_s - 1e-9))
        return range(min(first, self.n_chunks), min(int(np.searchsorted(self._end_s, to_s)) + 1, self.n_chunks))

    def chunk(self, number: int) -> Rows:
        """Return the rows of one chunk, whose CRC is checked. ``RecordingError`` where it is damaged."""
        rows = self._cache.pop(number, None)
        if rows is None:
            rows = self._read(number)
            while len(self._cache) >= CACHED_CHUNKS:
                self._cache.popitem(last=False)
        self._cache[number] = rows
        return rows

    def _read(self, number: int) -> Rows:
        crc = fmt.layout_crc(self.columns)
        parts: list[Array] = []
        try:
            content = read_chunk(self._file, int(self._offset[number]))
            for record in chunk_records(content):
                if isinstance(record, Channel) and record.topic == fmt.TICKS_TOPIC:
                    self._ticks_channel = record.id
                elif isinstance(record, ChunkMessage) and record.channel_id == self._ticks_channel:
                    parts.append(fmt.decode_block(record.data, crc, len(self.columns)).data)
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}; 'micron recover' says what is left of it") from error
        data = np.concatenate(parts, axis=1) if parts else np.empty((len(self.columns), 0))
        with np.errstate(over="ignore"):
            return Rows(data[self._time_row].copy(), data.astype(np.float32))

    def _read_head(self) -> None:
        """Take the metadata before the first chunk: the layout is there, and what the recorder knew at its start."""
        for item in Scanner(self._file, self.path).items():
            if isinstance(item, MetadataRecord):
                try:
                    value = fmt.decode_metadata(item.name, item.metadata)
                except RecordingError as error:
                    raise RecordingError(f"{self.path}: metadata {item.name[:60]!r}: {error}") from error
                self.metadata.setdefault(item.name, value)
            elif isinstance(item, ChunkRecord):
                break
        layout = self.metadata.pop(fmt.LAYOUT_METADATA, None)
        if layout is None:
            raise RecordingError(f"{self.path} is not a recording of this instrument: it has no column layout")
        self.columns = fmt.layout_of_text(layout) if isinstance(layout, str) else fmt.layout_of(layout)
        if fmt.TIME_COLUMN not in self.names:
            raise RecordingError(f"{self.path} has no column {fmt.TIME_COLUMN!r}: it cannot be shown over time")

    def _read_index(self) -> tuple[NDArray[np.int64], Array]:
        """Return place [n] and last time [n] in s of every chunk, from the summary at the end of the file."""
        torn = RecordingError(
            f"{self.path} has no index: it was torn, or is still being written. 'micron recover' makes it whole"
        )
        file: BinaryIO = self._file
        size = file.seek(0, 2)
        if size < _FOOTER_BYTES + len(MCAP0_MAGIC):
            raise torn
        file.seek(size - _FOOTER_BYTES)
        tail = file.read(_FOOTER_BYTES)
        opcode, length = _FRAME.unpack_from(tail)
        start, _, _ = _FOOTER.unpack_from(tail, _FRAME.size)
        if tail[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC or opcode != Opcode.FOOTER or length != _FOOTER.size:
            raise torn
        stop = size - _FOOTER_BYTES
        if not 0 < start <= stop or stop - start > MOST_INDEX_BYTES:
            raise torn
        file.seek(start)
        summary = file.read(stop - start)
        found: list[tuple[int, int]] = []
        at = 0
        while at + _FRAME.size <= len(summary):
            opcode, length = _FRAME.unpack_from(summary, at)
            at += _FRAME.size
            if opcode == Opcode.CHUNK_INDEX and _CHUNK_INDEX.size <= length <= len(summary) - at:
                _, last_ns, place, _ = _CHUNK_INDEX.unpack_from(summary, at)
                if place < start:
                    found.append((place, last_ns))
            at += length
        if not found:
            raise torn
        places, last_ns = (np.array(column, dtype=np.uint64) for column in zip(*found, strict=True))
        end_s = last_ns.astype(np.float64) * 1e-9
        if (np.diff(places.astype(np.int64)) <= 0).any() or (np.diff(end_s) < 0).any():
            raise RecordingError(f"{self.path}: its chunks are not in order of time; sort it first ('mcap sort FILE')")
        return places.astype(np.int64), end_s
