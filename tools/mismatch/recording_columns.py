"""Reads columns of a data file of any format, by its ending. Sizes are bounded; errors name file and place."""

from __future__ import annotations

import itertools
import json
from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from mcap.records import Channel

from firmware_py.recording.errors import RecordingError as McapRecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.scan import ChunkMessage, mcap_records
from hal.arrays import Array
from hal.npz import open_npz
from tools.errors import RecordingError, missing_column
from tools.formats import mdf, netcdf, parquet
from tools.mismatch import mat_file, text_table

SUFFIXES = (*text_table.SUFFIXES, ".npz", ".mat", ".mcap", ".parquet", ".nc", ".mf4")
MAX_BYTES = 4 << 30
MAX_SAMPLES = 50_000_000
MAX_MESSAGE_BYTES = 1 << 24
MOST_ACROSS = 16
"""Largest number of columns of an array (n, k) in an .npz file; a wider one is no table."""
_NOT_JSON = (ValueError, RecursionError, OverflowError)


def read_columns(path: Path, names: list[str]) -> dict[str, Array]:
    """Return the named columns, float64 (n,). Raises RecordingError."""
    columns = _format(path).read(path, names)
    lengths = {k: v.size for k, v in columns.items()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{k} {v}" for k, v in lengths.items())
        raise RecordingError(f"{path}: columns differ in length ({sizes}); every column needs one value per sample")
    if max(lengths.values()) > MAX_SAMPLES:
        raise RecordingError(f"{path}: more than {MAX_SAMPLES} samples; cut the recording into parts")
    return columns


def read_blocks(path: Path, names: list[str]) -> Iterator[dict[str, Array]]:
    """Yield the named columns in parts, so that a text file may be larger than memory. Raises RecordingError."""
    if path.suffix.lower() not in text_table.SUFFIXES:
        yield read_columns(path, names)
        return
    _format(path)
    for block in text_table.text_table(path).blocks(names):
        yield {name: block[:, i] for i, name in enumerate(names)}


def column_names(path: Path) -> list[str]:
    """Return the names of the columns that ``read_columns`` can read from a data file. Raises RecordingError."""
    return _format(path).names(path)


def column_units(path: Path) -> dict[str, str]:
    """Return the units that the file itself gives its columns; none for most formats. Raises RecordingError."""
    units = _format(path).units
    return units(path) if units is not None else {}


def word_columns(path: Path) -> list[tuple[str, str]]:
    """Return the columns of a text file that hold words, each with its first word. Raises RecordingError."""
    return list(text_table.text_table(path).text) if path.suffix.lower() in text_table.SUFFIXES else []


def first_line(path: Path) -> int:
    """Return the line of the first sample of a text file; 0 for other files. Raises RecordingError."""
    return text_table.text_table(path).first if path.suffix.lower() in text_table.SUFFIXES else 0


@dataclass(frozen=True)
class _Format:
    """Lists and reads the columns of a kind of file, with their units where the format has any."""

    names: Callable[[Path], list[str]]
    read: Callable[[Path, list[str]], dict[str, Array]]
    units: Callable[[Path], dict[str, str]] | None = None


def _format(path: Path) -> _Format:
    if path.is_dir():
        raise RecordingError(f"{path}: this is a folder; name the data file in it")
    if not path.is_file():
        raise RecordingError(
            f"{path}: data file does not exist; check its name (a recording.toml names it relative to its own folder)"
        )
    if path.stat().st_size > MAX_BYTES:
        raise RecordingError(f"{path}: larger than {MAX_BYTES >> 30} GiB; cut the recording into parts")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RecordingError(f"{path}: data must be {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, not '{path.suffix}'")
    if suffix in text_table.SUFFIXES:
        return _Format(_text_names, lambda p, names: text_table.text_table(p).read(names), _text_units)
    return {
        ".npz": _Format(_npz_names, _npz),
        ".mat": _Format(_mat_names, _mat),
        ".mcap": _Format(_mcap_names, _mcap, _mcap_units),
        ".parquet": _Format(parquet.names, parquet.read, parquet.units),
        ".nc": _Format(netcdf.names, netcdf.read, netcdf.units),
        ".mf4": _Format(mdf.names, mdf.read, mdf.units),
    }[suffix]


def _text_names(path: Path) -> list[str]:
    return text_table.text_table(path).columns


def _text_units(path: Path) -> dict[str, str]:
    table = text_table.text_table(path)
    return {name: unit for name, unit in zip(table.names, table.units, strict=True) if unit}


def _npz_columns(path: Path, names: list[str] | None = None) -> tuple[dict[str, Array], dict[str, str]]:
    """Return columns of numbers by name (those of ``names``, or all), and the form of every array that is none.

    An array (n, k) of at most ``MOST_ACROSS`` columns is the columns ``name_0``, ``name_1`` and so on.
    """
    columns: dict[str, Array] = {}
    others: dict[str, str] = {}
    try:
        with open_npz(path) as data:
            for name in data.files:
                if names is not None and name not in names and not any(n.startswith(f"{name}_") for n in names):
                    others[name] = "not read"
                    continue
                a = data[name]
                if a.dtype.kind in "fiub" and a.ndim == 1:
                    columns[name] = np.asarray(a, np.float64)
                elif a.dtype.kind in "fiub" and a.ndim == 2 and a.shape[1] <= MOST_ACROSS:
                    columns |= {f"{name}_{i}": a[:, i].astype(np.float64) for i in range(a.shape[1])}
                else:
                    others[name] = f"{a.dtype} of shape {a.shape}"
    except RecordingError:
        raise
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}; write it again with numpy.savez, as plain numbers") from None
    return columns, others


