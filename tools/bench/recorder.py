"""Makes recordings from the page: it hands rows of the live memory to the firmware's own recorder process.

The firmware is not involved and the browser neither: the server feeds the recorder until somebody says stop.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from firmware_py.frame import Layout
from firmware_py.live.memory import LiveRows
from firmware_py.recording.drain import RecorderState
from firmware_py.recording.recorder import RecorderProcess
from tools.errors import InputError
from tools.output import write_text_atomic

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._ -]{0,79}")
SUFFIX = ".mcap"


def check_name(name: str) -> str:
    """A file name and nothing else. ``InputError`` says what is allowed."""
    if not NAME.fullmatch(name) or name.endswith(SUFFIX):
        raise InputError(
            f"{name!r} is not a name for a recording: letters, digits, space, '.', '_' and '-', at most 80"
        )
    return name


def is_own_file(path: Path) -> bool:
    """A regular file that is no symbolic link: a link could lead to any file that the server may read."""
    return path.is_file() and not path.is_symlink()


class RunRecorder:
    """Makes one recording at a time, in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.name = ""
        self._recorder: RecorderProcess | None = None
        self._starting = False
        self._started_s = 0.0
        self._sidecar: dict[str, Any] = {}
        self._missed = 0

    @property
    def active(self) -> bool:
        return self._recorder is not None

    def path(self, name: str) -> Path:
        return self.folder / (check_name(name) + SUFFIX)

    async def start(self, name: str, notes: str, metadata: dict[str, Any], layout: Layout) -> None:
        """Begin; the default name is the time. ``InputError`` when one is running or nothing can be recorded."""
        if self._recorder is not None or self._starting:
            raise InputError(f"a recording is running already ({self.name}); stop it first")
        if not metadata:
            raise InputError("no firmware is running; start it, then record")
        name = check_name(name or datetime.now(UTC).strftime("run %Y-%m-%d %H.%M.%S"))
        if self.path(name).is_symlink():
            raise InputError(f"{self.path(name)} is a symbolic link; choose another name")
        columns = list(zip(layout.scalar_names(), layout.scalar_units(), strict=True))
        self._starting = True
        try:
            self._recorder = await asyncio.to_thread(
                RecorderProcess.start, self.path(name), columns, {**metadata, "notes": notes, "made_by": "micron bench"}
            )
        finally:
            self._starting = False
        self.name, self._missed, self._started_s = name, 0, time.monotonic()
        self._sidecar = {"notes": [notes] if notes else [], "started": datetime.now(UTC).isoformat(timespec="seconds")}
        self._sidecar["rate_hz"] = metadata.get("tick_hz")
        self._save()

    def push(self, rows: LiveRows) -> None:
        """Hand over what has come; never waits."""
        recorder = self._recorder
        if recorder is None:
            return
        if rows.missed:
            self._missed += rows.missed
            recorder.event({"event": "rows missed by the bench server", "rows": rows.missed, "before_row": rows.first})
        for row in rows.values:
            recorder.push(row)

    def note(self, text: str, t_ns: int) -> None:
        """Write a note into the running recording, at bench time ``t_ns``."""
        if self._recorder is None:
            raise InputError("no recording is running: a note needs one")
        self._recorder.event({"event": "note", "text": text, "t_ns": t_ns})
        self._sidecar["notes"].append(text)
        self._save()

    def event(self, name: str, reason: str, t_ns: int) -> None:
        """Write what the firmware did into the running recording, at bench time ``t_ns``."""
        if self._recorder is not None:
            self._recorder.event({"event": name, "reason": reason, "t_ns": t_ns})

    def trouble(self) -> str:
        """Return what is wrong with the running recording as text, empty when nothing is."""
        if self._recorder is None:
            return ""
        stats = self._recorder.stats()
        if stats.state is RecorderState.DISK_FULL:
            return "the disk is full, nothing more is written"
        if stats.state is RecorderState.DISTURBED:
            return "another program has deleted, replaced or cut the file; nothing more is recorded"
        if not stats.alive:
            return "the recorder process has died; stop, then run 'micron recover' on the file"
        lost = stats.dropped + self._missed
        return f"{lost} rows were lost" if lost else ""

    def state(self) -> dict[str, Any] | None:
        """Return the JSON values for the page, or None when nothing is recorded."""
        if self._recorder is None:
            return None
        stats = self._recorder.stats()
        return {
            "name": self.name,
            "seconds": time.monotonic() - self._started_s,
            "written": stats.written,
            "dropped": stats.dropped + self._missed,
            "notes": self._sidecar["notes"],
        }

    async def stop(self, final: dict[str, Any]) -> dict[str, Any]:
        """Stop the recording and finish the file."""
        recorder = self._recorder
        if recorder is None:
            raise InputError("no recording is running")
        self._recorder = None
        summary = await asyncio.to_thread(recorder.stop, final)
        result = {
            "name": self.name,
            "ticks": summary.ticks,
            "dropped": summary.dropped + self._missed,
            "bytes": summary.size_bytes,
            "problem": summary.problem,
        }
        self._sidecar |= {k: result[k] for k in ("ticks", "dropped", "problem")}
        self._save()
        return result

    def _save(self) -> None:
        write_text_atomic(self.folder / (self.name + ".json"), json.dumps(self._sidecar, indent=2) + "\n")
