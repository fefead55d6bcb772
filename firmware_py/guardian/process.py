"""Runs the guardian in a process of its own, and gives the firmware a handle of it.

The firmware's loop holds a mark in shared memory (``mark.py``) and the writing end of a pipe. When it dies, by whatever
cause, the kernel sets the mark at once, which the guardian checks every millisecond, and closes the pipe once it has
freed the firmware's memory, which takes tens of milliseconds. The heartbeat shows that the firmware stands still.
The guardian opens its own connection to the amplifier's bus at the start; it outlives the firmware, and ends when the
outputs have stayed at neutral.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivers.registry import find_driver
from firmware_py.guardian.guardian import STEP_NS, Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat, TakeoverReason
from firmware_py.guardian.lifecycle import start_error
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from hal.backends import open_i2c
from hal.children import child_command, child_environment
from hal.clock import MonotonicClock
from hal.contracts import Clock
from hal.errors import HalError, OpenFailed

PRIORITY = 85  # above the loop: it does almost nothing, but must do it while the loop is stuck
STEP_DELAY_NS = 200_000
"""Delay from the beginning of a command to the guardian's step. The loop then waits for its bus and needs no processor,
which a step at another time would take from it."""
START_S = 30.0
END_S = 5.0
"""Time limit for the end of the guardian after its retries."""
END_POLL_S = 0.002
REPORT = "guardian.json"
STARTED = "guardian.started"
"""File that exists once a guardian was started; it holds the time (s) for which a ramp is retried."""


class GuardianProcess:
    """Implements ``GuardianHandle`` for a guardian in a process of its own. Create it before real-time settings are
    made.

    ``settings``: uri, speed_hz, driver and options of the output, notice_ms, limit_ms, retry_s; ``main`` reads them.
    The guardian starts at once; ``await_ready`` waits for it. ``may_be_killed``: this process is the firmware and
    nothing else, so the guardian may kill it when it stands still within a command.
    """

    def __init__(self, settings: dict[str, Any], runtime_dir: Path, *, may_be_killed: bool = False) -> None:
        self.heartbeat = Heartbeat.shared()
        self.heartbeat.mark.hold()
        # a guardian that replaces another one must not run on the processor to which the loop is pinned
        self._settings: dict[str, Any] = {**settings, "processors": sorted(os.sched_getaffinity(0))}
        self._report = runtime_dir / REPORT
        self._may_be_killed = may_be_killed
        self._is_ready = False
        (runtime_dir / STARTED).write_text(str(settings["retry_s"]), encoding="utf-8")
        self._process, self._pipe = self._start()

    def _start(self) -> tuple[subprocess.Popen[bytes], int]:
        assert self.heartbeat.fd is not None
        guardian_end, own_end = os.pipe()
        ourselves = os.pidfd_open(os.getpid()) if self._may_be_killed else -1
        settings = {**self._settings, "heartbeat": self.heartbeat.fd, "pipe": guardian_end, "firmware": ourselves}
        process = subprocess.Popen(
            child_command("firmware_py.guardian.process", json.dumps({**settings, "report": str(self._report)})),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=(self.heartbeat.fd, guardian_end, *((ourselves,) if self._may_be_killed else ())),
            env=child_environment(),
            start_new_session=True,  # Ctrl-C is for the firmware
        )
        os.close(guardian_end)
        if self._may_be_killed:
            os.close(ourselves)
        return process, own_end

    @property
    def pid(self) -> int:
        """Process id of the guardian, for tests that kill it."""
        return self._process.pid

    def is_alive(self) -> bool:
        return self._is_ready and self._process.poll() is None

    def await_ready(self) -> None:
        """Wait until the guardian is ready. Raises ``OpenFailed`` if it cannot reach the amplifier."""
        try:
            if not self._is_ready_within(START_S):
                raise start_error(f"no word from it within {START_S:g} s")
        except HalError as error:
            self.stop()
            raise OpenFailed([error]) from error

    def finish_replacement(self) -> bool:
        return self._is_ready_within(0.0)

    def _is_ready_within(self, timeout_s: float) -> bool:
        assert self._process.stdout is not None
        if not select.select([self._process.stdout], (), (), timeout_s)[0]:
            return False
        line = self._process.stdout.readline().decode().strip()
        if line != "ready":
            raise start_error(line or "it ended without a word")
        self._is_ready = True
        return True

    def kill(self) -> None:
        """End the guardian now. It sends no command after this returns."""
        self._process.kill()
        self._process.wait()

    def begin_replacement(self) -> None:
        """End the guardian and begin to start another one. Return at once; ``finish_replacement`` follows."""
        self.kill()
        assert self._process.stdout is not None
        self._process.stdout.close()
        os.close(self._pipe)
        self.heartbeat.clear_guardian()
        self._is_ready = False
        self._process, self._pipe = self._start()

    def stop(self, is_interrupted: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Let the guardian end once the outputs are at rest, and return its report, ``None`` without one. Idempotent.

        Once ``is_interrupted`` returns True, the guardian goes on alone and its report is not waited for.
        """
        if self._pipe >= 0:
            os.close(self._pipe)
            self._pipe = -1
            self.heartbeat.mark.release()
            deadline_s = time.monotonic() + self._settings["retry_s"] + END_S
            while self._process.poll() is None and not is_interrupted():
                if time.monotonic() > deadline_s:
                    self.kill()
                time.sleep(END_POLL_S)
            assert self._process.stdout is not None
            self._process.stdout.close()
        with suppress(OSError, ValueError):
            return json.loads(self._report.read_text(encoding="utf-8"))
        return None


