"""Columns of a data file: csv, npz, mcap. Sizes are bounded; every fault names the file and the line or sample."""

from __future__ import annotations

import csv
import itertools
import json
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from firmware_py.recording.errors import RecordingError as McapRecordingError
from firmware_py.recording.scan import ChunkMessage, mcap_records
from hal.npz import open_npz
from tools.mismatch.recording import RecordingError

Array = NDArray[np.float64]
MAX_BYTES = 4 << 30
MAX_SAMPLES = 50_000_000
MAX_MESSAGE_BYTES = 1 << 24
_NOT_JSON = (ValueError, RecursionError, OverflowError)


def read_columns(path: Path, names: list[str]) -> dict[str, Array]:
    """The named columns as float64 (n,). Raises RecordingError."""
    if not path.is_file():
        raise RecordingError(f"{path}: data file does not exist; 'data' in the descriptor is relative to its folder")
    if path.stat().st_size > MAX_BYTES:
        raise RecordingError(f"{path}: larger than {MAX_BYTES >> 30} GiB; cut the recording into parts")
    readers = {".csv": _csv, ".npz": _npz, ".mcap": _mcap}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: data must be .csv, .npz or .mcap, not '{path.suffix}'")
    columns = reader(path, names)
    lengths = {k: v.size for k, v in columns.items()}
    if len(set(lengths.values())) > 1:
        shown = ", ".join(f"{k} {v}" for k, v in lengths.items())
        raise RecordingError(f"{path}: columns differ in length ({shown}); every column needs one value per sample")
    if max(lengths.values()) > MAX_SAMPLES:
        raise RecordingError(f"{path}: more than {MAX_SAMPLES} samples; cut the recording into parts")
    return columns


def column_names(path: Path) -> list[str]:
    """The columns that ``read_columns`` could read from a data file. Raises RecordingError."""
    if not path.is_file():
        raise RecordingError(f"{path}: data file does not exist")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        try:
            with path.open(newline="", encoding="utf-8-sig") as f:
                head = f.readline()
        except UnicodeDecodeError as error:
            raise RecordingError(f"{path}: not a UTF-8 text file ({error.reason}); save it as UTF-8 csv") from None
        delimiter = next((d for d in ",;\t" if d in head), ",")
        return [h.strip() for h in next(csv.reader([head], delimiter=delimiter), [])]
    if suffix == ".mcap":
        return _mcap_names(path)
    raise RecordingError(f"{path}: data must be .csv, .npz or .mcap, not '{path.suffix}'")


def _mcap_names(path: Path) -> list[str]:
    names: dict[str, None] = {}
    for topic, encoding, message in itertools.islice(_messages(path), 1000):
        if encoding == "json":
            try:
                names.update(dict.fromkeys(_flatten(json.loads(bytes(message.data)), topic)))
            except _NOT_JSON as error:
                raise RecordingError(f"{path}: a message of '{topic}' is not JSON ({error})") from None
            names[f"{topic}.log_time_s"] = None
    return list(names)


def _messages(path: Path) -> Iterator[tuple[str, str, ChunkMessage]]:
    """Topic, encoding and message, in the order of the file. Raises RecordingError.

    ``mcap``'s own readers unpack whatever a chunk claims; here no size is believed (``firmware_py.recording.unpack``).
    """
    channels: dict[int, tuple[str, str]] = {}
    try:
        with path.open("rb") as file:
            for record in mcap_records(file):
                if isinstance(record, Channel):
                    channels[record.id] = (record.topic, record.message_encoding)
                elif isinstance(record, ChunkMessage):
                    if record.channel_id not in channels:
                        raise RecordingError(
                            f"{path}: a message of channel {record.channel_id}, which is not described"
                        )
                    if len(record.data) > MAX_MESSAGE_BYTES:
                        raise RecordingError(
                            f"{path}: a message of {len(record.data)} bytes; at most {MAX_MESSAGE_BYTES}"
                        )
                    yield (*channels[record.channel_id], record)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    except McapRecordingError as error:
        raise RecordingError(f"{path}: not a readable mcap file ({error})") from None


def _missing(path: Path, name: str, have: list[str]) -> RecordingError:
    shown = ", ".join(have[:12]) + (" ..." if len(have) > 12 else "")
    return RecordingError(f"{path}: no column '{name}'; the file has: {shown or 'none'}")


