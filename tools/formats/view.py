"""Writes MCAP for viewers (Foxglove, PlotJuggler, rerun): protobuf messages, one topic per group of the frame.

Every message of a group has the same length, so that thousands of them are built at once as a table of bytes: tags stay
where they are, only the values change. Numbers are double and exact. Events are ``foxglove.Log``, the attitude is a
``foxglove.PoseInFrame`` as well. Protobuf encoding: protobuf.dev, "Encoding"; container: mcap.dev/spec.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from firmware_py.frame import LAYOUT
from firmware_py.recording import format as fmt
from firmware_py.recording.reader import Recording
from hal.jsonable import to_jsonable
from tools.formats.blocks import batches, event_times_ns
from tools.formats.packages import need

EXTRA = "viewers"
MAGIC = b"\x89MCAP0\r\n"
PROFILE = "micron-view"
PACKAGE = "micron"
WORLD = "world"
_GROUPS = MappingProxyType(
    {
        "scan": ("tick", "counts", "magnetometer_raw", "magnetometer_fresh"),
        "inputs": ("volts", "supply", "temperature"),
        "sensors": ("accelerometer", "accelerometer_more", "parity", "magnetometer"),
        "motion": ("specific_force", "angular_acceleration", "rate", "quaternion"),
        "tip": ("tip_acceleration", "tip_displacement"),
        "tremor": (
            "tremor", "tremor_ahead", "tremor_core", "tremor_frequency", "tremor_amplitude", "confidence",
        ),
        "actuation": ("desired_tip", "stroke", "command", "clip", "status"),
    }
)  # fmt: skip
"""Groups of the frame and their quantities; each becomes a topic. Columns that are none of these go to ``/other``."""
_QUATERNION = ("quaternion_x", "quaternion_y", "quaternion_z", "quaternion_w")
_ROWS = 1000
"""Rows per chunk: a megabyte, what MCAP readers expect."""
_LEVEL = 3
_LEVELS = MappingProxyType({"safe state": 4, "recording stopped": 4, "hold begins": 3, "axis left out": 3, "drift": 3})
"""Levels of ``foxglove.Log`` by event (3 warning, 4 error); others are information."""
_INFORMATION = 2
_ENDS = ("run finished", "stopped by the operator")
"""Reasons of a safe state that is the end of a run."""
_MESSAGE_HEAD = 1 + 8 + 2 + 4 + 8 + 8  # opcode, length, channel, sequence, two times
_FIXED64 = 1


@dataclass(frozen=True)
class Topic:
    """A topic whose messages are rows of double: ``fields`` (name, column of the recording), ``schema`` its name."""

    name: str
    schema: str
    fields: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class View:
    """Describes the written view."""

    topics: tuple[str, ...]
    messages: int


def topics(columns: Sequence[tuple[str, str]]) -> tuple[Topic, ...]:
    """Return the topics of a recording's columns (name, unit). The time is the time of each message, no field."""
    of = {name: group for group, names in _GROUPS.items() for name in names}
    place = {scalar: of[c.name] for c in LAYOUT if c.name in of for scalar in c.scalar_names()}
    found: dict[str, list[tuple[str, int]]] = {group: [] for group in (*_GROUPS, "other")}
    for i, (name, unit) in enumerate(columns):
        if name != fmt.TIME_COLUMN:
            found[place.get(name, "other")].append((field_name(name, unit), i))
    return tuple(
        Topic(f"/{group}", f"{PACKAGE}.{group.capitalize()}", tuple(_unique(fields)))
        for group, fields in found.items()
        if fields
    )


def field_name(name: str, unit: str) -> str:
    """Return a protobuf field for a column: its name and its unit (``rate_x_rad_per_s``)."""
    words = unit.replace("/", "_per_").replace("^", "").replace("%", "percent").replace("°", "deg").replace("µ", "u")
    text = name if unit in ("", "1") else f"{name}_{words}"
    text = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_") or "value"
    return f"_{text}" if text[0].isdigit() else text


def _unique(fields: list[tuple[str, int]]) -> Iterator[tuple[str, int]]:
    seen: set[str] = set()
    for name, column in fields:
        # protobuf compares names without underscores and capitals, as they are in JSON
        unique = name if name.replace("_", "").lower() not in seen else f"{name}_column{column}"
        seen.add(unique.replace("_", "").lower())
        yield unique, column


