"""Provides shared-memory rings from one producer process to one consumer process. The producer never waits.

Both processes map an anonymous file (memfd). It has no name, so nothing is left behind however the
processes end, and what was pushed survives the death of the producer.

Ordering: one writer and one reader, and every shared counter is an aligned 8 byte word written by one side only,
with a single store. x86-64 (TSO) keeps stores in order, loads in order, and never moves a store before an earlier
load; so the consumer that sees the new head sees the row, and the producer that sees the new tail may overwrite the
slot. Only a store may pass a later load, which at worst makes one side see less than there is. A machine with weaker
ordering (ARM) would need a release store of head and tail; ``create`` refuses it.
"""

from __future__ import annotations

import mmap
import os
import platform
import struct
import tempfile
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from firmware_py.recording.errors import RecordingError
from hal.arrays import Array, IntArray

_HEADER_BYTES = 4096
# words of the header; each side's words on a cache line of its own
_MAGIC, _SIZE, _WIDTH = 0, 1, 2
_HEAD, _DROPPED, _EVENTS = 8, 9, 10  # written by the producer
_TAIL, _WRITTEN, _STATE = 16, 17, 18  # written by the consumer
_ROWS_MAGIC, _BYTES_MAGIC = 0x4D52_4F57, 0x4D42_5954


