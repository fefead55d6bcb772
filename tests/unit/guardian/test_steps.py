"""Single steps of the guardian and of the firmware's gate, with an output that does what the test says."""

from __future__ import annotations

import pytest

from firmware_py.guardian.gate import LeaseGate
from firmware_py.guardian.guardian import HOLD_NS, LONGEST_PAUSE_NS, RETRY_S, STEP_NS, STUCK_COMMAND_NS, Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat, Phase, TakeoverReason
from hal.clock import VirtualClock
from hal.errors import HalError, HalTimeout, I2cNack, SafetyTrip
from tests.unit.guardian.handle import begin_command

MS = 1_000_000
START_NS = 7_000 * MS


class Output:
    """``steps`` to neutral; ``errors`` come first, one a call."""

    def __init__(self, steps: int = 3, errors: tuple[HalError, ...] = (), *, deaf: bool = False) -> None:
        self.steps, self.errors, self.deaf = steps, list(errors), deaf
        self.asked = 0

    def safe_step(self) -> bool:
        self.asked += 1
        if self.errors:
            raise self.errors.pop(0)
        if self.deaf:
            raise HalTimeout("no answer")
        self.steps -= 1
        return self.steps <= 0

    def verify(self) -> str:
        return ""

    def read_codes(self) -> list[int]:
        if self.deaf:
            raise HalTimeout("no answer")
        return [9, 9, 9]

    def lose_position(self) -> None:
        pass


class Stand:
    def __init__(self, output: Output) -> None:
        self.clock = VirtualClock()
        self.clock.burn_ns(START_NS)
        self.heartbeat, self.output, self.ended = Heartbeat(), output, 0
        self.guardian = Guardian(
            self.heartbeat,
            output,
            self.clock,
            notice_ms=8.0,
            limit_ms=41.0,
            kill_firmware=lambda: setattr(self, "ended", 1),
        )
        self.heartbeat.set_phase(Phase.RUNNING)
        self.heartbeat.beat(START_NS)

    def pass_ms(self, count: int, *, alive: bool = True) -> None:
        for _ in range(count):
            self.guardian.step(alive)
            self.clock.burn_ns(STEP_NS)


def nack() -> I2cNack:
    return I2cNack("no acknowledge")


def test_the_dead_are_ramped_in_the_step_that_finds_them() -> None:
    stand = Stand(Output())
    stand.pass_ms(1, alive=False)
    assert stand.output.asked == 1


def test_what_is_refused_is_tried_three_times_a_step_and_other_errors_once() -> None:
    stand = Stand(Output(errors=(nack(), nack())))
    stand.pass_ms(1, alive=False)
    assert (stand.output.asked, stand.output.steps) == (3, 2)
    stand = Stand(Output(errors=(HalTimeout("late"),)))
    stand.pass_ms(1, alive=False)
    assert stand.output.asked == 1
    assert "late" in stand.guardian.problem


