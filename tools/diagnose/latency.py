"""Our cyclictest: how late a 1 kHz loop wakes up on this machine, bare, beside a pty, and as the firmware."""

from __future__ import annotations

import json
import os
import pty
import socket
import subprocess
import sys
import tempfile
import tty
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from firmware_py.frame import LAYOUT
from firmware_py.live.memory import LiveMemory
from firmware_py.run_request import LOOP_PRIORITY, RunRequest
from firmware_py.scheduler.histogram import DurationHistogram, bucket_bounds_ns
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from hal.children import child_command, child_environment
from hal.clock import MonotonicClock
from hal.errors import HalError

Policy = Literal["other", "fifo"]
PERIOD_NS = 1_000_000
ECHO = """
import os
while data := os.read(0, 64):
    os.write(1, data)
"""


@dataclass(frozen=True)
class Lateness:
    """One measurement. ``what`` names the load, ``scheduling`` what was granted."""

    what: str
    policy: Policy
    scheduling: str
    histogram: DurationHistogram

    def as_dict(self) -> dict[str, Any]:
        d = self.histogram.distribution()
        return {
            "what": self.what,
            "policy": self.policy,
            "scheduling": self.scheduling,
            **d.as_dict(),
            "min": d.min_us,
            "mean": d.mean_us,
            "buckets_us": octaves(self.histogram),
        }


def octaves(histogram: DurationHistogram) -> list[tuple[float, int]]:
    """Upper bound in us and count of every octave that is not empty."""
    counts = histogram.counts()
    table: dict[float, int] = {}
    for index in np.flatnonzero(counts):
        low_ns, width_ns = bucket_bounds_ns(int(index))
        bound_us = float(1 << max(0, (low_ns + width_ns - 1).bit_length())) / 1000.0
        table[bound_us] = table.get(bound_us, 0) + int(counts[index])
    return sorted(table.items())


def settings_of(policy: Policy) -> RealtimeConfig:
    """What the firmware asks for (``fifo``), or nothing at all."""
    if policy == "fifo":
        return RealtimeConfig(priority=LOOP_PRIORITY)
    return RealtimeConfig(priority=None, lock_memory=False, timer_slack_ns=None, freeze_gc=False)


def bare_loop(seconds: float, policy: Policy, *, with_pty: bool = False) -> Lateness:
    """Wake up every millisecond; with ``with_pty`` also exchange 16 bytes with an echo process behind a pty."""
    clock, histogram = MonotonicClock(), DurationHistogram()
    echo = _PtyEcho() if with_pty else None
    try:
        with realtime(settings_of(policy)) as report:
            granted = ", ".join(s.wanted for s in report.settings if s.done) or "SCHED_OTHER, no settings"
            due_ns = clock.now_ns() + 5 * PERIOD_NS
            for k in range(round(seconds * 1e9 / PERIOD_NS)):
                histogram.add(clock.sleep_until_ns(due_ns), k)
                if echo is not None:
                    echo.exchange()
                due_ns += PERIOD_NS
                now_ns = clock.now_ns()
                if now_ns > due_ns:  # a stall counts once, as in the firmware
                    due_ns += (now_ns - due_ns) // PERIOD_NS * PERIOD_NS + PERIOD_NS
    finally:
        if echo is not None:
            echo.close()
    return Lateness("loop and pty" if with_pty else "bare loop", policy, granted, histogram)


class _PtyEcho:
    """A child process that sends back what it gets on a pseudo-terminal; its answer is taken when it is there."""

    def __init__(self) -> None:
        self._master, slave = pty.openpty()
        for fd in (self._master, slave):
            tty.setraw(fd)
        os.set_blocking(self._master, False)
        self._process = subprocess.Popen([sys.executable, "-c", ECHO], stdin=slave, stdout=slave)
        os.close(slave)

    def exchange(self) -> None:
        with suppress(BlockingIOError):
            os.read(self._master, 4096)
        os.write(self._master, bytes(16))

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._master)


def firmware_loop(bench: Path, seconds: float, policy: Policy) -> Lateness:
    """Lateness of the firmware's ticks on ``bench``, in a process of its own. ``HalError`` when it cannot run."""
    memory = LiveMemory.create(LAYOUT.size)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    fds = (memory.fd, theirs.fileno())
    try:
        with tempfile.TemporaryDirectory(prefix="micron-") as folder:
            request = RunRequest(
                bench, seconds, live_fds=fds, truth_s=1.0, stale_ms=1000.0, pace="realtime", policy=policy == "fifo"
            )
            request_file = Path(folder) / "request.json"
            request_file.write_text(request.to_json(Path(folder)), encoding="utf-8")
            command = child_command("firmware_py.app", str(request_file))
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, pass_fds=fds, env=child_environment()
            )
            outcome_file = Path(folder) / "outcome.json"
            if done.returncode != 0 or not outcome_file.exists():
                raise HalError((done.stderr.strip().splitlines() or ["the firmware did not run"])[-1])
            outcome = json.loads(outcome_file.read_text(encoding="utf-8"))
        opening = next(line for line in map(json.loads, done.stdout.splitlines()) if "histograms" in line)
        histogram = memory.histogram(opening["histograms"].index("lateness"))
    finally:
        memory.close()
        ours.close()
        theirs.close()
    return Lateness("firmware", policy, outcome["realtime"], histogram)
