"""Measures, like cyclictest, how late a 1 kHz loop wakes up on this machine: in C, compiled, in Python, as the
firmware."""

from __future__ import annotations

import json
import os
import pty
import socket
import subprocess
import sys
import tempfile
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_py.layouts import layout_of
from firmware_py.live.memory import LiveMemory
from firmware_py.machine.workers import WORKER_PRIORITY
from firmware_py.run_request import LOOP_PRIORITY, RunRequest
from firmware_py.scheduler.histogram import DurationHistogram, bucket_bounds_ns
from firmware_py.scheduler.realtime import RealtimeConfig, RealtimeReport, realtime
from hal.bench import load_bench
from hal.children import child_command, child_environment
from hal.clock import MonotonicClock
from hal.errors import HalError
from tools.diagnose.c_reference import CReference

Policy = Literal["other", "fifo"]
Wake = Callable[[NDArray[np.int64], int, int], None]
"""Fills how late it woke up, ns, with a period and a first due time, ns."""
PERIOD_NS = 1_000_000
TICKS_AT_ONCE = 1000
BEYOND_US = (100.0, 1000.0)
"""Limits beyond which ticks are counted, as ``cyclictest`` counts its overflows."""
ECHO = """
import os
while data := os.read(0, 64):
    os.write(1, data)
"""


@dataclass(frozen=True)
class Lateness:
    """Holds one measurement. ``what`` names the load, ``scheduling`` the granted policy."""

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
            "beyond_us": {
                f"{limit_us:g}": self.histogram.count_beyond(round(limit_us * 1e3)) for limit_us in BEYOND_US
            },
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
    """Return the settings that the firmware asks for (``fifo``), or none."""
    if policy == "fifo":
        return RealtimeConfig(priority=LOOP_PRIORITY, idle_exit_us=0, worker_priority=WORKER_PRIORITY)
    return RealtimeConfig(priority=None, lock_memory=False, timer_slack_ns=None, freeze_gc=False)


@dataclass(frozen=True)
class Loop:
    """A loop that can be measured. ``measure(seconds, histogram)`` runs it, counts how late it was, and returns what
    scheduling it was granted."""

    what: str
    policy: Policy
    measure: Callable[[float, DurationHistogram], str]


def loops_of(policy: Policy, reference: CReference | None, bench: Path | None, *, compiled: bool = False) -> list[Loop]:
    """Return the loops that are compared under ``policy``: in C where there is a ``reference``, compiled, in Python,
    with a pty, and the firmware on ``bench`` where one is given. ``compiled``: its ticks run in the compiled thread."""

    def woken(wake: Wake) -> Callable[[float, DurationHistogram], str]:
        return lambda seconds, histogram: wake_loop(wake, seconds, policy, histogram)

    def python(with_pty: bool) -> Callable[[float, DurationHistogram], str]:
        return lambda seconds, histogram: bare_loop(seconds, policy, histogram, with_pty=with_pty)

    loops = [] if reference is None else [Loop("C reference", policy, woken(reference.wake))]
    loops += [
        Loop("compiled loop", policy, woken(_compiled_wake())),
        Loop("bare loop", policy, python(False)),
        Loop("loop and pty", policy, python(True)),
    ]
    if bench is not None:
        what = "firmware, compiled" if compiled else "firmware"
        loops.append(Loop(what, policy, partial(firmware_loop, bench, policy, compiled=compiled)))
    return loops


def _compiled_wake() -> Wake:
    from tools.diagnose.wake_kernel import wake  # numba

    wake(np.zeros(1, np.int64), PERIOD_NS, 0)  # compiles or loads
    return wake


def take_turns(loops: Sequence[Loop], rounds: int, turn_s: float, measurements: list[Lateness]) -> Iterator[str]:
    """Let each of ``loops`` run for ``turn_s``, ``rounds`` times over, so that all have the same neighbours. Yields
    what is about to run; results are in ``found`` as they come."""
    for number in range(rounds):
        for i, loop in enumerate(loops):
            yield f"{loop.what}, policy {loop.policy}, {turn_s:g} s" + (
                f", round {number + 1} of {rounds}" if rounds > 1 else ""
            )
            histogram, scheduling = DurationHistogram(), "interrupted"
            try:
                scheduling = loop.measure(turn_s, histogram)
            finally:  # the counts until Ctrl-C are kept
                if number:
                    measurements[i].histogram.add_histogram(histogram)
                elif histogram.n:
                    measurements.append(Lateness(loop.what, loop.policy, scheduling, histogram))


def wake_loop(wake: Wake, seconds: float, policy: Policy, histogram: DurationHistogram) -> str:
    """Let ``wake`` wake up every millisecond, a second at a time: Ctrl-C is seen in between. Return the scheduling."""
    clock, left = MonotonicClock(), max(1, round(seconds * 1e9 / PERIOD_NS))
    with realtime(settings_of(policy)) as report:
        while left > 0:
            late_ns = np.zeros(min(left, TICKS_AT_ONCE), np.int64)
            wake(late_ns, PERIOD_NS, clock.now_ns() + 5 * PERIOD_NS)
            histogram.add_all(late_ns.tolist())
            left -= len(late_ns)
    return granted_by(report)


def granted_by(report: RealtimeReport) -> str:
    """Return the settings that took effect, in words."""
    return ", ".join(s.wanted for s in report.settings if s.done) or "SCHED_OTHER, no settings"


def bare_loop(seconds: float, policy: Policy, histogram: DurationHistogram, *, with_pty: bool = False) -> str:
    """Wake up every millisecond; with ``with_pty`` also exchange 16 bytes with an echo process behind a pty. Return the
    scheduling."""
    clock = MonotonicClock()
    echo = _PtyEcho() if with_pty else None
    try:
        with realtime(settings_of(policy)) as report:
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
    return granted_by(report)


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


def firmware_loop(
    bench: Path, policy: Policy, seconds: float, histogram: DurationHistogram, *, compiled: bool = False
) -> str:
    """Count how late the firmware's ticks are on ``bench``, in a process of its own. Return the scheduling. Raises
    ``HalError`` when it cannot run."""
    memory = LiveMemory.create(layout_of(load_bench(bench).description).size)
    local, remote = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    fds = (memory.fd, remote.fileno())
    try:
        with tempfile.TemporaryDirectory(prefix="micron-") as folder:
            request = RunRequest(
                bench, seconds, live_fds=fds, truth_s=1.0, stale_ms=1000.0, pace="realtime", policy=policy == "fifo",
                compiled=compiled,
            )  # fmt: skip
            request_file = Path(folder) / "request.json"
            request_file.write_text(request.to_json(Path(folder)), encoding="utf-8")
            command = child_command("firmware_py.app", str(request_file))
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, pass_fds=fds, env=child_environment()
            )
            outcome_file = Path(folder) / "outcome.json"
            if done.returncode != 0 or not outcome_file.exists():
                message = (done.stderr.strip().splitlines() or ["the firmware did not run"])[-1]
                raise HalError(message.removeprefix("micron: "))
            outcome = json.loads(outcome_file.read_text(encoding="utf-8"))
        opening = next(line for line in map(json.loads, done.stdout.splitlines()) if "histograms" in line)
        histogram.add_histogram(memory.histogram(opening["histograms"].index("lateness")))
    finally:
        memory.close()
        local.close()
        remote.close()
    return str(outcome["realtime"])
