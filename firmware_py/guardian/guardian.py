"""Watches the heartbeat, one step a millisecond, and ramps the outputs to neutral when it stops.

Before the guardian moves anything it makes sure that the firmware does not (``gate.py`` has the firmware's half):
either no command is going out, or the one that was going out has arrived, or the firmware's process is dead.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from typing import Any, Protocol

from firmware_py.guardian.heartbeat import Heartbeat, Phase, TakeoverReason
from hal.contracts import Clock
from hal.errors import HalError, I2cNack

STEP_NS = 1_000_000
HOLD_NS = 50_000_000
"""Time after the ramp in which a late command of the firmware is detected by read-back and undone."""
RETRY_S = 10.0
"""Default time for which the ramp is retried while the bus or the amplifier does not answer."""
FAST_RETRY_NS = 40_000_000
"""Time in which every step retries what failed. Then the pauses double, up to ``LONGEST_PAUSE_NS``."""
LONGEST_PAUSE_NS = 10_000_000
STUCK_COMMAND_NS = 5_000_000
"""Age at which a command in flight counts as stuck; its process is then killed."""
LAST_RESORT_NS = 100_000_000
"""Time after the takeover at which the ramp starts even if a command may still come (``exclusive`` is False then)."""
ATTEMPTS = 3
"""Largest number of attempts at a ramp step that is refused (NACK), within one step of the guardian."""


class Output(Protocol):
    """Defines the amplifier on a connection that belongs to the guardian (``DacOutput``)."""

    def safe_step(self) -> bool: ...
    def verify(self) -> str: ...
    def read_codes(self) -> list[int]: ...
    def lose_position(self) -> None: ...


class State(Enum):
    """Names what the guardian does: it watches the heartbeat, waits for a command in flight after it has taken the
    outputs, ramps them, checks that they stay at neutral, or has ended."""

    WATCHING = "watching"
    CLAIMING = "claiming"
    RAMPING = "ramping"
    HOLDING = "holding"
    DONE = "done"


class Guardian:
    """Runs the guardian's state machine; call ``step`` every ``STEP_NS``.

    A beat that is late by ``notice_ms`` is noted, and one that is late by ``limit_ms`` makes the guardian take the
    outputs. ``kill_firmware`` ends the firmware's process; without it the guardian can only wait for a command that is
    stuck. A ramp that fails is retried for ``retry_s``, with growing pauses."""

    def __init__(
        self,
        heartbeat: Heartbeat,
        output: Output,
        clock: Clock,
        *,
        notice_ms: float,
        limit_ms: float,
        kill_firmware: Callable[[], None] | None = None,
        retry_s: float = RETRY_S,
    ) -> None:
        self.state = State.WATCHING
        self.problem = ""
        self.has_killed = False
        self.exclusive = True
        """True unless a command of the firmware may have come after the outputs were taken."""
        self._last: dict[str, Any] | None = None
        self._kill_firmware = kill_firmware
        self._heartbeat = heartbeat
        self._output = output
        self._clock = clock
        self._notice_ns = round(notice_ms * 1e6)
        self._limit_ns = round(limit_ms * 1e6)
        self._retry_ns = round(retry_s * 1e9)
        self._pause_ns = STEP_NS
        self._next_try_ns = 0

    def step(self, alive: bool) -> None:
        """Run one step. ``alive``: the firmware's process exists."""
        self._heartbeat.note_guardian_alive(self._clock.now_ns())
        if self.state is State.WATCHING:
            self._watch(alive)
        elif self.state is State.CLAIMING:
            self._claim(alive)
        if self.state is State.RAMPING:
            self._ramp()
        elif self.state is State.HOLDING:
            self._hold(alive)

    def stop(self) -> None:
        """End the guardian: it sends no command from now on."""
        self.state = State.DONE

    def report(self) -> dict[str, Any]:
        """Return what happened, as JSON values. Times are on the bench clock in ns, ``None`` for what did not happen.
        After several takeovers the report describes the last one."""
        taking = self._describe_takeover() if self._heartbeat.taken_ns or self._last is None else self._last
        return {
            "format": 1,
            **taking,
            "noticed_ns": self._heartbeat.late_beat_ns or None,
            "firmware_ended": self.has_killed,
            "exclusive": self.exclusive,
            "problem": self.problem,
        }

    def _describe_takeover(self) -> dict[str, Any]:
        heartbeat = self._heartbeat
        return {
            "why": heartbeat.reason.name.lower(),
            "last_beat_ns": heartbeat.beat_ns or None,
            "taken_ns": heartbeat.taken_ns or None,
            "neutral_ns": heartbeat.neutral_ns or None,
        }

    def _watch(self, alive: bool) -> None:
        heartbeat, now_ns = self._heartbeat, self._clock.now_ns()
        phase = heartbeat.phase
        if not alive:
            if phase is Phase.IDLE:
                self.state = State.DONE
            else:
                self._take(TakeoverReason.DIED, now_ns)
        elif phase is Phase.YIELDED:
            self._take(TakeoverReason.SILENT, now_ns)
        elif phase is Phase.RUNNING:
            silent_ns = now_ns - heartbeat.beat_ns
            if silent_ns > self._notice_ns:
                heartbeat.note_late_beat(now_ns)
            if silent_ns > self._limit_ns:
                self._take(TakeoverReason.SILENT, now_ns)

    def _take(self, why: TakeoverReason, now_ns: int) -> None:
        """Forbid commands from now on. The next step checks if one has begun."""
        self._heartbeat.take_outputs(why, now_ns)
        self._output.lose_position()
        self._pause_ns, self._next_try_ns = STEP_NS, 0
        self.state = State.RAMPING if why is TakeoverReason.DIED else State.CLAIMING

    def _claim(self, alive: bool) -> None:
        if alive and self._heartbeat.command_in_flight is not None:
            now_ns = self._clock.now_ns()
            waited_ns = now_ns - self._heartbeat.taken_ns
            if now_ns < self._next_try_ns and waited_ns < self._retry_ns:
                return
            try:
                may_come = not self._has_arrived()
            except HalError as error:
                # the bus does not answer, so the firmware does not stand still: its transfer waits, too
                self.problem = str(error)
                self._pause()
                if waited_ns < self._retry_ns:
                    return
                may_come = True
            if may_come:
                if waited_ns > STUCK_COMMAND_NS and self._kill_firmware is not None and not self.has_killed:
                    self.has_killed = True
                    self._kill_firmware()
                if waited_ns < LAST_RESORT_NS:
                    return
                self.exclusive = False
        self._output.lose_position()
        self._begin_ramp()

    def _has_arrived(self) -> bool:
        """Return True if the DAC holds the command in flight, so that nothing is still to come. A command that repeats
        the previous one cannot be distinguished from one that was not sent, and counts as not arrived."""
        command = self._heartbeat.command_in_flight
        return command is not None and not command.repeats and self._output.read_codes() == list(command.codes)

    def _begin_ramp(self) -> None:
        self.state = State.RAMPING
        self._pause_ns, self._next_try_ns = STEP_NS, 0

    def _pause(self) -> None:
        """Delay the next attempt after a failure: by one step during ``FAST_RETRY_NS``, then by growing pauses."""
        now_ns = self._clock.now_ns()
        if now_ns - self._heartbeat.taken_ns > FAST_RETRY_NS:
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        self._next_try_ns = now_ns + self._pause_ns - STEP_NS // 2

    def _ramp(self) -> None:
        now_ns = self._clock.now_ns()
        if now_ns < self._next_try_ns:
            return
        for _ in range(ATTEMPTS):
            begun_ns = self._clock.now_ns()
            try:
                if self._output.safe_step():
                    self.problem = ""
                    self._heartbeat.note_neutral(self._clock.now_ns())
                    self._heartbeat.confirm_neutral(begun_ns)
                    self.state = State.HOLDING
                self._pause_ns = STEP_NS
            except HalError as error:
                self.problem = str(error)
                if isinstance(error, I2cNack):
                    continue
                self._pause()
            break
        else:
            self._pause()
        if self.state is State.RAMPING and now_ns - self._heartbeat.taken_ns > self._retry_ns:
            self.state = State.DONE

    def _hold(self, alive: bool) -> None:
        heartbeat, begun_ns = self._heartbeat, self._clock.now_ns()
        with suppress(HalError):  # neutral has been read back once; this detects a late command
            if self._output.verify():
                heartbeat.clear_neutral()
                self._output.lose_position()
                self._begin_ramp()
                return
            heartbeat.confirm_neutral(begun_ns)
        if self._clock.now_ns() - heartbeat.neutral_ns <= HOLD_NS:
            return
        wanted = heartbeat.requested_ns > heartbeat.taken_ns
        if not alive or (heartbeat.phase is Phase.IDLE and not wanted):
            self.state = State.DONE
        elif heartbeat.phase is Phase.IDLE and heartbeat.command_in_flight is None:
            self._last = self._describe_takeover()
            self.state = State.WATCHING
            heartbeat.return_outputs()
