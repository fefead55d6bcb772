"""Long work in processes of its own: one at a time, its progress in words, its files kept until the next."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shutil
import signal
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hal.children import child_command, child_environment
from tools.errors import InputError

MAX_LINES = 200
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Job:
    """Steps (commands of this Python) one after the other; the first that fails ends it."""

    def __init__(self, kind: str, title: str, steps: Sequence[Sequence[str]], folder: Path) -> None:
        self.kind = kind
        self.title = title
        self.folder = folder
        self.lines: list[str] = []
        self.step = 0
        self.steps = steps
        self.state = "running"
        self.code: int | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._started_s = time.monotonic()
        self._ended_s: float | None = None
        self.task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        try:
            for step, arguments in enumerate(self.steps):
                self.step = step
                self.code = await self._one(arguments)
                # 3: done, but data were lost; the output says so
                if self.code not in (0, 3) or self.state != "running":
                    break
            if self.state == "running":
                self.state = "done" if self.code in (0, 3) else "failed"
        except OSError as error:
            self.state, self.code = "failed", -1
            self.lines.append(str(error))
        finally:
            self._ended_s = time.monotonic()

    async def _one(self, arguments: Sequence[str]) -> int:
        self._process = await asyncio.create_subprocess_exec(
            *child_command(*arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
            env={**child_environment(), "COLUMNS": "110", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            preexec_fn=lambda: os.nice(10),
        )
        if self.state != "running":  # cancelled while it was being started
            self._end()
        assert self._process.stdout is not None
        rest = ""
        while chunk := await self._process.stdout.read(4096):
            *whole, rest = (rest + _ESCAPES.sub("", chunk.decode(errors="replace")).replace("\r", "\n")).split("\n")
            self.lines.extend(line.rstrip() for line in whole if line.strip())
            del self.lines[:-MAX_LINES]
        return await self._process.wait()

    async def cancel(self) -> None:
        """End it with everything that it started."""
        if self.state == "running":
            self.state = "cancelled"
            self._end()
        await asyncio.gather(self.task, return_exceptions=True)

    def _end(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values that the page shows."""
        return {
            "kind": self.kind,
            "title": self.title,
            "state": self.state,
            "code": self.code,
            "step": self.step,
            "steps": len(self.steps),
            "seconds": (self._ended_s or time.monotonic()) - self._started_s,
            "lines": self.lines[-40:],
            "files": sorted(p.name for p in self.folder.iterdir() if p.is_file()) if self.folder.is_dir() else [],
        }


class Jobs:
    """Keeps the newest job of each kind. One job runs at a time, because each takes a processor."""

    def __init__(self) -> None:
        self._root = Path(tempfile.mkdtemp(prefix="micron-jobs-"))
        self._jobs: dict[str, Job] = {}
        self._number = 0

    def new_folder(self) -> Path:
        """Return a new folder for the files of the next job."""
        self._number += 1
        folder = self._root / str(self._number)
        folder.mkdir()
        return folder

    def start(self, kind: str, title: str, steps: Sequence[Sequence[str]], folder: Path) -> Job:
        """Replace the last job of ``kind``. ``InputError`` while another one runs."""
        self.must_be_idle()
        old = self._jobs.get(kind)
        if old is not None:
            shutil.rmtree(old.folder, ignore_errors=True)
        self._jobs[kind] = Job(kind, title, steps, folder)
        return self._jobs[kind]

    def must_be_idle(self) -> None:
        """``InputError`` while a job runs."""
        for job in self._jobs.values():
            if job.state == "running":
                raise InputError(f"'{job.title}' is still running; wait for it or cancel it")

    def get(self, kind: str) -> Job:
        """Return the newest job of that kind. Raises ``InputError`` when there is none."""
        if kind not in self._jobs:
            raise InputError(f"no {kind} was run yet")
        return self._jobs[kind]

    def state(self, kind: str) -> dict[str, Any]:
        return self._jobs[kind].as_dict() if kind in self._jobs else {"kind": kind, "state": "none"}

    def file(self, kind: str, name: str) -> Path:
        """Return a file that the job wrote. Raises ``InputError`` when it wrote none."""
        folder = self.get(kind).folder
        path = folder / Path(name).name
        if not path.is_file():
            raise InputError(f"there is no file {name!r}")
        return path

    async def close(self) -> None:
        for job in self._jobs.values():
            await job.cancel()
        shutil.rmtree(self._root, ignore_errors=True)
