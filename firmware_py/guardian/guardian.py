"""The guardian watches the heartbeat, one step a millisecond, and ramps the outputs to neutral when it is gone.

Before it moves anything it makes sure that the firmware does not (``gate.py`` has the firmware's half): either no
command is going out, or the one that was going out has arrived, or the firmware's process is dead.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from typing import Any, Protocol

from firmware_py.guardian.heart import Heart, Phase, Why
from hal.contracts import Clock
from hal.errors import HalError, I2cNack

STEP_NS = 1_000_000
HOLD_NS = 50_000_000
"""Time after the ramp in which a command that the firmware had under way is looked for and undone."""
RETRY_S = 10.0
"""Time for which the ramp is retried while the bus or the amplifier does not answer."""
EAGER_NS = 40_000_000
"""Time for which every step retries what failed; after it the pauses double, up to ``LONGEST_PAUSE_NS``."""
LONGEST_PAUSE_NS = 10_000_000
CLAIM_NS = 5_000_000
"""A command that has been going out for so long will not arrive by itself: its process is ended."""
LAST_RESORT_NS = 100_000_000
"""Outputs do not stay where they are for ever because nobody can say whether a command is still to come."""
ATTEMPTS = 3


class Output(Protocol):
    """The amplifier by a way of the guardian's own."""

    def safe_step(self) -> bool: ...
    def verify(self) -> str: ...
    def read_codes(self) -> list[int]: ...
    def lose_position(self) -> None: ...


class State(Enum):
    WATCHING = "watching"
    CLAIMING = "claiming"
    RAMPING = "ramping"
    HOLDING = "holding"
    DONE = "done"


class Guardian:
    """``notice_ms`` without a beat is remembered, ``limit_ms`` without one takes the outputs. ``end`` kills the
    firmware's process; without it one that stands still within a command can only be waited for. What the bus refuses
    is tried again for ``retry_s``, longer and longer apart."""

    def __init__(
        self,
        heart: Heart,
        output: Output,
        clock: Clock,
        *,
        notice_ms: float,
        limit_ms: float,
        end: Callable[[], None] | None = None,
        retry_s: float = RETRY_S,
    ) -> None:
        self.state = State.WATCHING
        self.problem = ""
        self.ended = False
        self.exclusive = True
        """True when no command of the firmware can have come after the outputs were taken."""
        self._last: dict[str, Any] | None = None
        self._end = end
        self._heart = heart
        self._output = output
        self._clock = clock
        self._notice_ns = round(notice_ms * 1e6)
        self._limit_ns = round(limit_ms * 1e6)
        self._retry_ns = round(retry_s * 1e9)
        self._pause_ns = STEP_NS
        self._next_try_ns = 0

    def step(self, alive: bool) -> None:
        """``alive``: the firmware's process exists."""
        self._heart.watch(self._clock.now_ns())
        if self.state is State.WATCHING:
            self._watch(alive)
        elif self.state is State.CLAIMING:
            self._claim(alive)
        if self.state is State.RAMPING:
            self._ramp()
        elif self.state is State.HOLDING:
            self._hold(alive)

    def retire(self) -> None:
        """Command nothing any more."""
        self.state = State.DONE

    def report(self) -> dict[str, Any]:
        """Return what happened, as JSON values. Times are those of the bench clock in ns; ``None``: it did not happen.
        Where the outputs were taken several times, the report is of the last one."""
        taking = self._taking() if self._heart.taken_ns or self._last is None else self._last
        return {
            "format": 1,
            **taking,
            "noticed_ns": self._heart.noticed_ns or None,
            "firmware_ended": self.ended,
            "exclusive": self.exclusive,
            "problem": self.problem,
        }

    def _taking(self) -> dict[str, Any]:
        heart = self._heart
        return {
            "why": heart.why.name.lower(),
            "last_beat_ns": heart.beat_ns or None,
            "taken_ns": heart.taken_ns or None,
            "neutral_ns": heart.reached_ns or None,
        }

    def _watch(self, alive: bool) -> None:
        heart, now_ns = self._heart, self._clock.now_ns()
        phase = heart.phase
        if not alive:
            if phase is Phase.IDLE:
                self.state = State.DONE
            else:
                self._take(Why.DIED, now_ns)
        elif phase is Phase.YIELDED:
            self._take(Why.SILENT, now_ns)
        elif phase is Phase.RUNNING:
            silent_ns = now_ns - heart.beat_ns
            if silent_ns > self._notice_ns:
                heart.notice(now_ns)
            if silent_ns > self._limit_ns:
                self._take(Why.SILENT, now_ns)

    def _take(self, why: Why, now_ns: int) -> None:
        """Let no command begin from now on. The next step checks if one had begun."""
        self._heart.take(why, now_ns)
        self._output.lose_position()
        self._pause_ns, self._next_try_ns = STEP_NS, 0
        self.state = State.RAMPING if why is Why.DIED else State.CLAIMING

    def _claim(self, alive: bool) -> None:
        if alive and self._heart.inside is not None:
            now_ns = self._clock.now_ns()
            waited_ns = now_ns - self._heart.taken_ns
            if now_ns < self._next_try_ns and waited_ns < self._retry_ns:
                return
            try:
                may_come = not self._arrived()
            except HalError as error:
                # the bus answers nobody, so the firmware does not stand still: its transfer waits, as ours would
                self.problem = str(error)
                self._pause()
                if waited_ns < self._retry_ns:
                    return
                may_come = True
            if may_come:
                if waited_ns > CLAIM_NS and self._end is not None and not self.ended:
                    self.ended = True
                    self._end()
                if waited_ns < LAST_RESORT_NS:
                    return
                self.exclusive = False
        self._output.lose_position()
        self._begin_ramp()

    def _arrived(self) -> bool:
        """The command that the firmware stands in is the one that the DAC holds: nothing is still to come. One that
        does not change anything cannot be told from one that has not been sent, and counts as not arrived."""
        ordered = self._heart.inside
        return ordered is not None and not ordered.repeats and self._output.read_codes() == list(ordered.codes)

    def _begin_ramp(self) -> None:
        self.state = State.RAMPING
        self._pause_ns, self._next_try_ns = STEP_NS, 0

    def _pause(self) -> None:
        """Something failed: try again after a pause, eagerly at first."""
        now_ns = self._clock.now_ns()
        if now_ns - self._heart.taken_ns > EAGER_NS:
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
                    self._heart.reach(self._clock.now_ns())
                    self._heart.confirm(begun_ns)
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
        if self.state is State.RAMPING and now_ns - self._heart.taken_ns > self._retry_ns:
            self.state = State.DONE

    def _hold(self, alive: bool) -> None:
        heart, begun_ns = self._heart, self._clock.now_ns()
        with suppress(HalError):  # it has been read back once; this is for what comes after
            if self._output.verify():
                heart.lose_neutral()
                self._output.lose_position()
                self._begin_ramp()
                return
            heart.confirm(begun_ns)
        if self._clock.now_ns() - heart.reached_ns <= HOLD_NS:
            return
        wanted = heart.asked_ns > heart.taken_ns
        if not alive or (heart.phase is Phase.IDLE and not wanted):
            self.state = State.DONE
        elif heart.phase is Phase.IDLE and heart.inside is None:
            self._last = self._taking()
            self.state = State.WATCHING
            heart.give_back()
