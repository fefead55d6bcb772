"""Reads columns of MATLAB files: versions 4 to 7, and version 7.3 (an HDF5 file) by h5py (extra ``lab``).

Vectors are columns, a matrix is one column per shorter dimension (``name_1``), fields of structs are ``name.field``.
Sizes that a file claims are checked before anything is allocated.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.errors import RecordingError

MOST_BYTES = 2 << 30
MOST_DEPTH = 8
MOST_ACROSS = 64
"""Largest number of columns of a matrix; a larger one is no table."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MATRIX, _COMPRESSED = 14, 15
_STRUCT = 2
_NUMBERS = range(6, 16)
_COMPLEX = 0x0800
_TYPES = MappingProxyType({1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"})
"""Types of a part of a matrix (MAT-File Level 5, table of data types) as numpy writes them."""
_TYPES_LAST = 9
_HEADER_BYTES = 128


def read_mat(path: Path) -> dict[str, Array]:
    """Return every column of numbers, float64 (n,); a single number has n = 1. Raises RecordingError."""
    try:
        with path.open("rb") as file:
            head = file.read(520)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    if not head:
        raise RecordingError(f"{path}: is empty; export the data again")
    is_hdf5 = head.startswith(_HDF5) or head[512:].startswith(_HDF5)
    if not is_hdf5 and head.startswith(b"MATLAB 7.3"):
        raise RecordingError(f"{path}: torn: a MATLAB 7.3 file without its HDF5 part; copy or export it again")
    if is_hdf5:
        return dict(_hdf5(path))
    return dict(_version_5(path, head) if head.startswith(b"MATLAB 5.0") else _version_4(path))


def _version_4(path: Path) -> Iterator[tuple[str, Array]]:
    from scipy.io import loadmat

    if path.stat().st_size > MOST_BYTES:
        raise RecordingError(f"{path}: larger than {MOST_BYTES >> 30} GiB; save fewer variables")
    try:
        content = loadmat(path)
    except Exception as error:  # scipy's parser may raise any exception
        raise RecordingError(
            f"{path}: not a readable MATLAB file ({type(error).__name__}: {error}); export it again"
        ) from None
    for name, value in content.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            yield from _columns(name, value)


def _version_5(path: Path, head: bytes) -> Iterator[tuple[str, Array]]:
    """Read versions 5 to 7 without scipy, whose compiled reader ends the process where a type is damaged."""
    order = "<" if head[126:128] == b"IM" else ">"
    size, at, left = path.stat().st_size, _HEADER_BYTES, MOST_BYTES
    if size < _HEADER_BYTES:
        raise RecordingError(f"{path}: torn: {size} bytes, the header alone has {_HEADER_BYTES}; export it again")
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            tag = file.read(8)
            kind, count = struct.unpack(f"{order}II", tag) if len(tag) == 8 else (0, size)
            if at + 8 + count > size:
                raise RecordingError(
                    f"{path}: torn: the variable at byte {at} should have {count} bytes, {size - at - len(tag)} are"
                    " left; copy or export the file again"
                )
            try:
                body = file.read(count)
                if kind == _COMPRESSED:
                    body = _unpacked(body, order, left)
                left -= len(body)
                if left < 0:
                    raise _TooLargeError
                if kind in (_MATRIX, _COMPRESSED):
                    yield from _matrix(body, order, "", 0)
            except _TooLargeError:
                raise RecordingError(
                    f"{path}: unpacks to more than {MOST_BYTES >> 30} GiB; save fewer variables"
                ) from None
            except (zlib.error, struct.error, ValueError, LookupError, OverflowError, MemoryError) as error:
                raise RecordingError(
                    f"{path}: the variable at byte {at} is damaged ({error}); export the file again"
                ) from None
            at += 8 + count


class _TooLargeError(Exception):
    """Says that a file holds more than may be unpacked."""


def _unpacked(body: bytes, order: str, most: int) -> bytes:
    """Return the content of the matrix in a compressed element."""
    stream = zlib.decompressobj()
    tag = stream.decompress(body, 8)
    kind, count = struct.unpack(f"{order}II", tag)
    if count > most:
        raise _TooLargeError
    if kind != _MATRIX:
        return b""
    content = stream.decompress(stream.unconsumed_tail, count) if count else b""
    if len(content) < count:
        raise ValueError(f"{len(content)} of {count} bytes")
    return content


def _elements(body: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield (type, data) of each part of a matrix."""
    at = 0
    while at + 8 <= len(body):
        first, count = struct.unpack_from(f"{order}II", body, at)
        if first >> 16:  # the tag itself holds up to four bytes
            kind, count, begin, after = first & 0xFFFF, first >> 16, at + 4, at + 8
            if count > 4:
                raise ValueError(f"a part of {count} bytes in its tag")
        else:
            kind, begin, after = first, at + 8, at + 8 + -(-count // 8) * 8
        if begin + count > len(body):
            raise ValueError(f"a part of {count} bytes in {len(body)}")
        yield kind, body[begin : begin + count]
        at = after


def _matrix(body: bytes, order: str, name: str, depth: int) -> Iterator[tuple[str, Array]]:
    """Return a variable as columns: numbers, and the fields of a single struct, but no cells, texts or complex ones."""
    parts = _elements(body, order)
    _, flags = next(parts, (0, b""))
    if not flags:
        return
    (word,) = struct.unpack_from(f"{order}I", flags)
    shape = np.frombuffer(next(parts, (0, b""))[1], f"{order}i4")
    own = next(parts, (0, b""))[1].decode("latin-1")
    name, kind = name or own, word & 0xFF
    if kind in _NUMBERS and not word & _COMPLEX:
        code, raw = next(parts, (_TYPES_LAST, b""))
        values = np.frombuffer(raw, f"{order}{_TYPES[code]}")
        if shape.size < 2 or (shape < 0).any() or math.prod(map(int, shape)) != values.size:
            raise ValueError(f"'{name}' has {values.size} values for a shape of {shape.tolist()}")
        yield from _columns(name, values.reshape(shape, order="F"))
    elif kind == _STRUCT and math.prod(map(int, shape)) == 1 and depth < MOST_DEPTH:
        (length,) = struct.unpack_from(f"{order}i", next(parts, (0, b""))[1])
        words = next(parts, (0, b""))[1]
        if length <= 0:
            raise ValueError(f"names of {length} bytes")
        for begin in range(0, len(words), length):
            field = words[begin : begin + length].split(b"\0")[0].decode("latin-1")
            code, inner = next(parts, (0, b""))
            if code == _MATRIX:
                yield from _matrix(inner, order, f"{name}.{field}", depth + 1)


def _columns(name: str, value: NDArray[Any]) -> Iterator[tuple[str, Array]]:
    value = np.asarray(value, np.float64)
    if value.size == 0:
        return
    if value.size == max(value.shape, default=1):
        yield name, value.reshape(-1)
    elif value.ndim == 2 and min(value.shape) <= MOST_ACROSS:
        table = value if value.shape[0] >= value.shape[1] else value.T
        for i in range(table.shape[1]):
            yield f"{name}_{i + 1}", np.ascontiguousarray(table[:, i])


def _hdf5(path: Path) -> Iterator[tuple[str, Array]]:
    try:
        import h5py
    except ImportError:
        raise RecordingError(
            f"{path}: a MATLAB 7.3 file needs h5py: pip install 'micron-bench[lab]'; or save it with -v7"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            left = [MOST_BYTES]
            yield from _group(file, "", 0, left)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    except Exception as error:  # h5py may raise any exception
        if "truncated" in str(error):
            raise RecordingError(f"{path}: torn ({error}); copy or export the file again") from None
        raise RecordingError(f"{path}: not a readable MATLAB 7.3 file ({error}); export it again") from None


def _group(group: Mapping[str, Any], prefix: str, depth: int, left: list[int]) -> Iterator[tuple[str, Array]]:
    for name, item in group.items():
        if name.startswith("#"):
            continue
        if isinstance(item, Mapping):
            if depth < MOST_DEPTH:
                yield from _group(item, f"{prefix}{name}.", depth + 1, left)
        elif item.attrs.get("MATLAB_class", b"") not in (b"char", b"cell") and not item.attrs.get("MATLAB_empty", 0):
            if item.dtype.kind not in "fiub":
                continue
            left[0] -= item.size * 8
            if left[0] < 0:
                raise RecordingError(f"unpacks to more than {MOST_BYTES >> 30} GiB; save fewer variables")
            yield from _columns(f"{prefix}{name}", item[()])