def _csv(path: Path, names: list[str]) -> dict[str, Array]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as f:
            head = f.readline()
            delimiter = next((d for d in ",;\t" if d in head), ",")
            header = [h.strip() for h in next(csv.reader([head], delimiter=delimiter), [])]
            for name in names:
                if name not in header:
                    raise _missing(path, name, header)
                if header.count(name) > 1:
                    raise RecordingError(f"{path}: line 1: column '{name}' appears twice; rename one")
            use = [header.index(n) for n in names]
            if not (first := next((line for line in f if line.strip()), "")):
                raise RecordingError(f"{path}: a header and no samples")
            try:
                data = np.loadtxt(
                    itertools.chain([first], f),
                    delimiter=delimiter,
                    usecols=use,
                    ndmin=2,
                    comments=None,
                    quotechar='"',
                    dtype=np.float64,
                )
            except ValueError as error:
                raise RecordingError(f"{path}: {_first_bad_line(path, delimiter, header, use) or error}") from None
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a UTF-8 text file ({error.reason}); save it as UTF-8 csv") from None
    return {n: np.ascontiguousarray(data[:, i]) for i, n in enumerate(names)}


def _first_bad_line(path: Path, delimiter: str, header: list[str], use: list[int]) -> str:
    with path.open(newline="", encoding="utf-8-sig") as f:
        rows = csv.reader(f, delimiter=delimiter)
        next(rows, None)
        for row in rows:
            if not row:
                continue
            if len(row) <= max(use):
                return f"line {rows.line_num}: {len(row)} values, the header names {len(header)}; complete the line"
            for i in use:
                try:
                    float(row[i])
                except ValueError:
                    return f"line {rows.line_num}: column '{header[i]}': '{row[i]}' is not a number"
    return ""


def _npz(path: Path, names: list[str]) -> dict[str, Array]:
    try:
        with open_npz(path) as data:
            have = list(data.files)
            out: dict[str, Array] = {}
            for name in names:
                if name not in have:
                    raise _missing(path, name, have)
                a = data[name]
                if a.ndim != 1 or a.dtype.kind not in "fiub":
                    raise RecordingError(
                        f"{path}: column '{name}' is {a.dtype} of shape {a.shape}; needed: numbers, one dimension"
                    )
                out[name] = np.asarray(a, np.float64)
    except OSError as error:
        raise RecordingError(f"{path}: not a readable npz file ({error})") from None
    except ValueError as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{path}: {error}; save plain numeric arrays (no pickled objects)") from None
    return out


def _mcap(path: Path, names: list[str]) -> dict[str, Array]:
    """JSON messages in order of their log time; a column is ``topic.field`` (``topic.field.0`` for list elements), or
    ``topic.log_time_s``."""
    wanted = {n: n.rsplit(".", 1)[0] for n in names}
    found: dict[str, array[float]] = {n: array("d") for n in names}
    times: dict[str, array[int]] = {n: array("Q") for n in names}
    seen: set[str] = set()
    for number, (topic, encoding, message) in enumerate(_messages(path), start=1):
        if encoding != "json":
            seen.add(f"{topic} ({encoding})")
            continue
        try:
            flat = _flatten(json.loads(bytes(message.data)), topic)
        except _NOT_JSON as error:
            raise RecordingError(f"{path}: message {number}: not JSON ({error})") from None
        flat[f"{topic}.log_time_s"] = message.log_time * 1e-9
        if len(seen) < 10_000:
            seen.update(flat)
        for n, owner in wanted.items():
            if n in flat:
                found[n].append(flat[n])
                times[n].append(message.log_time)
            elif owner == topic:
                raise RecordingError(f"{path}: message {number} of '{topic}' lacks '{n}'")
    columns: dict[str, Array] = {}
    for name, values in found.items():
        if not values:
            raise _missing(path, name, sorted(seen))
        columns[name] = np.array(values)[np.argsort(np.array(times[name]), kind="stable")]
    return columns


def _flatten(value: object, prefix: str) -> dict[str, float]:
    if isinstance(value, bool | int | float):
        return {prefix: float(value)}
    out: dict[str, float] = {}
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        out.update(_flatten(item, f"{prefix}.{key}"))
    return out
