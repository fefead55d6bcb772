"""Runs the firmware's side of the recorder, a process of its own that shared memory feeds and that never delays the
loop."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.recording import drain
from firmware_py.recording import format as fmt
from firmware_py.recording.drain import RecorderState
from firmware_py.recording.errors import RecorderFailed, RecordingError
from firmware_py.recording.ring import EventRing, RowRing, RowsView
from hal.children import child_command, child_environment
from hal.jsonable import to_jsonable

_PAUSE_S = 0.0005


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Holds the recorder's counters and state. ``waiting`` rows are in the ring, ``written`` ones in the file."""

    pushed: int
    dropped: int
    events_dropped: int
    waiting: int
    written: int
    state: RecorderState
    alive: bool


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """Summarizes a finished recording. ``ticks`` rows are in the file, ``dropped`` were pushed and are not.

    ``exit_code`` is the recorder's (``firmware_py.exit_codes``), negative for a signal; ``problem`` says in words
    what went wrong.
    """

    path: Path
    ticks: int
    dropped: int
    events_dropped: int
    size_bytes: int
    exit_code: int
    problem: str


class RecorderProcess:
    """Handle of a running recorder. Start it before real-time settings are made: it must not inherit them."""

    def __init__(
        self, path: Path, process: subprocess.Popen[bytes], rows: RowRing, events: EventRing, lossless: bool
    ) -> None:
        """Use ``start``."""
        self.path = path
        self._process = process
        self._rows = rows
        self._events = events
        self._summary: RecordingSummary | None = None
        self._lossless = lossless

    @classmethod
    def start(
        cls,
        path: Path,
        columns: Sequence[tuple[str, str]],
        metadata: Mapping[str, Any],
        *,
        overwrite: bool = False,
        lossless: bool | None = None,
        capacity_rows: int = 8192,
        capacity_event_bytes: int = 1 << 18,
        timeout_s: float = 30.0,
    ) -> RecorderProcess:
        """Start recording rows of ``columns`` (name, unit) into ``path``.

        ``metadata``: texts and JSON values, stored at the start of the file. ``lossless``: ``push`` waits for room
        instead of dropping; for virtual time, where nothing real waits (None: when ``metadata["clock"]`` is
        ``"virtual"``). ``capacity_rows`` bridges a slow disk: 8 s at 1 kHz.
        Raises ``RecordingError`` when the file exists or cannot be written, ``RecorderFailed`` when the process
        does not come up.
        """
        columns = fmt.check_columns(columns)
        path = Path(path).absolute()
        rows = RowRing.create(len(columns), capacity_rows)
        events = EventRing.create(capacity_event_bytes)
        process = subprocess.Popen(
            child_command("firmware_py.recording.recorder", str(rows.fd), str(events.fd)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(rows.fd, events.fd),
            env=child_environment(),
            start_new_session=True,  # Ctrl-C is for the firmware, which then stops the recorder
        )
        handle = cls(path, process, rows, events, metadata.get("clock") == "virtual" if lossless is None else lossless)
        order = {
            "path": str(path),
            "columns": columns,
            "metadata": to_jsonable(metadata),
            "overwrite": overwrite,
        }
        try:
            handle._send(order)
            answer = handle._answer(timeout_s)
        except BaseException:
            handle._abandon()
            raise
        if "ready" not in answer:
            handle._abandon()
            raise RecordingError(answer["error"]) if "error" in answer else RecorderFailed("the recorder did not start")
        return handle

    @property
    def pid(self) -> int:
        """Return the process id of the recorder."""
        return self._process.pid

    def push(self, row: NDArray[np.float64]) -> bool:
        """Hand over a copy of ``row[n_columns]``; False, and counted, when there is no room."""
        if self._lossless:
            while self._rows.full() and self._process.poll() is None:
                time.sleep(_PAUSE_S)
        return self._rows.push(row)

    def view(self) -> RowsView:
        """Return the ring's memory for a compiled loop, which drops rows when it is full, also if ``lossless``."""
        return self._rows.view()

    def event(self, event: Mapping[str, Any]) -> bool:
        """Record something that happened once (give it ``t_ns``); False, and counted, when there is no room."""
        return self._events.push(json.dumps(to_jsonable(event)).encode())

    def stats(self) -> RecorderStats:
        """Return the counters, read from shared memory."""
        return RecorderStats(
            pushed=self._rows.pushed,
            dropped=self._rows.dropped,
            events_dropped=self._events.dropped,
            waiting=self._rows.waiting(),
            written=self._rows.written,
            state=RecorderState(self._rows.state),
            alive=self._process.poll() is None,
        )

    def stop(self, final_statistics: Mapping[str, Any] | None = None, timeout_s: float = 60.0) -> RecordingSummary:
        """Write what is left and ``final_statistics``, end the process. Never raises for a broken recorder: the
        summary says so. A second call returns the same summary."""
        if self._summary is not None:
            return self._summary
        with suppress(OSError):  # it may have ended by itself
            self._send({"stop": to_jsonable(final_statistics) if final_statistics is not None else None})
        problem = ""
        last: dict[str, Any] = {}
        try:
            output, _ = self._process.communicate(timeout=timeout_s)
            if output.strip():
                last = json.loads(output.splitlines()[-1])
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            problem = f"the recorder did not end within {timeout_s:g} s and was killed"
        code = self._process.returncode
        if code < 0:
            problem = problem or f"the recorder was killed by signal {-code}; run 'micron recover' on the file"
        elif not last:
            problem = problem or f"the recorder broke down with exit code {code}"
        stats = self.stats()
        self._summary = RecordingSummary(
            path=self.path,
            ticks=stats.written,
            dropped=stats.pushed - stats.written,
            events_dropped=stats.events_dropped,
            size_bytes=last.get("bytes", self.path.stat().st_size if self.path.exists() else 0),
            exit_code=code,
            problem=problem or last.get("problem", ""),
        )
        self._close_rings()
        return self._summary

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write((json.dumps(message) + "\n").encode())
        self._process.stdin.flush()

    def _answer(self, timeout_s: float) -> dict[str, Any]:
        """The first line that the recorder says."""
        assert self._process.stdout is not None
        deadline_s = time.monotonic() + timeout_s
        stdout = self._process.stdout
        line = b""
        while not line.endswith(b"\n"):
            if not drain.readable(stdout.fileno(), deadline_s - time.monotonic()):
                raise RecorderFailed(
                    f"the recorder did not start within {timeout_s:g} s; the machine may be overloaded"
                )
            byte = os.read(stdout.fileno(), 1)
            if not byte:
                return {}
            line += byte
        return json.loads(line)

    def _abandon(self) -> None:
        self._process.kill()
        self._process.communicate()
        self._close_rings()

    def _close_rings(self) -> None:
        self._rows.close()
        self._events.close()


if __name__ == "__main__":
    sys.exit(drain.main(sys.argv[1:]))
