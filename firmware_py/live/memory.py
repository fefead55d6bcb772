"""Shares memory between the loop and its readers: the newest rows, overwritten in turn, and the timing histograms.

Unlike with the recorder's ring, no reader has to keep up: the writer never looks at readers, and a reader that was too
slow detects it and reports how many rows it missed. Memory ordering is that of ``firmware_py.recording.ring`` (x86-64):
the row is stored before the head, so whoever sees the head sees the row; a reader looks at the head again after copying
and discards what may have been overwritten meanwhile.
"""

from __future__ import annotations

import mmap
import os
import struct
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_py.recording.ring import shared_file
from firmware_py.scheduler.histogram import Distribution, DurationHistogram

_HEADER_BYTES = 4096
_MAGIC_WORD, _SIZE, _WIDTH, _HEAD = 0, 1, 2, 8
_MAGIC = 0x4D4C_4956
_GUARD_ROWS = 8  # rows that the writer may be about to overwrite while a reader copies
HISTOGRAMS = 48
HISTOGRAM_WORDS = DurationHistogram.STATE_WORDS


class LiveRows(NamedTuple):
    """``values`` [n, columns], the newest last; ``first`` is the number of the first row since the start of the run,
    ``missed`` how many rows before it the reader was too slow for."""

    first: int
    values: NDArray[np.float64]
    missed: int


def put_over(words: Any, rows: NDArray[np.float64], row: NDArray[np.float64]) -> None:
    """Copy ``row`` over the oldest of ``rows``; ``announce`` follows. A compiled loop runs the same two functions, with
    a fence for the compiler between them."""
    rows[words[_HEAD] % len(rows)] = row


def announce(words: Any) -> None:
    """Let readers see the row that was put last."""
    words[_HEAD] += 1


class LiveMemory:
    """Holds both ends: one process uses ``push`` and ``put_histogram``, any number of others ``read`` and
    ``histogram``."""

    def __init__(self, fd: int) -> None:
        """Map the memory behind ``fd``, which then belongs to this object. ``ValueError`` when it is something else."""
        self.fd = fd
        self._map = mmap.mmap(fd, os.fstat(fd).st_size)
        self._words = memoryview(self._map)[:_HEADER_BYTES].cast("q")
        if self._words[_MAGIC_WORD] != _MAGIC:
            raise ValueError(f"file descriptor {fd} is not the live memory of a firmware")
        self.capacity, self.n_columns = self._words[_SIZE], self._words[_WIDTH]
        flat = np.frombuffer(self._map, dtype=np.float64, offset=_HEADER_BYTES, count=self.capacity * self.n_columns)
        self._rows = flat.reshape(self.capacity, self.n_columns)
        self._histograms = np.frombuffer(
            self._map, dtype=np.int64, offset=_HEADER_BYTES + flat.nbytes, count=HISTOGRAMS * HISTOGRAM_WORDS
        ).reshape(HISTOGRAMS, HISTOGRAM_WORDS)

    @classmethod
    def create(cls, n_columns: int, capacity: int = 8192) -> LiveMemory:
        """Create memory for ``capacity`` rows. Pass its ``fd`` on to the firmware."""
        if n_columns < 1 or capacity <= _GUARD_ROWS:
            raise ValueError(
                f"live memory needs columns and more than {_GUARD_ROWS} rows, not {capacity} x {n_columns}"
            )
        fd = shared_file(_HEADER_BYTES + 8 * capacity * n_columns + 8 * HISTOGRAMS * HISTOGRAM_WORDS)
        os.pwrite(fd, struct.pack("<qqq", _MAGIC, capacity, n_columns), 0)
        return cls(fd)

    # -- the loop's side ------------------------------------------------------------------------------------

    def push(self, row: NDArray[np.float64]) -> None:
        """Copy ``row[n_columns]`` in, over the oldest."""
        put_over(self._words, self._rows, row)
        announce(self._words)

    def view(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return header and rows for compiled code, which may push in place of ``push``, never beside it."""
        return np.frombuffer(self._words, np.int64), self._rows

    def put_histogram(self, index: int, histogram: DurationHistogram) -> None:
        """Copy the counts of a histogram to place ``index``."""
        histogram.copy_state_to(self._histograms[index])

    # -- a reader's side ------------------------------------------------------------------------------------

    @property
    def head(self) -> int:
        """Return the number of rows pushed so far."""
        return self._words[_HEAD]

    def read(self, since: int) -> LiveRows:
        """Return the rows from number ``since`` on, as far as they are still there."""
        head = self._words[_HEAD]
        first = max(since, head - self.capacity + _GUARD_ROWS, 0)
        numbers = np.arange(first, head)
        values = self._rows[numbers % self.capacity]
        oldest = self._words[_HEAD] - self.capacity + 1  # one more may be half written
        if oldest > first:
            values = values[oldest - first :]
            first = min(oldest, head)
        return LiveRows(first, values, max(0, first - since))

    def histogram(self, index: int) -> DurationHistogram:
        """Return a copy of the histogram at place ``index``. Its counts may be a few behind each other."""
        return DurationHistogram.from_state(self._histograms[index])

    def distribution(self, index: int) -> Distribution:
        return self.histogram(index).distribution()

    def close(self) -> None:
        """Unmap; the object is of no use afterwards."""
        del self._rows, self._histograms
        with suppress(BufferError):  # the traceback of what ended the run may still hold a compiled loop's view
            self._words.release()
            self._map.close()
        os.close(self.fd)
