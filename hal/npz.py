"""Reads .npz files of unknown origin: without pickle, and without an array that is larger than the file can hold.

A header of a few bytes may claim an array of any size, and a few kilobytes of zeros may unpack to gigabytes: both are
refused before anything is allocated.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

MOST_BYTES = 2 << 30
MOST_FREE_BYTES = 1 << 26
MOST_RATIO = 200
"""An archive may unpack to 64 MiB, and beyond that to 200 times its size: deflated zeros pack 1000 to 1."""
_PART_BYTES = 1 << 20
_BROKEN = (
    zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, KeyError, NotImplementedError, RuntimeError,
    SyntaxError, TokenError, TypeError, AttributeError, OverflowError, UnicodeError, RecursionError, MemoryError,
    ValueError,
)  # fmt: skip
"""Exceptions that the standard library and numpy raise for a damaged archive."""


class NpzError(ValueError):
    """The file is no .npz of plain arrays, or too large."""


class Npz:
    """``files`` are the arrays' names; ``npz[name]`` reads one."""

    def __init__(self, archive: zipfile.ZipFile, most_bytes: int) -> None:
        self._archive = archive
        self._left = most_bytes
        self._members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        self.files = list(self._members)

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            info = self._members[name]
        except KeyError:
            raise NpzError(f"it holds no array '{name}'; it has: {', '.join(self.files[:12]) or 'none'}") from None
        try:
            with self._archive.open(info) as file:
                shape, order, dtype = _header(file)
                need = dtype.itemsize * math.prod(shape)
                if dtype.hasobject:
                    raise NpzError(f"array '{name}' holds pickled objects; save plain numbers")
                if need > info.file_size:
                    raise NpzError(f"array '{name}' claims {need} bytes; the file holds {info.file_size}")
                if need > self._left:
                    raise NpzError(f"array '{name}' claims {need} bytes; of a file of this size {self._left} are read")
                self._left -= need
                array = np.empty(shape, dtype, order="F" if order else "C")
                _fill(file, array, name)
            return array
        except NpzError:
            raise
        except _BROKEN as error:
            raise NpzError(f"array '{name}' cannot be read: {error}") from error


def _fill(file: Any, array: NDArray[Any], name: str) -> None:
    """Read into the array, a part at a time: ``ZipExtFile.read`` of all would copy what it has for every part."""
    raw = array.reshape(-1, order="A").view(np.uint8).data if array.size else memoryview(b"")
    at = 0
    while at < len(raw):
        part = file.read(min(len(raw) - at, _PART_BYTES))
        if not part:
            raise NpzError(f"array '{name}' ends early")
        raw[at : at + len(part)] = part
        at += len(part)


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = npy.read_magic(file)
    if version == (1, 0):
        return npy.read_array_header_1_0(file)
    if version == (2, 0):
        return npy.read_array_header_2_0(file)
    raise NpzError(f"npy format {version} is not known here; save with numpy's default")


@contextmanager
def open_npz(path: Path, most_bytes: int = MOST_BYTES) -> Generator[Npz]:
    """Return the arrays of ``path``. Raises ``FileNotFoundError`` when it does not exist, ``NpzError`` for all else."""
    try:
        archive = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise
    except _BROKEN as error:
        raise NpzError(f"not a readable npz file ({error})") from error
    with archive:
        size = path.stat().st_size
        yield Npz(archive, min(most_bytes, MOST_FREE_BYTES + MOST_RATIO * size))
