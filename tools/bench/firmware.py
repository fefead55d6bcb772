"""A firmware in its own process, with shared memory to look at and a socket to give orders."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_py.compiled.eligible import check_compiled
from firmware_py.live.memory import LiveMemory
from firmware_py.run_request import RunRequest
from hal.bench import BenchFile
from hal.children import child_command, child_environment
from hal.clock import Pace
from hal.errors import HalError

FOREVER_S = 30 * 86_400.0
TRUTH_S = 5.0
STOP_S = 15.0


@dataclass(frozen=True)
class Choice:
    """Holds the choices of a run. ``pace`` is that of runs in Python, ``compiled`` that of the page: a run that arms
    nothing is Python all the same."""

    bench: Path
    hand_file: str | None = None
    hand_scale: float | None = None
    seed: int | None = None
    stale_ms: float | None = None
    sense_only: bool = False
    pace: Pace | None = None
    compiled: bool = False

    @property
    def runs_compiled(self) -> bool:
        """Return whether the ticks run in one compiled thread."""
        return self.compiled and not self.sense_only

    @property
    def run_pace(self) -> Pace | None:
        """Return the pace of the run: emulated time passes in Python, so a compiled run is on the wall clock."""
        return "realtime" if self.runs_compiled else self.pace

    def check(self, bench: BenchFile) -> None:
        """Raise ``HalError`` if a compiled run is chosen and ``bench`` cannot be run compiled."""
        if self.runs_compiled:
            check_compiled(bench, "realtime")


def why_not_compiled(bench: BenchFile) -> str:
    """Return the message that refuses a compiled run of ``bench``; an empty text if it can be run compiled."""
    try:
        check_compiled(bench, "realtime")
    except HalError as error:
        return str(error)
    return ""


class Firmware:
    """Start with ``start``; ``on_line`` gets every status line, ``on_end`` the outcome or the reason of the failure."""

    def __init__(self, choice: Choice, columns: int, runtime_dir: Path) -> None:
        """Use ``start``."""
        self.choice = choice
        self.runtime_dir = runtime_dir
        self.memory = LiveMemory.create(columns)
        self._control, self._their_control = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setblocking(False)
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None

    @classmethod
    async def start(
        cls,
        choice: Choice,
        columns: int,
        on_line: Callable[[dict[str, Any]], None],
        on_end: Callable[[dict[str, Any] | None, str], None],
    ) -> Firmware:
        """Start the process, whose frames have ``columns`` values; what it says comes through the callbacks."""
        self = cls(choice, columns, Path(tempfile.mkdtemp(prefix="micron-bench-")))
        fds = (self.memory.fd, self._their_control.fileno())
        request = RunRequest(
            bench=choice.bench,
            seconds=FOREVER_S,
            hand_file=choice.hand_file,
            hand_scale=choice.hand_scale,
            seed=choice.seed,
            stale_ms=choice.stale_ms,
            sense_only=choice.sense_only,
            pace=choice.run_pace,
            compiled=choice.runs_compiled,
            live_fds=fds,
            truth_s=TRUTH_S,
        )
        request_file = self.runtime_dir / "request.json"
        request_file.write_text(request.to_json(self.runtime_dir), encoding="utf-8")
        self._process = await asyncio.create_subprocess_exec(
            *child_command("firmware_py.app", str(request_file)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            pass_fds=fds,
            env=child_environment(),
        )
        self._their_control.close()
        self._reader = asyncio.create_task(self._read(on_line, on_end))
        return self

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    async def _read(
        self, on_line: Callable[[dict[str, Any]], None], on_end: Callable[[dict[str, Any] | None, str], None]
    ) -> None:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        assert process.stderr is not None
        errors = asyncio.create_task(process.stderr.read())
        async for line in process.stdout:
            with contextlib.suppress(ValueError):
                on_line(json.loads(line))
        await process.wait()
        stderr = (await errors).decode(errors="replace").strip()
        outcome_file = self.runtime_dir / "outcome.json"
        outcome = json.loads(outcome_file.read_text(encoding="utf-8")) if outcome_file.exists() else None
        last = (
            stderr.splitlines()[-1].removeprefix("micron: ") if stderr else f"it ended with code {process.returncode}"
        )
        on_end(outcome, "" if outcome is not None else last)

    def order(self, order: str, **values: Any) -> bool:
        """Send an order; False when the firmware is gone or does not take any."""
        message = {"order": order, "t_ns": time.monotonic_ns(), **values}
        try:
            self._control.send(json.dumps(message).encode())
        except OSError:
            return False
        return True

    def metadata(self) -> dict[str, Any]:
        """Return the metadata for recordings of this run. It is empty before the devices are open."""
        path = self.runtime_dir / "metadata.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    async def stop(self) -> None:
        """Ramp to neutral and end; idempotent. A firmware that does not end is killed."""
        process, reader = self._process, self._reader
        assert process is not None
        assert reader is not None
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
            try:
                await asyncio.wait_for(asyncio.shield(reader), STOP_S)
            except TimeoutError:
                process.kill()
        await reader

    def close(self) -> None:
        """Release memory and folder. Call it after ``stop``."""
        import shutil

        self.memory.close()
        self._control.close()
        shutil.rmtree(self.runtime_dir, ignore_errors=True)