def compute_pause_ns(beat_ns: int, now_ns: int) -> int:
    """Return the time to the next step: a millisecond, or up to half of one less, so that the steps come
    ``STEP_DELAY_NS`` after a command began. ``beat_ns`` is when the last command began."""
    late_ns = (now_ns - beat_ns - STEP_DELAY_NS + STEP_NS // 2) % STEP_NS - STEP_NS // 2
    return STEP_NS - max(0, late_ns)


def run_guardian(guardian: Guardian, heartbeat: Heartbeat, clock: Clock, pipe: int) -> None:
    """Step ``guardian`` until it ends.

    The firmware is dead once its mark in ``heartbeat`` says so or ``pipe`` has no writer, whichever comes first.
    """
    open_pipe = [pipe]
    while guardian.state is not State.DONE:
        pause_s = compute_pause_ns(heartbeat.beat_ns, clock.now_ns()) * 1e-9
        if select.select(open_pipe, (), (), pause_s)[0] and not os.read(pipe, 64):
            open_pipe = []
        guardian.step(alive=bool(open_pipe) and not heartbeat.mark.owner_died)


def main(arguments: list[str]) -> int:
    """Run ``python -m firmware_py.guardian.process SETTINGS`` (JSON). Return the exit status: 0 after a watch, 1 if the
    amplifier cannot be reached, with the reason on standard output."""
    settings = json.loads(arguments[0])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the firmware, not with its terminal
    with suppress(OSError):
        os.sched_setaffinity(0, settings["processors"])
    clock = MonotonicClock()
    try:
        bus = open_i2c(settings["uri"], speed_hz=settings["speed_hz"], exclusive=False)
        part = find_driver(settings["driver"]).leased
        assert part is not None  # the firmware asks for a guardian of such outputs alone
        amplifier = part(bus, clock, **settings["options"])
        amplifier.readback_V()
    except HalError as error:
        sys.stdout.write(f"{error}\n")
        return 1
    firmware = settings["firmware"]
    heartbeat = Heartbeat(settings["heartbeat"])
    guardian = Guardian(
        heartbeat, amplifier, clock, notice_ms=settings["notice_ms"], limit_ms=settings["limit_ms"],
        retry_s=settings["retry_s"],
        kill_firmware=(lambda: signal.pidfd_send_signal(firmware, signal.SIGKILL)) if firmware >= 0 else None,
    )  # fmt: skip
    with realtime(RealtimeConfig(priority=PRIORITY)):
        # only now: a guardian that has reported ready and is silent for 100 ms counts as lost, and the settings may
        # take so long on a busy machine
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        run_guardian(guardian, heartbeat, clock, settings["pipe"])
    report = guardian.report()
    partial = Path(settings["report"] + ".partial")
    with suppress(OSError):  # the run may have removed its folder already
        partial.write_text(json.dumps(report), encoding="utf-8")
        partial.rename(settings["report"])
    if report["why"] != TakeoverReason.NOTHING.name.lower():
        sys.stderr.write(f"micron guardian: {describe(report)}\n")
    return 0


def describe(report: dict[str, Any]) -> str:
    """Return a guardian's report (``Guardian.report``) in words."""
    if report["taken_ns"] is None:
        return "the firmware died with its outputs at neutral; the guardian had nothing to do"
    why = {"died": "the firmware died", "silent": "the loop stood still"}[report["why"]]
    if report["firmware_ended"]:
        why += " in the middle of a command, so its process was ended"
    if not report["exclusive"]:
        why += "; a command of it may have come afterwards"
    if report["neutral_ns"] and report["last_beat_ns"]:
        after_ms = (report["neutral_ns"] - report["last_beat_ns"]) * 1e-6
        return f"{why}; outputs neutral and read back {after_ms:.1f} ms after the last command"
    return f"{why}; neutral NOT confirmed ({report['problem'] or 'no answer'}): switch the amplifier off"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
