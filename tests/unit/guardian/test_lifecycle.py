"""The firmware replaces a guardian that is gone or silent, and arms no output without one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from firmware_py.guardian.guardian import State
from firmware_py.guardian.heartbeat import Phase, TakeoverReason
from firmware_py.guardian.lifecycle import SILENT_PASSES, START_LIMIT_NS, GuardianLifecycle, start_error
from hal.errors import HalError, SafetyTrip
from tests.unit.guardian.handle import FakeHandle
from tests.unit.guardian.test_guardian import Stand

PASS_NS = 10_000_000


def cared() -> tuple[FakeHandle, GuardianLifecycle]:
    handle = FakeHandle()
    return handle, GuardianLifecycle(handle)


def test_a_death_is_known_at_the_next_look():
    handle, lifecycle = cared()
    handle.heartbeat.note_guardian_alive(1)
    assert not lifecycle.check()
    assert lifecycle.describe() == {"watching": True, "replaced": 0}
    handle.alive = False
    assert lifecycle.check() == "its process has ended"
    assert not lifecycle.describe()["watching"]


def test_the_end_of_a_run_is_no_loss():
    handle, lifecycle = cared()
    handle.heartbeat.note_guardian_alive(1)
    lifecycle.check()
    assert lifecycle.stop(lambda: False) == {"why": "nothing"}
    assert lifecycle.describe() == {"watching": True, "replaced": 0}


def test_silence_counts_in_passes_and_not_while_the_guardian_has_the_outputs():
    handle, lifecycle = cared()
    for k in range(5):
        handle.heartbeat.note_guardian_alive(1000 + k)
        assert not lifecycle.check()
    for _ in range(SILENT_PASSES - 1):
        assert not lifecycle.check()
    assert lifecycle.check() == "it has not been heard for 100 ms"
    handle.heartbeat.note_guardian_alive(5000)  # it was only slow
    assert not lifecycle.check()
    handle.heartbeat.take_outputs(TakeoverReason.SILENT, 6000)
    assert not any(lifecycle.check() for _ in range(3 * SILENT_PASSES))


def test_a_new_one_is_started_once_and_waited_for():
    handle, lifecycle = cared()
    assert lifecycle.restore(0) == ""
    handle.alive = False
    for k in range(4):
        assert lifecycle.restore(k * PASS_NS) == "a new guardian of the outputs"
        assert lifecycle.check()
    assert handle.started == 1
    handle.ready = True
    assert lifecycle.restore(5 * PASS_NS) == ""
    handle.heartbeat.note_guardian_alive(1)
    assert not lifecycle.check()
    assert lifecycle.describe() == {"watching": True, "replaced": 1}


def test_one_that_does_not_come_is_an_error():
    handle, lifecycle = cared()
    handle.alive = False
    lifecycle.restore(0)
    assert lifecycle.restore(START_LIMIT_NS)
    with pytest.raises(HalError, match="no word from it within 10 s"):
        lifecycle.restore(START_LIMIT_NS + 1)
    handle.error = start_error("no such bus")
    with pytest.raises(HalError, match="the guardian of the outputs did not start: no such bus"):
        lifecycle.restore(0)


def test_what_a_dead_guardian_said_of_the_outputs_is_void():
    handle, _ = cared()
    heartbeat = handle.heartbeat
    heartbeat.note_late_beat(3)
    heartbeat.take_outputs(TakeoverReason.SILENT, 4)
    heartbeat.note_neutral(5)
    heartbeat.request_outputs(6)
    heartbeat.set_phase(Phase.IDLE)
    handle.begin_replacement()
    assert (heartbeat.taken_ns, heartbeat.neutral_ns, heartbeat.requested_ns, heartbeat.reason) == (
        0,
        0,
        0,
        TakeoverReason.NOTHING,
    )
    assert (heartbeat.late_beat_ns, heartbeat.phase) == (3, Phase.IDLE)


@pytest.mark.parametrize("how", ["dead", "silent"])
def test_without_a_living_guardian_nothing_is_armed(how: str):
    stand = Stand()
    stand.tick()
    if how == "dead":
        stand.guardian.stop()
    else:
        stand.clock.burn_ns(20_000_000)
    began_ns = stand.clock.now_ns()
    with pytest.raises(SafetyTrip, match="no guardian watches over them"):
        stand.amplifier.arm()
    assert (stand.path, stand.heartbeat.phase) == ([], Phase.IDLE)
    assert stand.clock.now_ns() - began_ns <= 202_000_000


def test_a_guardian_that_was_late_gives_a_sign_of_life_and_the_outputs_are_armed():
    stand = Stand()
    stand.tick()
    stand.clock.burn_ns(20_000_000)
    stand.clock.at(stand.clock.now_ns() + 5_000_000, lambda t_ns: stand.heartbeat.note_guardian_alive(t_ns))
    stand.amplifier.arm()
    stand.amplifier.write(np.array([51.0, 50.0, 50.0]))


def test_a_dead_guardian_is_not_waited_for():
    stand = Stand()
    stand.moving()
    stand.clock.burn_ns(50_000_000)
    stand.guardian.stop()
    steps = 0
    with pytest.raises(SafetyTrip):
        stand.amplifier.write(np.array([51.0, 50.0, 50.0]))
    while not stand.amplifier.safe_step():
        stand.clock.burn_ns(1_000_000)
        steps += 1
    assert steps <= 16
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_a_guardian_that_sees_the_wish_with_the_rest_does_not_take_its_leave():
    """The firmware wakes long after the guardian reached neutral, and the guardian looks at every one of its words."""
    stand = Stand()
    stand.moving()
    for _ in range(150):
        stand.tick()
    heartbeat: Any = stand.heartbeat
    say = heartbeat.set_phase

    def look_after(phase: Phase) -> None:
        say(phase)
        stand.guardian.step(True)

    heartbeat.set_phase = look_after
    assert stand.amplifier.safe_step()
    assert stand.guardian.state is State.WATCHING