def shared_file(size: int) -> int:
    """An anonymous file of ``size`` bytes that other processes can map.

    ``RecordingError`` on a weakly ordered machine.
    """
    machine = platform.machine()
    if machine not in ("x86_64", "AMD64"):
        raise RecordingError(f"the recording ring relies on the memory ordering of x86-64; this machine is {machine}")
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("micron-ring", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd


class _Shared:
    """The mapped memory and its header words."""

    def __init__(self, fd: int, magic: int) -> None:
        self.fd = fd
        self._map = mmap.mmap(fd, os.fstat(fd).st_size)
        self.words = memoryview(self._map)[:_HEADER_BYTES].cast("q")
        if self.words[_MAGIC] != magic:
            raise RecordingError(f"file descriptor {fd} is not a recording ring of this kind")

    @staticmethod
    def create(data_bytes: int, magic: int, size: int, width: int) -> int:
        fd = shared_file(_HEADER_BYTES + data_bytes)
        os.pwrite(fd, struct.pack("<qqq", magic, size, width), 0)
        return fd

    def data(self) -> memoryview:
        return memoryview(self._map)[_HEADER_BYTES:]

    def close(self) -> None:
        with suppress(BufferError):  # the traceback of what ended the run may still hold a compiled loop's view
            self.words.release()
            self._map.close()
        os.close(self.fd)


class RowsView(NamedTuple):
    """Holds a ring's memory for ``put_row``: ``words`` [header], ``numbers`` [capacity], ``rows`` [capacity, n]."""

    words: Any
    numbers: IntArray
    rows: Array


def put_row(view: RowsView, row: Array) -> bool:
    """Copy ``row`` to the next free slot; ``announce_row`` follows. Return False, and count it, when the ring is full.

    A compiled loop runs the same two functions, with a fence for the compiler between them: a row must be there before
    the head says so.
    """
    words = view.words
    head, capacity = words[_HEAD], len(view.numbers)
    if head - words[_TAIL] >= capacity:
        words[_DROPPED] += 1
        return False
    slot = head % capacity
    view.rows[slot] = row
    view.numbers[slot] = head + words[_DROPPED]
    return True


def announce_row(words: Any) -> None:
    """Let the consumer see the row that was put last."""
    words[_HEAD] += 1


class RowRing:
    """Rows of float64 from one producer to one consumer.

    Every row carries its number: how many pushes came before it, refused ones included. So the consumer knows exactly
    which rows are missing. One process uses ``push``, one other ``pop``.
    """

    def __init__(self, fd: int) -> None:
        """Attach to the ring behind ``fd``, which then belongs to this object."""
        self._shared = _Shared(fd, _ROWS_MAGIC)
        self._words = self._shared.words
        self.capacity, self.n_columns = self._words[_SIZE], self._words[_WIDTH]
        slots = np.frombuffer(self._shared.data(), dtype=np.float64).reshape(self.capacity, 1 + self.n_columns)
        self._numbers: IntArray = slots.view(np.int64)[:, 0]
        self._rows: Array = slots[:, 1:]
        self._own = RowsView(self._words, self._numbers, self._rows)

    @classmethod
    def create(cls, n_columns: int, capacity: int) -> RowRing:
        """A new ring of ``capacity`` rows; pass ``fd`` on to the consumer."""
        if n_columns < 1 or capacity < 1:
            raise RecordingError(f"a ring needs rows and columns, not {capacity} x {n_columns}")
        return cls(_Shared.create(8 * capacity * (1 + n_columns), _ROWS_MAGIC, capacity, n_columns))

    @property
    def fd(self) -> int:
        return self._shared.fd

    def push(self, row: Array) -> bool:
        """Copy ``row[n_columns]`` in; False (and counted) when the ring is full. Never waits."""
        if not put_row(self._own, row):
            return False
        announce_row(self._words)
        return True

    def view(self) -> RowsView:
        """Return the same memory for compiled code, which may push in place of ``push``, never beside it."""
        return RowsView(np.frombuffer(self._words, np.int64), self._numbers, self._rows)

    def full(self) -> bool:
        """Return True if the next ``push`` would be refused."""
        return self._words[_HEAD] - self._words[_TAIL] >= self.capacity

    def pop(self, max_rows: int) -> tuple[IntArray, Array]:
        """Take up to ``max_rows`` of the oldest rows: their numbers ``[n]`` and values ``[n, n_columns]``."""
        tail = self._words[_TAIL]
        slot = tail % self.capacity
        n = min(max_rows, self._words[_HEAD] - tail, self.capacity - slot)
        numbers = self._numbers[slot : slot + n].copy()
        rows = self._rows[slot : slot + n].copy()
        self._words[_TAIL] = tail + n
        return numbers, rows

    def waiting(self) -> int:
        """Return the number of rows pushed and not yet taken."""
        return self._words[_HEAD] - self._words[_TAIL]

    @property
    def pushed(self) -> int:
        """Return the number of rows offered, refused ones included."""
        return self._words[_HEAD] + self._words[_DROPPED]

    @property
    def dropped(self) -> int:
        """Return the number of rows refused because the ring was full."""
        return self._words[_DROPPED]

    def report(self, written: int, state: int) -> None:
        """Report, as the consumer, how many rows are in the file, and its state."""
        self._words[_WRITTEN] = written
        self._words[_STATE] = state

    @property
    def written(self) -> int:
        """Return the number of rows that the consumer says are in the file."""
        return self._words[_WRITTEN]

    @property
    def state(self) -> int:
        """Return the state that the consumer reported last."""
        return self._words[_STATE]

    def close(self) -> None:
        """Unmap; the object is of no use afterwards."""
        del self._numbers, self._rows, self._own
        self._words = memoryview(b"").cast("q")
        self._shared.close()


class EventRing:
    """Byte strings of any length up to the ring's, numbered like the rows of a ``RowRing``."""

    _PREFIX = struct.Struct("<Iq")  # length, number

    def __init__(self, fd: int) -> None:
        """Attach to the ring behind ``fd``, which then belongs to this object."""
        self._shared = _Shared(fd, _BYTES_MAGIC)
        self._words = self._shared.words
        self.capacity = self._words[_SIZE]
        self._data = self._shared.data()

    @classmethod
    def create(cls, capacity_bytes: int) -> EventRing:
        """A new ring of ``capacity_bytes``."""
        return cls(_Shared.create(capacity_bytes, _BYTES_MAGIC, capacity_bytes, 1))

    @property
    def fd(self) -> int:
        return self._shared.fd

    def push(self, event: bytes) -> bool:
        """Copy ``event`` in; False (and counted) when it does not fit now. Never waits."""
        head = self._words[_HEAD]
        if head - self._words[_TAIL] + self._PREFIX.size + len(event) > self.capacity:
            self._words[_DROPPED] += 1
            return False
        number = self._words[_EVENTS] + self._words[_DROPPED]
        self._put(head, self._PREFIX.pack(len(event), number) + event)
        self._words[_EVENTS] += 1
        self._words[_HEAD] = head + self._PREFIX.size + len(event)
        return True

    def pop(self) -> tuple[int, bytes] | None:
        """Return the oldest event and its number, or None when there is none."""
        tail = self._words[_TAIL]
        if self._words[_HEAD] == tail:
            return None
        length, number = self._PREFIX.unpack(self._get(tail, self._PREFIX.size))
        event = self._get(tail + self._PREFIX.size, length)
        self._words[_TAIL] = tail + self._PREFIX.size + length
        return number, event

    def _put(self, at: int, data: bytes) -> None:
        start = at % self.capacity
        first = min(len(data), self.capacity - start)
        self._data[start : start + first] = data[:first]
        self._data[: len(data) - first] = data[first:]

    def _get(self, at: int, n: int) -> bytes:
        start = at % self.capacity
        first = min(n, self.capacity - start)
        return bytes(self._data[start : start + first]) + bytes(self._data[: n - first])

    @property
    def pushed(self) -> int:
        """Return the number of events offered, refused ones included."""
        return self._words[_EVENTS] + self._words[_DROPPED]

    @property
    def dropped(self) -> int:
        """Return the number of events refused because the ring was full."""
        return self._words[_DROPPED]

    def close(self) -> None:
        """Unmap; the object is of no use afterwards."""
        self._data.release()
        self._words = memoryview(b"").cast("q")
        self._shared.close()
