"""Reads an MCAP file record by record, finished, torn or damaged, and never believes an unchecked byte.

``mcap``'s own readers stop at the first damage. This one skips a chunk whose CRC is wrong, and where the framing
itself is lost it looks for the next chunk; everything inside a chunk is decoded by ``mcap``.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord, Metadata
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from firmware_py.recording.errors import RecordingError

MAX_RECORD_BYTES = 1 << 28
_MAX_CHUNK_BYTES = 1 << 26  # a damaged size must not make us ask for gigabytes
_FRAME = struct.Struct("<BQ")
_CHUNK_HEADER = struct.Struct("<QQQI")  # start, end, size, crc; then the compression as a counted string
_ZSTD_NAME = b"\x04\x00\x00\x00zstd"
_PARSE_ERRORS = (
    McapError, CRCValidationError, zstandard.ZstdError, struct.error, ValueError, OverflowError, RecordingError,
)  # fmt: skip
"""Of these ``OverflowError``: a length of 64 bits, which no file can have."""


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    """The records of one chunk whose CRC is right. ``offset`` and ``length`` say where it is in the file."""

    offset: int
    length: int
    records: tuple[McapRecord, ...]


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """One metadata record (its text is checked by its own CRC, see ``format.decode_metadata``)."""

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
    """The file ends as a finished one does."""


Item = ChunkRecord | MetadataRecord | Damage | Finished


def scan(path: Path) -> Iterator[Item]:
    """All usable parts of the file, in order. ``RecordingError`` when it is not an MCAP file at all."""
    with _open(path) as file:
        size = file.seek(0, 2)
        file.seek(0)
        head = file.read(len(MCAP0_MAGIC))
        if head != MCAP0_MAGIC:
            what = "is empty" if size == 0 else "does not begin like an MCAP file"
            raise RecordingError(f"{path} is not a recording: it {what}")
        offset = len(MCAP0_MAGIC)
        while offset < size:
            item, offset = _next(file, offset, size)
            if item is not None:
                yield item
            if isinstance(item, Finished):
                return


def read_chunk(file: BinaryIO, offset: int) -> tuple[McapRecord, ...]:
    """The records of the chunk at ``offset``, checked. Raises what ``scan`` would report as damage."""
    file.seek(offset)
    opcode, length = _FRAME.unpack(file.read(_FRAME.size))
    if opcode != Opcode.CHUNK:
        raise RecordingError(f"no chunk at byte {offset}: the file was changed while it was read")
    return _records(file.read(length))


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error


def _next(file: BinaryIO, offset: int, size: int) -> tuple[Item | None, int]:
    """The item at ``offset`` (None for a record of no interest) and where the next one begins."""
    file.seek(offset)
    frame = file.read(_FRAME.size)
    if len(frame) < _FRAME.size:
        return Damage(offset, size - offset, "the file ends inside a record", torn=True), size
    opcode, length = _FRAME.unpack(frame)
    end = offset + _FRAME.size + length
    if not Opcode.HEADER <= opcode <= Opcode.DATA_END or length > MAX_RECORD_BYTES or end > size:
        return _resynchronise(file, offset, size)
    if opcode == Opcode.CHUNK:
        body = file.read(length)
        try:
            return ChunkRecord(offset, end - offset, _records(body)), end
        except _PARSE_ERRORS as error:
            return Damage(offset, end - offset, f"a chunk is damaged: {error}"), end
    if opcode == Opcode.METADATA:
        try:
            record = Metadata.read(ReadDataStream(BytesIO(file.read(length))))
        except _PARSE_ERRORS as error:
            return Damage(offset, end - offset, f"a metadata record is damaged: {error}"), end
        return MetadataRecord(record.name, record.metadata), end
    if opcode == Opcode.FOOTER and file.seek(end) == end and file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC:
        return Finished(), size
    return None, end


def _records(body: bytes) -> tuple[McapRecord, ...]:
    """Decode a chunk; ``mcap`` would take a CRC of 0 as 'not checked' and any size as true."""
    _, _, uncompressed_size, crc = _CHUNK_HEADER.unpack_from(body)
    if uncompressed_size > _MAX_CHUNK_BYTES:
        raise RecordingError(f"it claims {uncompressed_size} bytes")
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    if chunk.compression == "" and zlib.crc32(chunk.data) != crc:
        raise RecordingError("its CRC is wrong")
    if crc == 0:
        raise RecordingError("it has no CRC")
    return tuple(breakup_chunk(chunk, validate_crc=True))


def _resynchronise(file: BinaryIO, offset: int, size: int) -> tuple[Item, int]:
    """The framing is lost at ``offset``: find the next sound zstd chunk, or call the rest torn."""
    name_at = _FRAME.size + _CHUNK_HEADER.size  # from the start of a chunk record to its compression
    window_start, window = offset, b""
    position = offset
    while position < size:
        file.seek(position)
        block = file.read(1 << 20)
        window_start = position - len(window)
        window += block
        position += len(block)
        found = -1
        while (found := window.find(_ZSTD_NAME, found + 1)) >= 0:
            start = window_start + found - name_at
            if start > offset and _sound_chunk(file, start, size):
                return Damage(offset, start - offset, "the framing of the file is damaged"), start
        window = window[-len(_ZSTD_NAME) :]
    return Damage(offset, size - offset, "the file ends inside a record", torn=True), size


def _sound_chunk(file: BinaryIO, start: int, size: int) -> bool:
    file.seek(start)
    opcode, length = _FRAME.unpack(file.read(_FRAME.size))
    if opcode != Opcode.CHUNK or start + _FRAME.size + length > size:
        return False
    try:
        _records(file.read(length))
    except _PARSE_ERRORS:
        return False
    return True