def write(recording: Recording, path: Path) -> View:
    """Write a recording for viewers; a few blocks are in memory at a time. ``InputError`` without protobuf."""
    descriptors, pose, log = need(
        path.name, EXTRA, "google.protobuf.descriptor_pb2", "foxglove_schemas_protobuf.PoseInFrame_pb2",
        "foxglove_schemas_protobuf.Log_pb2",
    )  # fmt: skip
    listed = topics(recording.columns)
    names = recording.names
    clock = names.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in names else None
    numbers = recording.row_numbers() if clock is None else np.zeros(0)
    with path.open("wb") as file:
        out = _Writer(file)
        tables = [
            (out.channel(t.name, t.schema, _schema_of(descriptors, t)), _rows_of(t), [i for _, i in t.fields])
            for t in listed
        ]
        if all(name in names for name in _QUATERNION):
            channel = out.channel("/pose", "foxglove.PoseInFrame", _file_set(descriptors, pose.DESCRIPTOR))
            tables.append((channel, _pose_rows(), [names.index(name) for name in _QUATERNION]))
        events = out.channel("/events", "foxglove.Log", _file_set(descriptors, log.DESCRIPTOR))
        out.metadata("recording", {"of": recording.path.name, **_texts(recording)})
        at_ns = event_times_ns(recording)
        waiting = [(t, _log(log, e.content, t)) for t, e in zip(at_ns, recording.events, strict=True)]
        waiting.sort(key=lambda pair: pair[0])
        last_ns = 0
        for start, rows in batches(recording, _ROWS // fmt.BLOCK_ROWS):
            t_s = rows[clock] if clock is not None else numbers[start : start + rows.shape[1]] / recording.tick_hz
            t_ns = _times(t_s, last_ns)
            last_ns = int(t_ns[-1])
            parts = [out.rows(channel, make(rows[columns], t_ns), t_ns, start) for channel, make, columns in tables]
            due = [e for e in waiting if e[0] <= last_ns]
            out.chunk(parts, [(events, *e) for e in due])
            del waiting[: len(due)]
        if waiting:
            out.chunk([], [(events, *e) for e in waiting])
        out.finish()
        return View(tuple(out.topics), out.messages)


def _texts(recording: Recording) -> dict[str, str]:
    return {k: v if isinstance(v, str) else json.dumps(to_jsonable(v)) for k, v in recording.metadata.items()}


def _times(t_s: NDArray[np.float64], last_ns: int) -> NDArray[np.uint64]:
    """Return times in ns that never run backwards; a time that is no number is that of the row before."""
    known = np.where(np.isfinite(t_s), np.clip(t_s, 0.0, 9e9), 0.0)
    return np.maximum.accumulate(np.maximum(np.rint(known * 1e9).astype(np.uint64), np.uint64(last_ns)))


# -- messages ------------------------------------------------------------------------------------------------


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _tag(number: int, wire: int) -> bytes:
    return _varint(number << 3 | wire)


@dataclass
class _Template:
    """A message of constant length, and where its doubles and time stamps are."""

    data: bytearray = field(default_factory=bytearray)
    doubles: list[int] = field(default_factory=list[int])

    def double(self, number: int) -> None:
        self.data += _tag(number, _FIXED64)
        self.doubles.append(len(self.data))
        self.data += bytes(8)

    def rows(self, values: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return one message per column of ``values`` (doubles, rows), as bytes (rows, length)."""
        n = values.shape[1]
        table = np.empty((n, len(self.data)), np.uint8)
        table[:] = np.frombuffer(bytes(self.data), np.uint8)
        raw = np.ascontiguousarray(values.T, "<f8").view(np.uint8).reshape(n, -1, 8)
        for k, at in enumerate(self.doubles):
            table[:, at : at + 8] = raw[:, k]
        return table


class _Rows:
    """Messages of one topic from columns [columns, rows] and times [rows]."""

    def __init__(self, template: _Template, stamp_at: int | None = None) -> None:
        self._template = template
        self._stamp_at = stamp_at

    def __call__(self, values: NDArray[np.float64], t_ns: NDArray[np.uint64]) -> NDArray[np.uint8]:
        table = self._template.rows(values)
        if self._stamp_at is not None:
            seconds, nanoseconds = np.divmod(t_ns, np.uint64(1_000_000_000))
            _put_varint(table, self._stamp_at + 1, seconds)
            _put_varint(table, self._stamp_at + 7, nanoseconds)
        return table


def _rows_of(topic: Topic) -> _Rows:
    template = _Template()
    for number in range(1, len(topic.fields) + 1):
        template.double(number)
    return _Rows(template)


def _pose_rows() -> _Rows:
    """Encode ``foxglove.PoseInFrame``: timestamp 1, frame_id 2, pose 3 with position 1 (the origin) and orientation
    2."""
    orientation = _Template()
    for number in range(1, 5):
        orientation.double(number)
    stamp = _tag(1, 0) + bytes(5) + _tag(2, 0) + bytes(5)
    before = _tag(1, 2) + _varint(len(stamp)) + stamp + _tag(2, 2) + _varint(len(WORLD)) + WORLD.encode()
    turned = _tag(2, 2) + _varint(len(orientation.data))
    pose = _tag(1, 2) + _varint(0) + turned
    before += _tag(3, 2) + _varint(len(pose) + len(orientation.data)) + pose
    template = _Template(
        bytearray(before) + orientation.data, [len(before) + at for at in orientation.doubles]
    )  # fmt: skip
    return _Rows(template, stamp_at=2)


def _put_varint(table: NDArray[np.uint8], at: int, values: NDArray[np.uint64]) -> None:
    """Write numbers below 2^35 as varints of five bytes: protobuf allows leading zeros, and the length stays."""
    for k in range(5):
        part = (values >> np.uint64(7 * k) & np.uint64(0x7F)).astype(np.uint8)
        table[:, at + k] = part | (0x80 if k < 4 else 0)


def _log(log: Any, content: dict[str, Any], time_ns: int) -> bytes:
    what = str(content.get("event", "event"))
    more = {k: v for k, v in content.items() if k not in ("event", "t_ns")}
    level = _INFORMATION if content.get("reason") in _ENDS else _LEVELS.get(what, _INFORMATION)
    message = log.Log(level=level, name="micron", message=f"{what} {json.dumps(more)}" if more else what)
    message.timestamp.FromNanoseconds(time_ns)
    return message.SerializeToString()


def _schema_of(descriptors: Any, topic: Topic) -> bytes:
    """Return the ``FileDescriptorSet`` of a topic of doubles."""
    file = descriptors.FileDescriptorProto(
        name=f"{topic.schema.replace('.', '/').lower()}.proto", package=PACKAGE, syntax="proto3"
    )
    message = file.message_type.add(name=topic.schema.removeprefix(f"{PACKAGE}."))
    for number, (name, _) in enumerate(topic.fields, 1):
        kind = descriptors.FieldDescriptorProto
        message.field.add(name=name, number=number, type=kind.TYPE_DOUBLE, label=kind.LABEL_OPTIONAL)
    return descriptors.FileDescriptorSet(file=[file]).SerializeToString()


def _file_set(descriptors: Any, file: Any) -> bytes:
    """Return the ``FileDescriptorSet`` of a schema with everything that it imports."""
    found: dict[str, Any] = {}

    def add(descriptor: Any) -> None:
        for needed in descriptor.dependencies:
            add(needed)
        if descriptor.name not in found:
            found[descriptor.name] = descriptors.FileDescriptorProto()
            descriptor.CopyToProto(found[descriptor.name])

    add(file)
    return descriptors.FileDescriptorSet(file=list(found.values())).SerializeToString()


# -- file ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """Holds the messages of one channel in a chunk: records as bytes (rows, length), times (rows,) in ns."""

    channel: int
    records: NDArray[np.uint8]
    t_ns: NDArray[np.uint64]


class _Writer:
    """Writes chunks of many messages at once, with their indexes and a summary."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.topics: list[str] = []
        self.messages = 0
        self._known: list[tuple[Schema, Channel]] = []
        self._indexes: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._first_ns, self._last_ns = 1 << 63, 0
        self._compress = zstandard.ZstdCompressor(level=_LEVEL).compress
        self._file.write(MAGIC)
        self._write(Header(profile=PROFILE, library="micron-bench"))

    def channel(self, topic: str, schema: str, descriptors: bytes) -> int:
        """Describe a channel; returns its number."""
        number = len(self._known) + 1
        described = Schema(id=number, name=schema, encoding="protobuf", data=descriptors)
        channel = Channel(id=number, topic=topic, message_encoding="protobuf", metadata={}, schema_id=number)
        self._known.append((described, channel))
        self._counts[number] = 0
        self.topics.append(topic)
        for record in (described, channel):
            self._write(record)
        return number

    def metadata(self, name: str, texts: dict[str, str]) -> None:
        """Write texts that describe the whole file."""
        offset = self._file.tell()
        self._write(Metadata(name=name, metadata=texts))
        self._metadata.append(MetadataIndex(offset=offset, length=self._file.tell() - offset, name=name))

    def rows(self, channel: int, data: NDArray[np.uint8], t_ns: NDArray[np.uint64], first: int) -> _Part:
        """Return one message record per row of ``data`` (rows, length)."""
        n, length = data.shape
        records = np.empty((n, _MESSAGE_HEAD + length), np.uint8)
        head = struct.pack("<BQH", Opcode.MESSAGE, _MESSAGE_HEAD - 9 + length, channel)
        records[:, : len(head)] = np.frombuffer(head, np.uint8)
        numbers = (np.arange(first, first + n) & 0xFFFFFFFF).astype("<u4")
        records[:, 11:15] = numbers.view(np.uint8).reshape(n, 4)
        times = t_ns.astype("<u8").view(np.uint8).reshape(n, 8)
        records[:, 15:23] = times
        records[:, 23:31] = times
        records[:, _MESSAGE_HEAD:] = data
        return _Part(channel, records, t_ns)

    def chunk(self, parts: Sequence[_Part], events: Sequence[tuple[int, int, bytes]]) -> None:
        """Write a chunk: the rows of all channels in the order of time, then events (channel, time in ns, message)."""
        if parts:
            table = np.concatenate([part.records for part in parts], axis=1)
            body = [table.tobytes()]
            row = np.arange(table.shape[0], dtype=np.uint64) * np.uint64(table.shape[1])
        else:
            body, row = [], np.zeros(0, np.uint64)
        entries: dict[int, tuple[NDArray[np.uint64], NDArray[np.uint64]]] = {}
        at = 0
        for part in parts:
            entries[part.channel] = (part.t_ns, row + np.uint64(at))
            at += part.records.shape[1]
        at = len(body[0]) if body else 0
        for channel, t_ns, message in events:
            head = struct.pack("<BQHIQQ", Opcode.MESSAGE, _MESSAGE_HEAD - 9 + len(message), channel,
                               self._counts[channel], t_ns, t_ns)  # fmt: skip
            body.append(head + message)
            times, offsets = entries.get(channel, (np.zeros(0, np.uint64), np.zeros(0, np.uint64)))
            entries[channel] = (np.append(times, np.uint64(t_ns)), np.append(offsets, np.uint64(at)))
            at += len(body[-1])
            self._counts[channel] += 1
        for part in parts:
            self._counts[part.channel] += part.t_ns.size
        self.messages += sum(times.size for times, _ in entries.values())
        self._chunk(b"".join(body), entries)

    def _chunk(self, data: bytes, entries: dict[int, tuple[NDArray[np.uint64], NDArray[np.uint64]]]) -> None:
        first = min(int(times.min()) for times, _ in entries.values())
        last = max(int(times.max()) for times, _ in entries.values())
        self._first_ns, self._last_ns = min(first, self._first_ns), max(last, self._last_ns)
        packed = self._compress(data)
        start = self._file.tell()
        self._write(
            Chunk(
                compression="zstd",
                data=packed,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )
        length = self._file.tell() - start
        offsets: dict[int, int] = {}
        for channel, (times, places) in entries.items():
            offsets[channel] = self._file.tell()
            pairs = np.column_stack([times, places]).astype("<u8").tobytes()
            head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(pairs), channel, len(pairs))
            self._file.write(head + pairs)
        self._indexes.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=last,
                message_index_length=self._file.tell() - start - length,
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=len(data),
            )
        )

    def finish(self) -> None:
        """Write the end of the data, the summary and the footer."""
        self._write(DataEnd(data_section_crc=0))
        summary = self._file.tell()
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._known),
            channel_message_counts=self._counts,
            chunk_count=len(self._indexes),
            message_count=self.messages,
            message_end_time=self._last_ns,
            message_start_time=min(self._first_ns, self._last_ns),
            metadata_count=len(self._metadata),
            schema_count=len(self._known),
        )
        groups: tuple[tuple[int, Sequence[McapRecord]], ...] = (
            (Opcode.SCHEMA, [schema for schema, _ in self._known]),
            (Opcode.CHANNEL, [channel for _, channel in self._known]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._indexes),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        offsets: list[SummaryOffset] = []
        for opcode, records in groups:
            start = self._file.tell()
            for record in records:
                self._write(record)
            if records:
                offsets.append(
                    SummaryOffset(group_opcode=opcode, group_start=start, group_length=self._file.tell() - start)
                )
        offset_start = self._file.tell()
        for offset in offsets:
            self._write(offset)
        # a CRC of 0 says that there is none; the chunks have theirs
        self._write(Footer(summary_start=summary, summary_offset_start=offset_start, summary_crc=0))
        self._file.write(MAGIC)

    def _write(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._file.write(builder.end())
