"""The guardian's process and its handle in the firmware.

The firmware's loop holds a mark in shared memory (``mark.py``) and the writing end of a pipe. When it dies, by whatever
cause, the kernel sets the mark at once, which the guardian looks at every millisecond, and closes the pipe once it has
freed the firmware's memory, which takes tens of milliseconds. That the firmware stands still is seen in the heartbeat.
The guardian has its own connection to the amplifier's bus, opened at the start; it outlives the firmware, and ends when
the outputs are neutral and stay so.
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
from firmware_py.guardian.care import start_failed
from firmware_py.guardian.guardian import STEP_NS, Guardian, State
from firmware_py.guardian.heart import Heart, Why
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from hal.backends import open_i2c
from hal.children import child_command, child_environment
from hal.clock import MonotonicClock
from hal.contracts import Clock
from hal.errors import HalError, OpenFailed

PRIORITY = 85  # above the loop: it does almost nothing, but must do it while the loop is stuck
LOOK_NS = 200_000
"""The guardian looks so long after a command began: the loop then waits for its bus, and nobody computes. A step at
another time takes the processor from the loop or from what it waits for."""
START_S = 30.0
END_S = 5.0
"""Time that the guardian may take to end beyond its retries."""
END_POLL_S = 0.002
REPORT = "guardian.json"
STARTED = "guardian.started"
"""There is a guardian; the file holds the seconds for which it may try to reach neutral."""


class GuardianProcess:
    """``Keeper`` of a guardian in a process of its own. Start it before real-time settings are made.

    ``order``: uri, speed_hz, driver and options of the output, notice_ms, limit_ms, retry_s; see ``main``. The guardian
    starts at once; ``await_ready`` says whether it came up. ``may_end_us``: this process is the firmware and nothing
    else, and may be killed when it stands still within a command.
    """

    def __init__(self, order: dict[str, Any], runtime_dir: Path, *, may_end_us: bool = False) -> None:
        self.heart = Heart.shared()
        self.heart.mark.hold()
        # the loop may be pinned to a processor when a guardian is replaced, which is not to be its guardian's
        self._order: dict[str, Any] = {**order, "processors": sorted(os.sched_getaffinity(0))}
        self._report = runtime_dir / REPORT
        self._may_end_us = may_end_us
        self._is_ready = False
        (runtime_dir / STARTED).write_text(str(order["retry_s"]), encoding="utf-8")
        self._process, self._pipe = self._start()

    def _start(self) -> tuple[subprocess.Popen[bytes], int]:
        assert self.heart.fd is not None
        guardian_end, own_end = os.pipe()
        ourselves = os.pidfd_open(os.getpid()) if self._may_end_us else -1
        order = {**self._order, "heart": self.heart.fd, "pipe": guardian_end, "firmware": ourselves}
        process = subprocess.Popen(
            child_command("firmware_py.guardian.process", json.dumps({**order, "report": str(self._report)})),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=(self.heart.fd, guardian_end, *((ourselves,) if self._may_end_us else ())),
            env=child_environment(),
            start_new_session=True,  # Ctrl-C is for the firmware
        )
        os.close(guardian_end)
        if self._may_end_us:
            os.close(ourselves)
        return process, own_end

    @property
    def pid(self) -> int:
        """Process id of the guardian, for tests that kill it."""
        return self._process.pid

    def is_alive(self) -> bool:
        return self._is_ready and self._process.poll() is None

    def await_ready(self) -> None:
        """Raises ``OpenFailed`` when the guardian has no way to the amplifier."""
        try:
            if not self._has_come_up(START_S):
                raise start_failed(f"no word from it within {START_S:g} s")
        except HalError as error:
            self.stop()
            raise OpenFailed([error]) from error

    def came_up(self) -> bool:
        return self._has_come_up(0.0)

    def _has_come_up(self, timeout_s: float) -> bool:
        assert self._process.stdout is not None
        if not select.select([self._process.stdout], (), (), timeout_s)[0]:
            return False
        line = self._process.stdout.readline().decode().strip()
        if line != "ready":
            raise start_failed(line or "it ended without a word")
        self._is_ready = True
        return True

    def evict(self) -> None:
        """End it now; it commands nothing any more when this returns."""
        self._process.kill()
        self._process.wait()

    def replace(self) -> None:
        """End it and begin to start another one, which ``came_up`` asks for."""
        self.evict()
        assert self._process.stdout is not None
        self._process.stdout.close()
        os.close(self._pipe)
        self.heart.forget_guardian()
        self._is_ready = False
        self._process, self._pipe = self._start()

    def stop(self, hurry: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Let it go once the outputs are at rest; what it reports, ``None`` if it cannot any more. Idempotent.

        When the caller is in a ``hurry``, the guardian goes on alone and its report is not waited for.
        """
        if self._pipe >= 0:
            os.close(self._pipe)
            self._pipe = -1
            self.heart.mark.release()
            deadline_s = time.monotonic() + self._order["retry_s"] + END_S
            while self._process.poll() is None and not hurry():
                if time.monotonic() > deadline_s:
                    self.evict()
                time.sleep(END_POLL_S)
            assert self._process.stdout is not None
            self._process.stdout.close()
        with suppress(OSError, ValueError):
            return json.loads(self._report.read_text(encoding="utf-8"))
        return None


