"""After its ramp the guardian goes on looking: a command that arrives late is undone, for ``HOLD_NS`` and no longer.

Mutations that this file finds: the look left out, its result ignored, the position believed, the hold shortened to
nothing or without end, an error of one look taken for the end.
"""

from __future__ import annotations

import pytest

from firmware_py.guardian.guardian import HOLD_NS, STEP_NS, Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat, TakeoverReason
from hal.clock import VirtualClock
from hal.errors import HalTimeout

NEUTRAL, DRIVEN, STEP = 100, 180, 20


class Dac:
    """One output with a ramp that goes on from where it believes to be, as the amplifier's does."""

    def __init__(self) -> None:
        self.held = DRIVEN
        self.believed: int | None = None
        self.deaf = False
        self.looks = 0

    def safe_step(self) -> bool:
        at = self.held if self.believed is None else self.believed
        self.believed = at + max(-STEP, min(STEP, NEUTRAL - at))
        if self.believed != at:
            self.held = self.believed
        return self.believed == NEUTRAL

    def verify(self) -> str:
        self.looks += 1
        if self.deaf:
            raise HalTimeout("no answer")
        return "" if self.held == NEUTRAL else f"holds {self.held}"

    def read_codes(self) -> list[int]:
        return [self.held]

    def lose_position(self) -> None:
        self.believed = None


class Bench:
    """A guardian whose firmware has died, stepped once a millisecond in virtual time."""

    def __init__(self) -> None:
        self.clock, self.heartbeat, self.dac = VirtualClock(10_000_000), Heartbeat(), Dac()
        self.heartbeat.beat(self.clock.now_ns())
        self.guardian = Guardian(self.heartbeat, self.dac, self.clock, notice_ms=3.0, limit_ms=16.0)
        self.guardian._take(TakeoverReason.DIED, self.clock.now_ns())

    def step(self) -> None:
        self.guardian.step(alive=False)
        self.clock.advance_to(self.clock.now_ns() + STEP_NS)

    def ramp(self) -> None:
        for _ in range(20):
            if self.guardian.state is State.HOLDING:
                return
            self.step()
        raise AssertionError("no neutral")


@pytest.fixture
def bench() -> Bench:
    found = Bench()
    found.ramp()
    assert found.dac.held == NEUTRAL
    return found


@pytest.mark.parametrize("late_ms", [1, 20, HOLD_NS // STEP_NS - 2])
def test_a_command_that_arrives_late_is_undone(bench: Bench, late_ms: int) -> None:
    for _ in range(late_ms):
        bench.step()
    assert bench.guardian.state is State.HOLDING
    bench.dac.held = DRIVEN
    bench.step()
    assert bench.guardian.state is State.RAMPING
    bench.ramp()
    assert bench.dac.held == NEUTRAL


def test_it_looks_at_every_step_and_ends_after_the_hold(bench: Bench) -> None:
    steps = 0
    while bench.guardian.state is not State.DONE:
        before = bench.dac.looks
        bench.step()
        steps += 1
        assert bench.dac.looks == before + 1
        assert steps < 1000
    assert steps * STEP_NS == pytest.approx(HOLD_NS, abs=2 * STEP_NS)


def test_the_hold_begins_anew_with_every_ramp(bench: Bench) -> None:
    for _ in range(40):
        bench.step()
    bench.dac.held = DRIVEN
    bench.step()
    bench.ramp()
    for _ in range(40):
        bench.step()
    assert bench.guardian.state is State.HOLDING
    bench.dac.held = DRIVEN
    bench.step()
    bench.ramp()
    assert bench.dac.held == NEUTRAL


def test_a_look_that_fails_is_repeated(bench: Bench) -> None:
    bench.dac.deaf = True
    bench.step()
    assert bench.guardian.state is State.HOLDING
    bench.dac.deaf, bench.dac.held = False, DRIVEN
    bench.step()
    bench.ramp()
    assert bench.dac.held == NEUTRAL
