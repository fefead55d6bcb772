"""Columns of MATLAB files: versions 4 to 7 by scipy, version 7.3 (an HDF5 file) by h5py (extra ``lab``).

Vectors are columns, a matrix is one column per shorter dimension (``name_1``), fields of structs are ``name.field``.
Sizes that a file claims are checked before anything is allocated.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.mismatch.recording import RecordingError

Array = NDArray[np.float64]
MOST_BYTES = 2 << 30
MOST_DEPTH = 8
MOST_ACROSS = 64
"""Columns of one matrix, at most: a larger one is no table."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_COMPRESSED = 15
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
    found = _hdf5(path) if is_hdf5 else _classic(path, head)
    return dict(found)


def _classic(path: Path, head: bytes) -> Iterator[tuple[str, Array]]:
    from scipy.io import loadmat

    if head.startswith(b"MATLAB 5.0"):
        _check_elements(path, head)
    elif path.stat().st_size > MOST_BYTES:
        raise RecordingError(f"{path}: larger than {MOST_BYTES >> 30} GiB; save fewer variables")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of duplicate and unreadable variables, which are not columns
            content = loadmat(path, struct_as_record=True, squeeze_me=False, verify_compressed_data_integrity=True)
    except Exception as error:  # scipy raises whatever its parser stumbles upon
        raise RecordingError(
            f"{path}: not a readable MATLAB file ({type(error).__name__}: {error}); export it again"
        ) from None
    for name, value in content.items():
        if not name.startswith("__"):
            yield from _flat(name, value, 0)


def _check_elements(path: Path, head: bytes) -> None:
    """Refuse a file whose last variable is cut off, or whose variables claim more than can be read."""
    order = "<" if head[126:128] == b"IM" else ">"
    size, at, total = path.stat().st_size, _HEADER_BYTES, 0
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
            if kind == _COMPRESSED:
                try:
                    inner = zlib.decompressobj().decompress(file.read(min(count, 4096)), 8)
                except zlib.error as error:
                    raise RecordingError(f"{path}: the variable at byte {at} is damaged ({error})") from None
                total += struct.unpack(f"{order}II", inner)[1] if len(inner) == 8 else 0
            total += count
            if total > MOST_BYTES:
                raise RecordingError(f"{path}: unpacks to more than {MOST_BYTES >> 30} GiB; save fewer variables")
            at += 8 + count


def _flat(name: str, value: Any, depth: int) -> Iterator[tuple[str, Array]]:
    """A variable of scipy as columns. Cells, texts and arrays of structs are none."""
    if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1 and depth < MOST_DEPTH:
        for field in value.dtype.names:
            yield from _flat(f"{name}.{field}", value.reshape(-1)[0][field], depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield from _columns(name, value)


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
    except Exception as error:  # h5py raises whatever its library stumbles upon
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
