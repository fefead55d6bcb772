"""Runs the recorder process, which empties the rings into the file. ``recorder.RecorderProcess`` starts it.

A block is closed after 100 rows, at a gap in the row numbers, or 0.12 s after its first row; so when the recorder
itself is killed, less than 0.2 s of rows are lost. When the firmware dies, what it pushed is still in the rings and
is written. ``fdatasync`` once per second bounds what a power failure takes; with it the recorder looks whether its file
is still there and as long as what it wrote, and ends with a clear word when another program has changed it.

Standard input: one JSON line with the path, columns and metadata, later one with ``stop``; its end without ``stop``
means that the firmware is gone. Standard output: one JSON line when ready, one at the end.
"""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import sys
import time
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.exit_codes import Exit
from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.ring import EventRing, RowRing
from firmware_py.recording.writer import FileDisturbed, RecordingWriter

POLL_S = 0.02
OPEN_BLOCK_S = 0.12
SYNC_S = 1.0
_RESERVE_BYTES = 64 * 1024  # room for the last words on a full disk
_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)


class RecorderState(IntEnum):
    """Names the state that the recorder reports in the row ring."""

    STARTING = 0
    RECORDING = 1
    DISK_FULL = 2
    FAILED = 3
    DONE = 4
    DISTURBED = 5


