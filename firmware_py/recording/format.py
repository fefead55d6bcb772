"""Defines the recording format: an MCAP file whose messages are blocks of ticks and events (docs/recording-format.md).

A block is column-major and byte-shuffled (all lowest bytes of all values first, as in HDF5's shuffle filter), which
makes zstd twice as effective on slowly changing float64; measured in design/ecosystem.md section 3.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from firmware_py.recording.errors import RecordingError
from hal.arrays import Array
from hal.jsonable import to_jsonable

PROFILE = "micron"
TICKS_TOPIC, TICKS_SCHEMA, TICKS_ENCODING = "ticks", "micron.ticks", "x-micron-ticks"
EVENTS_TOPIC, EVENTS_SCHEMA, EVENTS_ENCODING = "events", "micron.event", "json"
TICKS_CHANNEL, EVENTS_CHANNEL = 1, 2  # fixed, so that a file with a damaged first chunk can still be read
LAYOUT_METADATA, END_METADATA, STATISTICS_METADATA = "layout", "end", "statistics"
BLOCK_ROWS = 100
CHUNK_BYTES = 16 * 1024
MOST_COLUMNS = 10_000
MOST_NAME_LENGTH = 1000
MOST_NESTING = 100
MOST_ROW = 1 << 53
"""Row numbers and ticks are exact as float64 up to here; at 1 kHz that is 285,000 years."""

TICK_COLUMN = "tick"  # device sequence number of the scan
TIME_COLUMN = "t"  # s since the start of the run

_MAGIC = b"MTB1"
_HEADER = struct.Struct("<4sIIIQ")  # magic, columns, rows, CRC-32 of the layout, number of the first row


class ColumnInfo(NamedTuple):
    """Describes one float64 column of a recording."""

    name: str
    unit: str


class Block(NamedTuple):
    """``data[n_columns, n_rows]``; its first row is row ``row0`` of the run, dropped rows counted."""

    row0: int
    data: Array


def check_columns(columns: Sequence[tuple[str, str]]) -> tuple[ColumnInfo, ...]:
    """The columns of a layout; ``RecordingError`` when there are none, too many, or two have one name."""
    result = tuple(ColumnInfo(name, unit) for name, unit in columns)
    if not 1 <= len(result) <= MOST_COLUMNS:
        raise RecordingError(f"a recording needs 1 to {MOST_COLUMNS} columns, not {len(result)}")
    seen: set[str] = set()
    for column in result:
        if len(column.name) > MOST_NAME_LENGTH or len(column.unit) > MOST_NAME_LENGTH:
            raise RecordingError(f"the name or unit of a column is longer than {MOST_NAME_LENGTH} characters")
        if column.name in seen:
            raise RecordingError(f"two columns are called {column.name!r}: give each its own name")
        seen.add(column.name)
    return result


def layout_text(columns: Sequence[ColumnInfo]) -> str:
    """Return the layout as it is stored in the file."""
    return json.dumps([{"name": c.name, "unit": c.unit} for c in columns], separators=(",", ":"), ensure_ascii=False)


def layout_of_text(text: str) -> tuple[ColumnInfo, ...]:
    """Inverse of ``layout_text``. ``RecordingError`` when the text is no layout."""
    return layout_of(load_json(text))


def layout_of(entries: object) -> tuple[ColumnInfo, ...]:
    """The layout in a list of ``{"name", "unit"}``, as stored. ``RecordingError`` when it is no layout."""
    columns: list[tuple[str, str]] = []
    for entry in cast("list[object]", entries) if isinstance(entries, list) else [None]:
        match entry:
            case {"name": str(name), "unit": str(unit)}:
                columns.append((name, unit))
            case _:
                raise RecordingError("the layout is not a list of columns with a name and a unit")
    return check_columns(columns)


def load_json(text: str | bytes) -> Any:
    """The value of a JSON text that somebody else wrote; it can be written again. ``RecordingError`` otherwise."""
    try:
        text = text if isinstance(text, str) else text.decode()
        if text.count("[") + text.count("{") > MOST_NESTING and _nesting(text) > MOST_NESTING:
            raise RecordingError(f"a JSON text is nested more than {MOST_NESTING} deep")
        value = json.loads(text)
        json.dumps(value, ensure_ascii=False).encode()  # half a surrogate pair can be read, but never written
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"a text is not JSON: {error}") from error
    return value


def _nesting(text: str) -> int:
    """An upper bound of how deep ``text`` is nested; brackets inside its strings count as well."""
    deep = deepest = 0
    for match in re.finditer(r"[\[{\]}]", text):
        deep += 1 if match[0] in "[{" else -1
        deepest = max(deepest, deep)
    return deepest


def layout_crc(columns: Sequence[ColumnInfo]) -> int:
    """Return the CRC-32 of the layout's text, which ties a block to its layout."""
    return zlib.crc32(layout_text(columns).encode())


