"""Writes recordings: every finished block is a chunk of its own in the file, safe from the death of any process."""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Message, Metadata
from mcap.writer import CompressionType, Writer

from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import lock, refuse_existing
from hal.arrays import Array
from hal.jsonable import to_jsonable


class FileDisturbed(RecordingError):
    """Another program has changed the file under the recorder; ``what`` it did, ``lost``: nothing of it is left."""

    def __init__(self, what: str, *, lost: bool = False) -> None:
        super().__init__(f"the file was {what} while it was recorded")
        self.what = what
        self.lost = lost


class _Output:
    """An unbuffered file that writes everything or raises, and knows where the last whole part ended.

    A raw file may write less than asked without an error; ``mcap`` does not look at the count.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        refuse_existing(path, overwrite=overwrite)
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (0 if overwrite else os.O_EXCL)
        try:
            self._fd = os.open(path, flags, 0o644)
        except FileExistsError as error:
            raise RecordingError(f"{path} exists already: choose another name or remove it") from error
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
        self._path = path
        self._position = 0
        self.good_end = 0
        try:
            lock(self._fd, path)
            os.ftruncate(self._fd, 0)  # not when it was opened: it might have been somebody's recording
        except BaseException:
            os.close(self._fd)
            raise

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            n = os.write(self._fd, left)
            left = left[n:]
            self._position += n
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Do nothing, because nothing is buffered."""

    def check(self) -> None:
        """Raise ``FileDisturbed`` when another program has deleted, replaced, cut or written the file."""
        ours = os.fstat(self._fd)
        try:
            on_disk = os.stat(self._path)
        except OSError:
            on_disk = None
        if ours.st_nlink == 0:
            raise FileDisturbed("deleted" if on_disk is None else "replaced by another file", lost=True)
        if ours.st_size < self._position:
            raise FileDisturbed(f"cut to {ours.st_size} of {self._position} bytes")
        if ours.st_size > self._position:
            raise FileDisturbed("written by another program as well")

    @property
    def moved(self) -> bool:
        """True if the file is no longer under its name; ``check`` tells whether it is whole."""
        try:
            on_disk = os.stat(self._path)
        except OSError:
            return True
        ours = os.fstat(self._fd)
        return (on_disk.st_dev, on_disk.st_ino) != (ours.st_dev, ours.st_ino)

    def keep(self) -> None:
        """Mark what has been written so far as whole."""
        self.good_end = self._position

    def back_to_good(self) -> None:
        """Cut off a part that could not be written to its end."""
        os.ftruncate(self._fd, self.good_end)
        os.lseek(self._fd, self.good_end, os.SEEK_SET)
        self._position = self.good_end

    def sync(self) -> None:
        os.fdatasync(self._fd)

    def close(self) -> None:
        os.close(self._fd)


