"""Reading .npz files that somebody else wrote: no pickle, and no array that is larger than the file can hold.

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
_BROKEN = (
    zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, KeyError, NotImplementedError, RuntimeError,
    SyntaxError, TokenError, TypeError, AttributeError, OverflowError, UnicodeError, RecursionError, MemoryError,
    ValueError,
)  # fmt: skip
"""All that the standard library and numpy raise for a damaged archive."""


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
                if need > info.file_size or need > self._left:
                    raise NpzError(f"array '{name}' claims {need} bytes; the file holds {info.file_size}")
                self._left -= need
                data = file.read(need)
                if len(data) != need:
                    raise NpzError(f"array '{name}' ends early")
            return np.frombuffer(data, dtype).reshape(shape, order="F" if order else "C").copy()
        except NpzError:
            raise
        except _BROKEN as error:
            raise NpzError(f"array '{name}' cannot be read: {error}") from error


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = npy.read_magic(file)
    if version == (1, 0):
        return npy.read_array_header_1_0(file)
    if version == (2, 0):
        return npy.read_array_header_2_0(file)
    raise NpzError(f"npy format {version} is not known here; save with numpy's default")


@contextmanager
def open_npz(path: Path, most_bytes: int = MOST_BYTES) -> Generator[Npz]:
    """The arrays of ``path``. Raises ``FileNotFoundError`` when it is not there, ``NpzError`` for all else."""
    try:
        archive = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise
    except _BROKEN as error:
        raise NpzError(f"not a readable npz file ({error})") from error
    with archive:
        yield Npz(archive, most_bytes)