@pytest.mark.parametrize("deaf", [True, False])
def test_it_gives_up_ten_seconds_after_it_took_the_outputs(deaf: bool) -> None:
    output = Output(deaf=True) if deaf else Output(errors=tuple(nack() for _ in range(90_000)))
    stand = Stand(output)
    stand.pass_ms(round(RETRY_S * 1000), alive=False)
    assert stand.guardian.state is State.RAMPING
    stand.pass_ms(2 + LONGEST_PAUSE_NS // MS, alive=False)
    assert stand.guardian.state is State.DONE
    assert stand.guardian.problem


def test_what_fails_is_tried_every_step_at_first_and_then_less_often() -> None:
    stand = Stand(Output(deaf=True))
    stand.pass_ms(40, alive=False)
    assert stand.output.asked == 40
    stand.pass_ms(1000, alive=False)
    assert 100 <= stand.output.asked - 40 <= 110


@pytest.mark.parametrize("hangs_ms", [30, 500, 2500, 9900])
def test_a_bus_that_comes_back_within_the_time_is_ramped_and_confirmed(hangs_ms: int) -> None:
    stand = Stand(Output(steps=3, deaf=True))
    stand.pass_ms(hangs_ms, alive=False)
    stand.output.deaf = False
    stand.pass_ms(LONGEST_PAUSE_NS // MS + 3, alive=False)
    assert stand.guardian.state is State.HOLDING
    assert stand.guardian.problem == ""
    assert stand.heartbeat.neutral_ns


def test_it_holds_for_as_long_as_the_firmware_lives_and_has_not_given_in() -> None:
    stand = Stand(Output(steps=1))
    stand.pass_ms(500)
    assert (stand.heartbeat.reason, stand.guardian.state) == (TakeoverReason.SILENT, State.HOLDING)
    stand.heartbeat.set_phase(Phase.IDLE)
    stand.pass_ms(1)
    assert stand.guardian.state is State.DONE


def test_it_holds_for_fifty_ms_after_a_death() -> None:
    stand = Stand(Output(steps=1))
    stand.pass_ms(1 + HOLD_NS // MS, alive=False)
    assert stand.guardian.state is State.HOLDING
    stand.pass_ms(1, alive=False)
    assert stand.guardian.state is State.DONE


def test_while_the_bus_answers_nobody_the_firmware_is_not_ended_for_a_command_that_waits() -> None:
    """Its transfer hangs, as the guardian's read does: it does not stand still."""
    stand = Stand(Output(deaf=True))
    begin_command(stand.heartbeat, (1, 2, 3))
    while not stand.heartbeat.taken_ns:
        stand.pass_ms(1)
    stand.pass_ms(3000)
    assert (stand.guardian.state, stand.ended) == (State.CLAIMING, 0)
    stand.heartbeat.end_command()  # the transfer ran into its time limit
    stand.pass_ms(1)
    assert stand.guardian.state is State.RAMPING
    stand.output.deaf = False
    stand.pass_ms(LONGEST_PAUSE_NS // MS + 3)
    assert (stand.guardian.state, stand.ended, stand.guardian.exclusive) == (State.HOLDING, 0, True)


def test_when_the_bus_is_back_a_command_that_has_not_arrived_ends_the_firmware() -> None:
    stand = Stand(Output(deaf=True))
    begin_command(stand.heartbeat, (1, 2, 3))
    while not stand.heartbeat.taken_ns:
        stand.pass_ms(1)
    stand.pass_ms(3 + STUCK_COMMAND_NS // MS)
    assert stand.ended == 0
    stand.output.deaf = False
    stand.pass_ms(1 + LONGEST_PAUSE_NS // MS)
    assert stand.ended == 1


def test_the_report() -> None:
    stand = Stand(Output(steps=1))
    nothing = dict.fromkeys(("noticed_ns", "taken_ns", "neutral_ns"))
    same = {"format": 1, "firmware_ended": False, "exclusive": True, "problem": ""}
    assert stand.guardian.report() == {**same, "why": "nothing", "last_beat_ns": START_NS, **nothing}
    stand.pass_ms(60)
    report = stand.guardian.report()
    times = {"noticed_ns": START_NS + 9 * MS, "taken_ns": START_NS + 42 * MS, "neutral_ns": START_NS + 43 * MS}
    assert report == {**same, "why": "silent", "last_beat_ns": START_NS, **times}


class Gate:
    """A gate with a lease of 40 ms, just renewed."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.clock.burn_ns(START_NS)
        self.heartbeat = Heartbeat()
        self.gate = LeaseGate(self.heartbeat, self.clock, "piezo", 40.0)
        self.heartbeat.set_phase(Phase.RUNNING)
        self.heartbeat.beat(START_NS)


def test_a_lease_lasts_to_its_last_moment_and_every_command_renews_it() -> None:
    g = Gate()
    for _ in range(2):
        g.clock.burn_ns(40 * MS)
        g.gate.enter((1, 2, 3))
        assert g.heartbeat.command_in_flight is not None
        g.gate.leave()
    assert g.gate.lost is False


def test_a_lease_that_is_over_stays_over() -> None:
    g = Gate()
    g.clock.burn_ns(41 * MS)
    for _ in range(2):  # the second time the phase is no longer RUNNING, and the guardian has not come yet
        with pytest.raises(SafetyTrip, match="has lost the outputs") as caught:
            g.gate.enter((1, 2, 3))
        assert caught.value.device == "piezo"
        assert (g.heartbeat.command_in_flight, g.heartbeat.phase, g.gate.lost) == (None, Phase.YIELDED, True)


def test_nothing_goes_out_once_the_guardian_has_the_outputs() -> None:
    g = Gate()
    g.heartbeat.take_outputs(TakeoverReason.SILENT, START_NS)
    with pytest.raises(SafetyTrip):
        g.gate.enter((1, 2, 3))


def test_who_is_alone_needs_no_lease() -> None:
    g = Gate()
    g.clock.burn_ns(41 * MS)
    with pytest.raises(SafetyTrip):
        g.gate.enter((1, 2, 3))
    g.gate.drop_lease()
    assert g.gate.lost is False
    g.heartbeat.set_phase(Phase.RUNNING)
    g.gate.enter((1, 2, 3))


def test_a_command_says_whether_it_repeats_the_one_before() -> None:
    g = Gate()
    seen = []
    for codes in ((0, 0, 0), (0, 0, 0), (0, 0, 1), (0, 0, 0)):
        g.gate.enter(codes)
        assert g.heartbeat.command_in_flight is not None
        seen.append(g.heartbeat.command_in_flight)
        g.gate.leave()
    assert [order.repeats for order in seen] == [False, True, False, False]
    assert seen[2].codes == (0, 0, 1)