def ticks_schema(columns: Sequence[ColumnInfo]) -> bytes:
    """Return the JSON schema of a decoded block, with the layout under ``x-layout``."""
    return json.dumps(
        {
            "title": TICKS_SCHEMA,
            "description": (
                "A block of ticks. Message: 24 byte header, little endian: 4 bytes 'MTB1', u32 columns, u32 rows, "
                "u32 CRC-32 of the UTF-8 text of x-layout as stored in the metadata record 'layout', u64 number of the "
                "first row of the run. Then 8*columns*rows bytes: the float64 values, little endian, column by column, "
                "byte-shuffled: byte 0 of all values, then byte 1 of all values, ... byte 7."
            ),
            "type": "object",
            "properties": {
                c.name: {"type": "array", "items": {"type": "number"}, "description": f"unit: {c.unit}"}
                for c in columns
            },
            "x-layout": json.loads(layout_text(columns)),
        },
        ensure_ascii=False,
    ).encode()


def events_schema() -> bytes:
    """Return the JSON schema of an event."""
    return json.dumps(
        {
            "title": EVENTS_SCHEMA,
            "description": "Something that happened once. The message's sequence numbers the events of a run from 0.",
            "type": "object",
            "properties": {
                "t_ns": {"type": "integer", "description": "bench time, ns"},
                "kind": {"type": "string"},
            },
        }
    ).encode()


def encode_block(row0: int, rows: Array, crc: int) -> bytes:
    """Message of the rows ``rows[n_rows, n_columns]``, numbered from ``row0``; ``crc`` is ``layout_crc``."""
    n_rows, n_columns = rows.shape
    columns = np.ascontiguousarray(rows.T, dtype="<f8")
    shuffled = columns.view(np.uint8).reshape(-1, 8).T
    return _HEADER.pack(_MAGIC, n_columns, n_rows, crc, row0) + shuffled.tobytes()


def decode_block(message: bytes | memoryview, crc: int, layout_columns: int) -> Block:
    """Inverse of ``encode_block``. ``RecordingError`` when the message is not a block of this layout.

    ``layout_columns`` is the number of columns of the layout whose ``layout_crc`` is ``crc``.
    """
    if len(message) < _HEADER.size:
        raise RecordingError(f"a block of {len(message)} bytes is shorter than its header")
    magic, n_columns, n_rows, found_crc, row0 = _HEADER.unpack_from(message)
    if magic[:3] == _MAGIC[:3] and magic != _MAGIC:
        raise RecordingError(
            f"blocks of format {magic[3:].decode('latin-1')}: a later version wrote them, this one reads format 1; "
            "use that version, or let it export"
        )
    if magic != _MAGIC or len(message) != _HEADER.size + 8 * n_columns * n_rows:
        raise RecordingError("a message of the ticks channel is not a block of ticks")
    if found_crc != crc:
        raise RecordingError("a block was written with another layout than the file's")
    if n_columns != layout_columns or n_rows == 0 or row0 + n_rows > MOST_ROW:
        raise RecordingError(f"a block claims {n_rows} rows from row {row0} on, of {n_columns} columns")
    shuffled = np.frombuffer(message, dtype=np.uint8, offset=_HEADER.size).reshape(8, -1)
    data = np.ascontiguousarray(shuffled.T).view("<f8").reshape(n_columns, n_rows)
    return Block(row0, data.astype(np.float64, copy=False))


def encode_metadata(name: str, value: object) -> dict[str, str]:
    """A metadata record: the text, how to read it, and a CRC-32 of name, type and text, because MCAP protects only
    chunks."""
    if isinstance(value, str):
        kind, text = "text", value
    else:
        kind, text = "json", json.dumps(to_jsonable(value), ensure_ascii=False)
    return {"text": text, "type": kind, "crc32": _metadata_crc(name, kind, text)}


def decode_metadata(name: str, record: Mapping[str, str]) -> Any:
    """Inverse of ``encode_metadata``. ``RecordingError`` when the CRC is wrong."""
    try:
        text, kind, crc = record["text"], record["type"], record["crc32"]
    except KeyError as missing:
        raise RecordingError(f"the metadata record has no {missing}") from missing
    if _metadata_crc(name, kind, text) != crc:
        raise RecordingError("the text of the metadata record does not match its CRC")
    return load_json(text) if kind == "json" else text


def _metadata_crc(name: str, kind: str, text: str) -> str:
    return f"{zlib.crc32(chr(10).join((name, kind, text)).encode()):08x}"