def _npz_names(path: Path) -> list[str]:
    columns, _ = _npz_columns(path)
    longest = max((v.size for v in columns.values()), default=0)
    return [name for name, values in columns.items() if values.size == longest]


def _npz(path: Path, names: list[str]) -> dict[str, Array]:
    columns, others = _npz_columns(path, names)
    for name in names:
        if name not in columns:
            if others.get(name, "not read") != "not read":
                raise RecordingError(f"{path}: column '{name}' is {others[name]}; needed: numbers, one dimension")
            raise missing_column(path, name, [*columns, *others])
    return {name: columns[name] for name in names}


def _mat_names(path: Path) -> list[str]:
    columns = mat_file.read_mat(path)
    longest = max((v.size for v in columns.values()), default=0)
    return [name for name, values in columns.items() if values.size == longest]


def _mat(path: Path, names: list[str]) -> dict[str, Array]:
    columns = mat_file.read_mat(path)
    for name in names:
        if name not in columns:
            raise missing_column(path, name, list(columns))
    return {name: columns[name] for name in names}


def read_scalars(path: Path) -> dict[str, float]:
    """Return the single numbers that a file holds beside its columns, such as a rate. Raises RecordingError."""
    suffix = path.suffix.lower()
    if suffix == ".mat":
        return {k: float(v[0]) for k, v in mat_file.read_mat(path).items() if v.size == 1}
    if suffix != ".npz":
        return {}
    try:
        with open_npz(path) as data:
            return {
                k: float(a.reshape(-1)[0]) for k in data.files if (a := data[k]).size == 1 and a.dtype.kind in "fiu"
            }
    except RecordingError:
        raise
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}; write it again with numpy.savez") from None


def own_recording(path: Path) -> Recording | None:
    """Return the recording at ``path`` if ``micron run`` made it, else None."""
    if path.suffix.lower() != ".mcap":
        return None
    try:
        return _opened(path, path.stat().st_mtime_ns)
    except (McapRecordingError, OSError):
        return None


@lru_cache(maxsize=1)
def _opened(path: Path, _changed_ns: int) -> Recording:
    return Recording(path)


def _mcap_units(path: Path) -> dict[str, str]:
    own = own_recording(path)
    return {} if own is None else {column.name: column.unit for column in own.columns}


def _mcap_names(path: Path) -> list[str]:
    own = own_recording(path)
    if own is not None:
        return list(own.names)
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
    """Yield topic, encoding and message, in the order of the file. Raises RecordingError.

    ``mcap``'s own readers trust the size that a chunk claims; this one does not (``firmware_py.recording.unpack``).
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


def _mcap(path: Path, names: list[str]) -> dict[str, Array]:
    """Read columns of a recording of ours, or JSON messages of another program in order of their log time.

    A column of JSON messages is ``topic.field`` (``topic.field.0`` for list elements), or ``topic.log_time_s``.
    """
    own = own_recording(path)
    if own is not None:
        for name in names:
            if name not in own.names:
                raise missing_column(path, name, own.names)
        return dict(zip(names, np.ascontiguousarray(own.array(names).T), strict=True))
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
            raise missing_column(path, name, sorted(seen))
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