class _Control:
    """Receives lines from the firmware on standard input, the end of that input, and SIGTERM."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._pending = b""
        self.closed = False
        self.terminated = False
        signal.signal(signal.SIGTERM, self._on_terminate)

    def _on_terminate(self, _number: int, _frame: object) -> None:
        self.terminated = True

    def wait(self, timeout_s: float) -> dict[str, Any] | None:
        """Return the next line if one arrives within ``timeout_s``."""
        if b"\n" not in self._pending and not self.closed and readable(self._fd, timeout_s):
            data = os.read(self._fd, 1 << 16)
            self.closed = not data
            self._pending += data
        line, newline, rest = self._pending.partition(b"\n")
        if not newline:
            return None
        self._pending = rest
        return json.loads(line)

    def wait_line(self) -> dict[str, Any] | None:
        """Return the next line, however long it takes, or None when there will be none."""
        while not self.closed:
            line = self.wait(1.0)
            if line is not None:
                return line
        return None


class Drain:
    """Moves rows and events from the rings to a writer."""

    def __init__(self, rows: RowRing, events: EventRing, writer: RecordingWriter) -> None:
        self._rows = rows
        self._events = events
        self._writer = writer
        self._buffer = np.empty((fmt.BLOCK_ROWS, rows.n_columns))
        self._filled = 0
        self._row0 = 0
        self._opened_s = 0.0
        self._event_since_s: float | None = None

    def step(self, now_s: float) -> int:
        """Take what is there; write blocks that are due. Returns how many rows and events were taken."""
        n_taken = self._take_events(now_s) + self._take_rows(now_s)
        if self._filled and now_s - self._opened_s >= OPEN_BLOCK_S:
            self._close_block()
        if self._event_since_s is not None and now_s - self._event_since_s >= OPEN_BLOCK_S:
            self._writer.flush()
            self._event_since_s = None
        return n_taken

    def drain(self) -> None:
        """Take and write everything that is left."""
        while self.step(time.monotonic()):
            pass
        if self._filled:
            self._close_block()

    def _take_rows(self, now_s: float) -> int:
        numbers, rows = self._rows.pop(fmt.BLOCK_ROWS - self._filled)
        start = 0
        while start < len(numbers):
            if self._filled and numbers[start] != self._row0 + self._filled:
                self._close_block()
            if self._filled == 0:
                self._row0 = int(numbers[start])
                self._opened_s = now_s
            expected = self._row0 + self._filled
            jumps = np.flatnonzero(numbers[start:] != np.arange(expected, expected + len(numbers) - start))
            stop = start + int(jumps[0]) if len(jumps) else len(numbers)
            self._buffer[self._filled : self._filled + stop - start] = rows[start:stop]
            self._filled += stop - start
            start = stop
        if self._filled == fmt.BLOCK_ROWS:
            self._close_block()
        return len(numbers)

    def _take_events(self, now_s: float) -> int:
        n_taken = 0
        while (item := self._events.pop()) is not None:
            number, text = item
            self._writer.write_event(number, json.loads(text))
            if self._event_since_s is None:
                self._event_since_s = now_s
            n_taken += 1
        return n_taken

    def _close_block(self) -> None:
        self._writer.write_block(self._row0, self._buffer[: self._filled])
        self._filled = 0
        self._event_since_s = None
        self._rows.report(self._writer.rows, RecorderState.RECORDING)

    def totals(self, ended: str) -> dict[str, Any]:
        """Return the ``end`` record: what the firmware offered, what was refused, why the recording ended."""
        return {
            "ended": ended,
            "rows_pushed": self._rows.pushed,
            "rows_dropped": self._rows.dropped,
            "rows_written": self._writer.rows,
            "events_pushed": self._events.pushed,
            "events_dropped": self._events.dropped,
        }


def main(arguments: list[str]) -> int:
    """``python -m firmware_py.recording.recorder ROWS_FD EVENTS_FD``."""
    rows_fd, events_fd = (int(a) for a in arguments)
    rows, events = RowRing(rows_fd), EventRing(events_fd)
    control = _Control(sys.stdin.fileno())
    order = control.wait_line()
    if order is None:
        return Exit.FAILED
    try:
        path = Path(order["path"])
        writer = RecordingWriter(path, order["columns"], order["metadata"], overwrite=order["overwrite"])
    except (RecordingError, OSError) as error:
        rows.report(0, RecorderState.FAILED)
        _say({"error": str(error)})
        return Exit.BAD_INPUT
    rows.report(0, RecorderState.RECORDING)
    _say({"ready": True})
    drain = Drain(rows, events, writer)
    reserve = _Reserve(path.parent)
    kept: int | None = None
    try:
        ended, statistics = _run(control, drain, writer)
        writer.check()
        drain.drain()
        if statistics is not None:
            writer.write_metadata(fmt.STATISTICS_METADATA, statistics)
        totals = drain.totals(ended)
        size = writer.finish(totals)
        state, problem = RecorderState.DONE, ""
        if writer.moved:
            problem = f"{path}: the file was moved while it was recorded; it is whole under its new name"
    except FileDisturbed as error:
        writer.abandon()
        kept = 0 if error.lost else _rows_in(path)
        problem = f"{path}: {error}; {f'{kept} ticks are left in it' if kept else 'nothing of it is left'}"
        totals = drain.totals(f"the file was {error.what}")
        size = 0 if error.lost else path.stat().st_size
        state = RecorderState.DISTURBED
    except OSError as error:
        full = error.errno in _FULL
        problem = f"{path}: {'the disk is full' if full else error.strerror}; recorded up to row {writer.rows}"
        reserve.release()
        totals = drain.totals("disk full" if full else f"write error: {error.strerror}")
        event = {"event": "recording stopped", "reason": problem}
        size = writer.give_up((events.pushed, event), totals)
        state = RecorderState.DISK_FULL if full else RecorderState.FAILED
    reserve.release()
    rows.report(writer.rows if kept is None else kept, state)
    _say({**totals, "bytes": size, "problem": problem})
    lost = state is not RecorderState.DONE or totals["rows_dropped"] or totals["events_dropped"]
    return Exit.DATA_LOST if lost else Exit.DONE


def _rows_in(path: Path) -> int:
    """Return the number of rows that a reader finds in a file that another program has changed."""
    try:
        return Recording(path).n_rows
    except RecordingError:
        return 0


def _run(control: _Control, drain: Drain, writer: RecordingWriter) -> tuple[str, Any]:
    """Record until told to stop. Return why it ended, and the final statistics if there are any."""
    synced_s = time.monotonic()
    while True:
        busy = drain.step(time.monotonic())
        line = control.wait(0.0 if busy else POLL_S)
        if line is not None:
            return "stopped", line["stop"]
        if control.closed:
            return "the firmware ended without closing the recording", None
        if control.terminated:
            return "the recorder was terminated", None
        if time.monotonic() - synced_s >= SYNC_S:
            writer.sync()
            writer.check()
            synced_s = time.monotonic()


class _Reserve:
    """An unnamed file beside the recording that is given back when the disk is full."""

    def __init__(self, folder: Path) -> None:
        self._fd: int | None = None
        with suppress(OSError):  # without a reserve the last words may not fit; the blocks are safe anyway
            self._fd = os.open(folder, os.O_TMPFILE | os.O_RDWR, 0o600)
            os.posix_fallocate(self._fd, 0, _RESERVE_BYTES)

    def release(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def readable(fd: int, timeout_s: float) -> bool:
    """Return True if ``fd`` has something to read (or has ended) within ``timeout_s``."""
    return bool(select.select([fd], [], [], max(0.0, timeout_s))[0])


def _say(message: dict[str, Any]) -> None:
    with suppress(BrokenPipeError):  # the firmware may be gone
        os.write(sys.stdout.fileno(), (json.dumps(message) + "\n").encode())
