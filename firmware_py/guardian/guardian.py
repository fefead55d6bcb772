"""What the guardian does, one step a millisecond: watch the heartbeat, and when it is gone ramp to neutral."""

from __future__ import annotations

from contextlib import suppress
from enum import Enum
from typing import Any, Protocol

from firmware_py.guardian.heart import Heart, Phase, Why
from hal.contracts import Clock
from hal.errors import HalError, I2cNack

STEP_NS = 1_000_000
HOLD_NS = 50_000_000
"""A command that the firmware had under way may still arrive after the ramp: so long it is looked for and undone."""
GIVE_UP_NS = 2_000_000_000
ATTEMPTS = 3


class Output(Protocol):
    """The amplifier by a way of the guardian's own."""

    def safe_step(self) -> bool: ...
    def verify(self) -> str: ...
    def lose_position(self) -> None: ...


class State(Enum):
    WATCHING = "watching"
    RAMPING = "ramping"
    HOLDING = "holding"
    DONE = "done"


class Guardian:
    """``notice_ms`` without a beat is remembered, ``limit_ms`` without one takes the outputs."""

    def __init__(self, heart: Heart, output: Output, clock: Clock, *, notice_ms: float, limit_ms: float) -> None:
        self.state = State.WATCHING
        self.problem = ""
        self._heart = heart
        self._output = output
        self._clock = clock
        self._notice_ns = round(notice_ms * 1e6)
        self._limit_ns = round(limit_ms * 1e6)

    def step(self, alive: bool) -> None:
        """``alive``: the firmware's process exists."""
        if self.state is State.WATCHING:
            self._watch(alive)
        if self.state is State.RAMPING:
            self._ramp()
        elif self.state is State.HOLDING:
            self._hold(alive)

    def report(self) -> dict[str, Any]:
        """What happened, JSON values; times on the bench clock in ns, ``None``: did not happen."""
        heart = self._heart
        return {
            "format": 1,
            "why": heart.why.name.lower(),
            "last_beat_ns": heart.beat_ns or None,
            "noticed_ns": heart.noticed_ns or None,
            "taken_ns": heart.taken_ns or None,
            "neutral_ns": heart.reached_ns or None,
            "problem": self.problem,
        }

    def _watch(self, alive: bool) -> None:
        heart, now_ns = self._heart, self._clock.now_ns()
        phase = heart.phase
        if not alive:
            if phase is Phase.IDLE:
                self.state = State.DONE
            else:
                self._take(Why.DIED, now_ns)
        elif phase is Phase.RUNNING:
            silent_ns = now_ns - heart.beat_ns
            if silent_ns > self._notice_ns:
                heart.notice(now_ns)
            if silent_ns > self._limit_ns:
                self._take(Why.SILENT, now_ns)

    def _take(self, why: Why, now_ns: int) -> None:
        self._heart.take(why, now_ns)
        self._output.lose_position()
        self.state = State.RAMPING

    def _ramp(self) -> None:
        now_ns = self._clock.now_ns()
        for _ in range(ATTEMPTS):
            try:
                if self._output.safe_step():
                    self.problem = ""
                    self._heart.reach(self._clock.now_ns())
                    self.state = State.HOLDING
            except HalError as error:
                self.problem = str(error)
                if isinstance(error, I2cNack):
                    continue
            break
        if self.state is State.RAMPING and now_ns - self._heart.taken_ns > GIVE_UP_NS:
            self.state = State.DONE

    def _hold(self, alive: bool) -> None:
        with suppress(HalError):  # it has been read back once; this is for what comes after
            if self._output.verify():
                self._output.lose_position()
                self.state = State.RAMPING
                return
        held_ns = self._clock.now_ns() - self._heart.reached_ns
        if held_ns > HOLD_NS and (not alive or self._heart.phase is Phase.IDLE):
            self.state = State.DONE
