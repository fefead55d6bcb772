"""Reads an MCAP file record by record, finished, torn or damaged, and never believes an unchecked byte.

``mcap``'s own readers stop at the first damage and trust every declared size. This one skips a chunk whose CRC is
wrong, looks for the next chunk where the framing itself is lost, and does an amount of work that is linear in the
size of the file whatever the file claims.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from firmware_py.recording.errors import RecordingError
from firmware_py.recording.unpack import MOST_CHUNK_BYTES, FileTooExpansive, UnpackBudget, unpack

MOST_METADATA_BYTES = 1 << 24
MOST_SCHEMA_BYTES = 1 << 22
MOST_SEARCH_BYTES = 1 << 24
"""Bytes of false chunks that are read in a file besides ``SEARCH_RATIO`` times its size, before the search ends."""
SEARCH_RATIO = 4
_RECORD_COST_BYTES = 256
"""A record is counted as so many unpacked bytes at least: a chunk of a million empty records takes seconds, too."""
_CANDIDATE_COST_BYTES = 64

_FRAME = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, CRC, length of the compression's name
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_U64 = struct.Struct("<Q")
_CHUNK_START = re.compile(rb"\x06(?=.{36}(?:\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4|\x00\x00\x00\x00))", re.DOTALL)
_CHUNK_START_BYTES = 1 + 36 + 8
_MOST_NAME_BYTES = 32
_MOST_CHUNK_RECORD = MOST_CHUNK_BYTES + (MOST_CHUNK_BYTES >> 7) + 1024  # incompressible content, and its frame
_PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError, MemoryError)


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    """The unpacked content of one chunk whose CRC is right. ``offset`` and ``length`` say where it is in the file."""

    offset: int
    length: int
    content: bytes


class ChunkMessage(NamedTuple):
    """Describes one message. ``at`` is the place of its record in the chunk's content; ``data`` is a view of that
    content."""

    at: int
    channel_id: int
    sequence: int
    log_time: int
    data: memoryview


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """Describes one metadata record (its text is checked by its own CRC, see ``format.decode_metadata``)."""

    offset: int
    name: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class Damage:
    """``length`` bytes from ``offset`` that cannot be used. ``torn``: the file simply ends there."""

    offset: int
    length: int
    reason: str
    torn: bool = False


@dataclass(frozen=True, slots=True)
class Finished:
    """Reports that the file ends as a finished one does."""


Item = ChunkRecord | MetadataRecord | Damage | Finished


def read_chunk(file: BinaryIO, offset: int) -> bytes:
    """The content of the chunk at ``offset``, checked. ``RecordingError`` when it is not there any more."""
    file.seek(offset)
    frame = file.read(_FRAME.size)
    opcode, length = _FRAME.unpack(frame) if len(frame) == _FRAME.size else (0, 0)
    if opcode != Opcode.CHUNK:
        raise RecordingError(f"no chunk at byte {offset}: the file was changed while it was read")
    return _unpack_chunk(file.read(min(length, _MOST_CHUNK_RECORD)), None)


def chunk_records(content: bytes, budget: UnpackBudget | None = None) -> Iterator[Schema | Channel | ChunkMessage]:
    """The schemas, channels and messages of a chunk. ``RecordingError`` where its content is not well formed."""
    view = memoryview(content)
    at = 0
    while at < len(view):
        if budget is not None:
            budget.spend(_RECORD_COST_BYTES)
        if len(view) - at < _FRAME.size:
            raise RecordingError("it ends inside a record")
        opcode, length = _FRAME.unpack_from(view, at)
        start = at + _FRAME.size
        stop = start + length
        if stop > len(view):
            raise RecordingError(f"a record claims {length} bytes, beyond the end of its chunk")
        if opcode == Opcode.MESSAGE:
            yield message_at(view, at)
        elif opcode == Opcode.CHANNEL or opcode == Opcode.SCHEMA:
            if length > MOST_SCHEMA_BYTES:
                raise RecordingError(f"a schema or channel of {length} bytes; at most {MOST_SCHEMA_BYTES} are read")
            stream = ReadDataStream(BytesIO(view[start:stop]))
            try:
                record = Channel.read(stream) if opcode == Opcode.CHANNEL else Schema.read(stream)
            except _PARSE_ERRORS as error:
                raise RecordingError(f"a schema or channel cannot be read: {error}") from error
            yield record
        at = stop


def mcap_records(file: BinaryIO) -> Iterator[Schema | Channel | ChunkMessage]:
    """The schemas, channels and messages of any sound MCAP file, with or without chunks and CRCs, in its order.

    ``RecordingError`` at the first damage. Sizes are bounded as for our own recordings.
    """
    size = file.seek(0, 2)
    file.seek(0)
    budget = UnpackBudget(size)
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise RecordingError("it does not begin like an MCAP file")
    left = size - len(MCAP0_MAGIC)
    while True:
        frame = file.read(_FRAME.size)
        if len(frame) < _FRAME.size:
            raise RecordingError("it ends inside a record")
        opcode, length = _FRAME.unpack(frame)
        left -= _FRAME.size + length
        if left < 0:
            raise RecordingError(f"a record claims {length} bytes, beyond the end of the file")
        if opcode == Opcode.CHUNK:
            yield from chunk_records(_unpack_chunk(_bounded(file, length), budget, needs_crc=False), budget)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield from chunk_records(frame + _bounded(file, length), budget)
        elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return  # what follows repeats the schemas and channels
        else:
            file.seek(length, 1)


def _bounded(file: BinaryIO, length: int) -> bytes:
    if length > _MOST_CHUNK_RECORD:
        raise RecordingError(f"a record of {length} bytes; at most {_MOST_CHUNK_RECORD} are read")
    return file.read(length)


def message_at(content: bytes | memoryview, at: int) -> ChunkMessage:
    """The message whose record begins at ``at``. ``RecordingError`` when there is none."""
    view = memoryview(content)
    start = at + _FRAME.size
    if start > len(view):
        raise RecordingError("a chunk has changed: a message is not where it was")
    opcode, length = _FRAME.unpack_from(view, at)
    stop = start + length
    if opcode != Opcode.MESSAGE or stop > len(view) or length < _MESSAGE_HEAD.size:
        raise RecordingError("a message is shorter than its header")
    channel_id, sequence, log_time, _ = _MESSAGE_HEAD.unpack_from(view, start)
    return ChunkMessage(at, channel_id, sequence, log_time, view[start + _MESSAGE_HEAD.size : stop])


class Scanner:
    """Passes once over an open file. ``bytes_searched`` counts what false chunks cost, ``budget`` what was unpacked."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file = file
        self._path = path
        self.size = file.seek(0, 2)
        self.budget = UnpackBudget(self.size)
        self.bytes_searched = 0
        self._most_searched = MOST_SEARCH_BYTES + SEARCH_RATIO * self.size
        self._loose_from, self._loose = 0, 0

    def items(self) -> Iterator[Item]:
        """Yield the usable parts, in order."""
        self._file.seek(0)
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            what = "is empty" if self.size == 0 else "does not begin like an MCAP file"
            raise RecordingError(f"{self._path} is not a recording: it {what}")
        offset = len(MCAP0_MAGIC)
        while offset < self.size:
            try:
                item, offset = self._next(offset)
            except FileTooExpansive as error:
                raise RecordingError(f"{self._path} is not read: {error}") from error
            if item is not None:
                yield item
            if isinstance(item, Finished):
                if offset < self.size:
                    yield Damage(offset, self.size - offset, "something follows the end of the recording")
                break
        if self._loose:
            yield Damage(
                self._loose_from, 0, f"{self._loose} messages outside chunks have no checksum and are not read; "
                "copy the file with chunks",
            )  # fmt: skip

    def _next(self, offset: int) -> tuple[Item | None, int]:
        """The item at ``offset`` (None for a record of no interest) and where the next one begins."""
        file = self._file
        file.seek(offset)
        frame = file.read(_FRAME.size)
        if len(frame) < _FRAME.size:
            return Damage(offset, self.size - offset, "the file ends inside a record", torn=True), self.size
        opcode, length = _FRAME.unpack(frame)
        end = offset + _FRAME.size + length
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END or end > self.size:
            return self._find_chunk(offset)
        if opcode == Opcode.CHUNK:
            if length > _MOST_CHUNK_RECORD or not self._is_chunk_head(offset, length):
                return self._find_chunk(offset)
            try:
                file.seek(offset + _FRAME.size)
                return ChunkRecord(offset, end - offset, _unpack_chunk(file.read(length), self.budget)), end
            except FileTooExpansive:
                raise
            except RecordingError as error:
                return Damage(offset, end - offset, f"a chunk is damaged: {error}"), end
        if opcode == Opcode.METADATA:
            if length > MOST_METADATA_BYTES:
                return Damage(offset, end - offset, f"a metadata record of {length} bytes is too large to read"), end
            try:
                record = Metadata.read(ReadDataStream(BytesIO(file.read(length))))
            except _PARSE_ERRORS as error:
                return Damage(offset, end - offset, f"a metadata record is damaged: {error}"), end
            return MetadataRecord(offset, record.name, record.metadata), end
        if opcode == Opcode.MESSAGE:
            self._loose_from = self._loose_from or offset
            self._loose += 1
        if opcode == Opcode.FOOTER and file.seek(end) == end and file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC:
            return Finished(), end + len(MCAP0_MAGIC)
        return None, end

    def _is_chunk_head(self, offset: int, length: int) -> bool:
        """Return True if the lengths in the chunk record at ``offset`` agree with one another."""
        self._file.seek(offset + _FRAME.size)
        head = self._file.read(_CHUNK_HEAD.size + _MOST_NAME_BYTES + _U64.size)
        if len(head) < _CHUNK_HEAD.size:
            return False
        *_, name_length = _CHUNK_HEAD.unpack_from(head)
        name_stop = _CHUNK_HEAD.size + name_length
        if name_length > _MOST_NAME_BYTES or len(head) < name_stop + _U64.size:
            return False
        (packed_length,) = _U64.unpack_from(head, name_stop)
        return length == name_stop + _U64.size + packed_length

    def _find_chunk(self, offset: int) -> tuple[Item, int]:
        """Find the next sound chunk after the framing is lost at ``offset``, or call the rest torn."""
        position = offset + 1
        step = 1 << 10  # grows, so that a search costs no more than the distance to what it finds
        while position < self.size:
            self._file.seek(position)
            window = self._file.read(step + _CHUNK_START_BYTES)
            for match in _CHUNK_START.finditer(window):
                start = position + match.start()
                if match.start() >= step:
                    break
                self.bytes_searched += _CANDIDATE_COST_BYTES
                if self.bytes_searched > self._most_searched:
                    reason = "the framing of the file is damaged, and it holds too many false chunks to search"
                    return Damage(offset, self.size - offset, reason), self.size
                if self._is_sound_chunk(start):
                    return Damage(offset, start - offset, "the framing of the file is damaged"), start
            position += step
            step = min(2 * step, 1 << 20)
        return Damage(offset, self.size - offset, "the file ends inside a record", torn=True), self.size

    def _is_sound_chunk(self, start: int) -> bool:
        self._file.seek(start)
        frame = self._file.read(_FRAME.size)
        if len(frame) < _FRAME.size:
            return False
        opcode, length = _FRAME.unpack(frame)
        if opcode != Opcode.CHUNK or length > _MOST_CHUNK_RECORD or start + _FRAME.size + length > self.size:
            return False
        if not self._is_chunk_head(start, length):
            return False
        self.bytes_searched += length
        self._file.seek(start + _FRAME.size)
        try:
            _unpack_chunk(self._file.read(length), self.budget)
        except FileTooExpansive:
            raise
        except RecordingError:
            return False
        return True


def _unpack_chunk(body: bytes, budget: UnpackBudget | None, *, needs_crc: bool = True) -> bytes:
    """The content of a chunk record. ``mcap`` would take any size as true, and a CRC of 0 as 'not checked'; so does
    this with ``needs_crc`` off, for files of others."""
    try:
        *_, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        name_stop = _CHUNK_HEAD.size + name_length
        (packed_length,) = _U64.unpack_from(body, name_stop)
        compression = body[_CHUNK_HEAD.size : name_stop].decode()
    except (struct.error, ValueError, OverflowError) as error:
        raise RecordingError(f"its header cannot be read ({error})") from error
    packed = memoryview(body)[name_stop + _U64.size :]
    if packed_length != len(packed):
        raise RecordingError(f"it claims {packed_length} packed bytes and holds {len(packed)}")
    if crc == 0 and needs_crc:
        raise RecordingError("it has no CRC")
    if budget is not None:
        budget.spend(min(size, MOST_CHUNK_BYTES))
    content = unpack(compression, packed, size)
    if crc and zlib.crc32(content) != crc:
        raise RecordingError("its CRC is wrong")
    return content
