"""What the firmware does about a guardian that is gone, is silent or does not come back; nobody arms without one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from firmware_py.guardian.care import SILENT_PASSES, START_LIMIT_NS, GuardianCare, start_failed
from firmware_py.guardian.guardian import State
from firmware_py.guardian.heart import Phase, Why
from hal.errors import HalError, SafetyTrip
from tests.unit.guardian.keeper import Kept
from tests.unit.guardian.test_guardian import Stand

PASS_NS = 10_000_000


def cared() -> tuple[Kept, GuardianCare]:
    keeper = Kept()
    return keeper, GuardianCare(keeper)


def test_a_death_is_known_at_the_next_look():
    keeper, care = cared()
    keeper.heart.watch(1)
    assert not care.look()
    assert care.describe() == {"watching": True, "replaced": 0}
    keeper.alive = False
    assert care.look() == "its process has ended"
    assert not care.describe()["watching"]


def test_the_end_of_a_run_is_no_loss():
    keeper, care = cared()
    keeper.heart.watch(1)
    care.look()
    assert care.finish(lambda: False) == {"why": "nothing"}
    assert care.describe() == {"watching": True, "replaced": 0}


def test_silence_counts_in_passes_and_not_while_the_guardian_has_the_outputs():
    keeper, care = cared()
    for k in range(5):
        keeper.heart.watch(1000 + k)
        assert not care.look()
    for _ in range(SILENT_PASSES - 1):
        assert not care.look()
    assert care.look() == "it has not been heard for 100 ms"
    keeper.heart.watch(5000)  # it was only slow
    assert not care.look()
    keeper.heart.take(Why.SILENT, 6000)
    assert not any(care.look() for _ in range(3 * SILENT_PASSES))


def test_a_new_one_is_started_once_and_waited_for():
    keeper, care = cared()
    assert care.restore(0) == ""
    keeper.alive = False
    for k in range(4):
        assert care.restore(k * PASS_NS) == "a new guardian of the outputs"
        assert care.look()
    assert keeper.started == 1
    keeper.ready = True
    assert care.restore(5 * PASS_NS) == ""
    keeper.heart.watch(1)
    assert not care.look()
    assert care.describe() == {"watching": True, "replaced": 1}


def test_one_that_does_not_come_is_an_error():
    keeper, care = cared()
    keeper.alive = False
    care.restore(0)
    assert care.restore(START_LIMIT_NS)
    with pytest.raises(HalError, match="no word from it within 10 s"):
        care.restore(START_LIMIT_NS + 1)
    keeper.error = start_failed("no such bus")
    with pytest.raises(HalError, match="the guardian of the outputs did not start: no such bus"):
        care.restore(0)


def test_what_a_dead_guardian_said_of_the_outputs_is_void():
    keeper, _ = cared()
    heart = keeper.heart
    heart.notice(3)
    heart.take(Why.SILENT, 4)
    heart.reach(5)
    heart.ask_back(6)
    heart.say(Phase.IDLE)
    keeper.replace()
    assert (heart.taken_ns, heart.reached_ns, heart.asked_ns, heart.why) == (0, 0, 0, Why.NOTHING)
    assert (heart.noticed_ns, heart.phase) == (3, Phase.IDLE)


@pytest.mark.parametrize("how", ["dead", "silent"])
def test_without_a_living_guardian_nothing_is_armed(how: str):
    stand = Stand()
    stand.tick()
    if how == "dead":
        stand.guardian.retire()
    else:
        stand.clock.burn_ns(20_000_000)
    began_ns = stand.clock.now_ns()
    with pytest.raises(SafetyTrip, match="no guardian watches over them"):
        stand.amplifier.arm()
    assert (stand.path, stand.heart.phase) == ([], Phase.IDLE)
    assert stand.clock.now_ns() - began_ns <= 202_000_000


def test_a_guardian_that_was_late_gives_a_sign_of_life_and_the_outputs_are_armed():
    stand = Stand()
    stand.tick()
    stand.clock.burn_ns(20_000_000)
    stand.clock.at(stand.clock.now_ns() + 5_000_000, lambda t_ns: stand.heart.watch(t_ns))
    stand.amplifier.arm()
    stand.amplifier.write(np.array([51.0, 50.0, 50.0]))


def test_a_dead_guardian_is_not_waited_for():
    stand = Stand()
    stand.moving()
    stand.clock.burn_ns(50_000_000)
    stand.guardian.retire()
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
    heart: Any = stand.heart
    say = heart.say

    def look_after(phase: Phase) -> None:
        say(phase)
        stand.guardian.step(True)

    heart.say = look_after
    assert stand.amplifier.safe_step()
    assert stand.guardian.state is State.WATCHING