def pause_ns(beat_ns: int, now_ns: int) -> int:
    """Return the time to the next step: a millisecond, or up to half of one less, so that the steps come ``LOOK_NS``
    after a command began."""
    late_ns = (now_ns - beat_ns - LOOK_NS + STEP_NS // 2) % STEP_NS - STEP_NS // 2
    return STEP_NS - max(0, late_ns)


def serve(guardian: Guardian, heart: Heart, clock: Clock, pipe: int) -> None:
    """Step ``guardian`` until the outputs need none any more.

    The firmware is dead when the mark of ``heart`` says so or ``pipe`` has no writer any more, whichever comes first.
    """
    open_pipe = [pipe]
    while guardian.state is not State.DONE:
        pause_s = pause_ns(heart.beat_ns, clock.now_ns()) * 1e-9
        if select.select(open_pipe, (), (), pause_s)[0] and not os.read(pipe, 64):
            open_pipe = []
        guardian.step(alive=bool(open_pipe) and not heart.mark.owner_died)


def main(arguments: list[str]) -> int:
    """``python -m firmware_py.guardian.process ORDER`` (JSON)."""
    order = json.loads(arguments[0])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the firmware, not with its terminal
    with suppress(OSError):
        os.sched_setaffinity(0, order["processors"])
    clock = MonotonicClock()
    try:
        bus = open_i2c(order["uri"], speed_hz=order["speed_hz"], exclusive=False)
        part = find_driver(order["driver"]).leased
        assert part is not None  # the firmware asks for a guardian of such outputs alone
        amplifier = part(bus, clock, **order["options"])
        amplifier.readback_V()
    except HalError as error:
        sys.stdout.write(f"{error}\n")
        return 1
    firmware = order["firmware"]
    heart = Heart(order["heart"])
    guardian = Guardian(
        heart, amplifier, clock, notice_ms=order["notice_ms"], limit_ms=order["limit_ms"],
        retry_s=order["retry_s"],
        end=(lambda: signal.pidfd_send_signal(firmware, signal.SIGKILL)) if firmware >= 0 else None,
    )  # fmt: skip
    with realtime(RealtimeConfig(priority=PRIORITY)):
        # not before: from its word on a guardian that is silent for 100 ms counts as lost, and the settings may take so
        # long on a busy machine
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        serve(guardian, heart, clock, order["pipe"])
    report = guardian.report()
    partial = Path(order["report"] + ".partial")
    with suppress(OSError):  # whoever wanted it may have cleaned up
        partial.write_text(json.dumps(report), encoding="utf-8")
        partial.rename(order["report"])
    if report["why"] != Why.NOTHING.name.lower():
        sys.stderr.write(f"micron guardian: {describe(report)}\n")
    return 0


def describe(report: dict[str, Any]) -> str:
    """A report in words."""
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