class RecordingWriter:
    """Writes one recording. ``OSError`` of the file system passes through; then call ``give_up``.

    ``metadata`` is stored at the start: texts as they are, other values as JSON. Times in the file are bench time
    since the start of the run, taken from the column ``t``.
    """

    def __init__(
        self,
        path: Path,
        columns: Sequence[tuple[str, str]],
        metadata: Mapping[str, Any],
        *,
        overwrite: bool = False,
    ) -> None:
        self.columns = fmt.check_columns(columns)
        self._crc = fmt.layout_crc(self.columns)
        names = [c.name for c in self.columns]
        self._time_column = names.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in names else None
        self._now_ns = 0
        self.rows = self.blocks = self.events = 0
        self.moved = False
        """True, after ``finish``, if the file is whole, but another program has given it another name."""
        self._output = _Output(path, overwrite)
        self._mcap = Writer(
            self._output,  # type: ignore[arg-type]  # it uses write, tell and flush only
            chunk_size=fmt.CHUNK_BYTES,
            compression=CompressionType.ZSTD,
        )
        self._mcap.start(profile=fmt.PROFILE)
        self._metadata_names: list[str] = []
        self.write_metadata(fmt.LAYOUT_METADATA, fmt.layout_text(self.columns))
        for name, value in metadata.items():
            self.write_metadata(name, value)
        schema = self._mcap.register_schema(fmt.TICKS_SCHEMA, "jsonschema", fmt.ticks_schema(self.columns))
        self._mcap.register_channel(fmt.TICKS_TOPIC, fmt.TICKS_ENCODING, schema)
        schema = self._mcap.register_schema(fmt.EVENTS_SCHEMA, "jsonschema", fmt.events_schema())
        self._mcap.register_channel(fmt.EVENTS_TOPIC, fmt.EVENTS_ENCODING, schema)

    def write_block(self, row0: int, rows: Array) -> None:
        """Write ``rows[n, n_columns]``, numbered on from ``row0``, as a chunk of its own with the events before it.

        In the file ``publish_time`` is the time of the first row, ``log_time`` that of the last one.
        """
        first_ns = self._time_ns(rows[0])
        self._now_ns = self._time_ns(rows[-1])
        message = fmt.encode_block(row0, rows, self._crc)
        self._mcap.add_message(fmt.TICKS_CHANNEL, self._now_ns, message, first_ns, self.blocks)
        self.flush()
        self.blocks += 1
        self.rows += len(rows)

    def write_event(self, number: int, event: Mapping[str, Any], time_ns: int | None = None) -> None:
        """Add event ``number``, stamped with the time of the last block; in the file after the next ``flush``."""
        time_ns = self._now_ns if time_ns is None else time_ns
        text = json.dumps(to_jsonable(event), ensure_ascii=False).encode()
        self._mcap.add_message(fmt.EVENTS_CHANNEL, time_ns, text, time_ns, number)
        self.events += 1

    def write_metadata(self, name: str, value: object) -> None:
        """Store one more text or JSON value."""
        self.flush()
        self._mcap.add_metadata(name, fmt.encode_metadata(name, value))
        self._metadata_names.append(name)
        self._output.keep()

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._mcap.flush()
        self._output.keep()

    def sync(self) -> None:
        """Wait until it is on the disk."""
        self._output.sync()

    def check(self) -> None:
        """Raise ``FileDisturbed`` when others have deleted, replaced, cut or written the file."""
        self._output.check()

    def finish(self, end: Mapping[str, Any]) -> int:
        """Write ``end`` (what the recording should hold, why it ended) and the index, and close.

        Returns the size of the file in bytes. Raises ``FileDisturbed`` as ``check`` does; then call ``abandon``.
        """
        self._output.check()  # before anything is written into what others have made
        self.write_metadata(fmt.END_METADATA, self._last_words(end))
        self._mcap.finish()
        self._output.keep()
        self._output.sync()
        self._output.check()
        self.moved = self._output.moved
        self._output.close()
        return self._output.good_end

    def abandon(self) -> None:
        """Close a disturbed file without touching it any more."""
        self._output.close()

    def give_up(self, event: tuple[int, Mapping[str, Any]], end: Mapping[str, Any]) -> int:
        """After an ``OSError``: cut off what was not finished, add a last event and ``end`` if they fit, close.

        The file has no index then; everything finished stays readable. Returns its size in bytes.
        """
        number, content = event
        last = fmt.encode_metadata(fmt.END_METADATA, self._last_words(end))
        text = json.dumps(to_jsonable(content), ensure_ascii=False).encode()
        try:
            self._output.back_to_good()
            for record in (
                _chunk_of(Message(fmt.EVENTS_CHANNEL, self._now_ns, text, self._now_ns, number)),
                Metadata(name=fmt.END_METADATA, metadata=last),
            ):
                # not through the writer: it has lost the part that could not be written
                self._output.write(_bytes_of(record))
                self._output.keep()
        except OSError:
            self._output.back_to_good()
        finally:
            self._output.close()
        return self._output.good_end

    def _last_words(self, end: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``end`` with the names of the texts added, so that a reader notices a lost one."""
        return {**end, "metadata": self._metadata_names}

    def _time_ns(self, row: Array) -> int:
        t_s = float(row[self._time_column]) if self._time_column is not None else math.nan
        return round(t_s * 1e9) if 0.0 <= t_s < 1e9 else self._now_ns


def _chunk_of(message: Message) -> Chunk:
    data = _bytes_of(message)
    return Chunk("", data, message.log_time, message.log_time, zlib.crc32(data), len(data))


def _bytes_of(record: Message | Chunk | Metadata) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
