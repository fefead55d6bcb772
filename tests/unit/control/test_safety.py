"""The supervisor: nothing moves before the self-test, the first reason wins, neutral within 20 ms."""

from collections.abc import Iterator

import numpy as np
import pytest

from firmware_py.run.findings import CauseClass, Finding
from firmware_py.run.safety import RAMP_TICKS, State, Supervisor, Trip, ramp_ticks_at
from hal.arrays import Array
from hal.errors import I2cNack, SafetyTrip
from hal.types import OutputLimit


class FakeAmplifier:
    """Ramps in ``ticks`` steps; ``failing`` transfers are refused first."""

    name = "piezo"
    limits = (OutputLimit(0.0, 100.0, 20_000.0, 50.0),)

    def __init__(self, ticks: int = RAMP_TICKS, failing: int = 0, self_test: bool = True) -> None:
        self.ticks, self.failing, self.self_test, self.armed = ticks, failing, self_test, False

    def arm(self) -> None:
        if not self.self_test:
            raise SafetyTrip("read-back differs from what was written", device="piezo")
        self.armed = True

    def write(self, values_V: Array) -> int:
        return 0

    def safe_step(self) -> bool:
        self.armed = False
        if self.failing:
            self.failing -= 1
            raise I2cNack("address 0x0c not acknowledged", device="piezo")
        self.ticks -= 1
        return self.ticks <= 0

    def readback_V(self) -> Array:
        return np.zeros(1)

    def close(self) -> None:
        pass


def running(amplifier: FakeAmplifier) -> Supervisor:
    supervisor = Supervisor(amplifier)
    supervisor.begin_self_test()
    supervisor.arm()
    return supervisor


def test_no_motion_before_the_self_test():
    supervisor = Supervisor(FakeAmplifier())
    supervisor.arm()
    assert not supervisor.may_move
    supervisor.begin_self_test()
    assert not supervisor.may_move
    supervisor.arm()
    assert supervisor.may_move


class InSteps(FakeAmplifier):
    """An amplifier that is armed in three steps."""

    def arming(self) -> Iterator[None]:
        for _ in range(3):
            yield
        self.arm()


def test_what_is_found_between_the_steps_of_arming_ends_it():
    amplifier = InSteps()
    supervisor = Supervisor(amplifier)
    supervisor.begin_self_test()
    passed: list[int] = []

    def meanwhile() -> None:
        passed.append(1)
        if len(passed) == 2:
            supervisor.trip(Finding.BUTTON_PRESSED, "stop button", tick=7, t_ns=7_000_000)

    supervisor.arm(meanwhile)
    assert len(passed) == 2
    assert not supervisor.may_move
    assert supervisor.state is State.SAFE_RAMP
    assert not amplifier.armed


def test_failed_self_test_leaves_everything_disarmed():
    amplifier = FakeAmplifier(self_test=False)
    supervisor = Supervisor(amplifier)
    supervisor.begin_self_test()
    with pytest.raises(SafetyTrip):
        supervisor.arm()
    assert not supervisor.may_move
    assert not amplifier.armed


def test_first_reason_wins_and_neutral_in_20_ticks():
    supervisor = running(FakeAmplifier())
    supervisor.trip(Finding.BUTTON_PRESSED, "stop button", tick=7, t_ns=7_000_000)
    supervisor.trip(Finding.SCANS_MISSING, "stale sample", tick=8, t_ns=8_000_000)
    assert not supervisor.may_move
    steps = 1
    while not supervisor.step():
        steps += 1
    assert steps == RAMP_TICKS
    assert supervisor.safe_reached
    assert supervisor.trip_cause is not None
    assert supervisor.trip_cause == Trip(Finding.BUTTON_PRESSED, "stop button", 7, 7_000_000, CauseClass.OPERATOR)
    assert supervisor.ramp_failure == ""


def test_no_way_back():
    supervisor = running(FakeAmplifier(ticks=1))
    supervisor.trip(Finding.NOT_A_NUMBER, "NaN in the estimate", tick=1, t_ns=1)
    assert supervisor.step()
    supervisor.begin_self_test()
    supervisor.arm()
    assert supervisor.state is State.SAFE


def test_a_refused_step_is_tried_again_within_its_tick():
    supervisor = running(FakeAmplifier(ticks=5, failing=4))
    supervisor.trip(Finding.DAQ_GONE, "link lost", tick=1, t_ns=1)
    # three refusals take the first tick, the fourth costs the second one nothing
    assert [supervisor.step() for _ in range(6)] == [False] * 5 + [True]
    assert supervisor.safe_reached


def test_a_bus_that_comes_back_late_is_ramped_and_the_supervisor_knows_that_it_was_late():
    supervisor = running(FakeAmplifier(ticks=5, failing=600))
    supervisor.trip(Finding.DAQ_GONE, "link lost", tick=1, t_ns=1)
    steps = 0
    while not supervisor.step(may_retry=True):
        steps += 1
        assert supervisor.is_retrying == (steps >= 2 * RAMP_TICKS)
        assert steps < 1000
    assert steps == 204  # three refusals a tick
    assert supervisor.safe_reached
    assert supervisor.was_late
    assert supervisor.ramp_failure == ""


def test_a_retry_ends_when_it_may_not_go_on():
    supervisor = running(FakeAmplifier(failing=100_000))
    supervisor.trip(Finding.FINISHED, "run finished", tick=1, t_ns=1)
    assert not supervisor.must_not_wait
    assert not any(supervisor.step(may_retry=True) for _ in range(500))
    assert supervisor.must_not_wait, "the loop would wait for scans between its tries"
    assert supervisor.step(may_retry=False)
    assert (supervisor.state, supervisor.safe_reached, supervisor.was_late) == (State.SAFE, False, False)
    assert supervisor.ramp_failure


def test_a_hold_whose_ramp_fails_becomes_the_end_and_goes_on_trying():
    supervisor = running(FakeAmplifier(ticks=5, failing=600))
    supervisor.hold(Finding.OUTPUT_TRANSFER, "piezo: no answer", tick=1, t_ns=1)
    while not supervisor.step(may_retry=True):
        pass
    assert supervisor.trip_cause is not None
    assert supervisor.trip_cause.finding is Finding.NEUTRAL_NOT_REACHED
    assert (supervisor.state, supervisor.safe_reached, supervisor.was_late) == (State.SAFE, True, True)


def test_a_dead_bus_ends_in_a_report_not_in_a_loop():
    supervisor = running(FakeAmplifier(failing=10_000))
    supervisor.trip(Finding.DAQ_GONE, "link lost", tick=1, t_ns=1)
    assert [supervisor.step() for _ in range(2 * RAMP_TICKS)] == [False] * (2 * RAMP_TICKS - 1) + [True]
    assert not supervisor.safe_reached
    assert "0x0c not acknowledged" in supervisor.ramp_failure


def test_an_amplifier_that_never_says_neutral_is_given_up_and_told_of():
    supervisor = running(FakeAmplifier(ticks=10_000))
    supervisor.trip(Finding.DAQ_GONE, "link lost", tick=1, t_ns=1)
    assert [supervisor.step() for _ in range(2 * RAMP_TICKS)] == [False] * (2 * RAMP_TICKS - 1) + [True]
    assert supervisor.safe_reached is False
    assert supervisor.ramp_failure == "the amplifier did not report neutral in time"


def test_neutral_after_a_refusal_leaves_no_failure_in_the_report():
    supervisor = running(FakeAmplifier(ticks=1, failing=2))
    supervisor.trip(Finding.DAQ_GONE, "link lost", tick=1, t_ns=1)
    assert supervisor.step()
    assert supervisor.ramp_failure == ""


def test_no_ramp_before_a_trip_nor_after_neutral():
    amplifier = FakeAmplifier(ticks=1)
    supervisor = running(amplifier)
    assert not supervisor.step()
    supervisor.trip(Finding.FINISHED, "run finished", tick=1, t_ns=1)
    assert supervisor.step()
    assert supervisor.step()
    assert amplifier.ticks == 0
    assert supervisor.trip_cause == Trip(Finding.FINISHED, "run finished", 1, 1, CauseClass.OPERATOR)
    assert supervisor.trip_cause.normal


def test_only_the_planned_end_waits_for_scans():
    asked, planned = running(FakeAmplifier()), running(FakeAmplifier())
    assert not asked.must_not_wait
    asked.trip(Finding.BUTTON_PRESSED, "stop button", tick=1, t_ns=1)
    planned.trip(Finding.FINISHED, "run finished", tick=1, t_ns=1)
    assert asked.must_not_wait
    assert not planned.must_not_wait


def test_a_run_that_only_looks_cannot_be_armed_any_more():
    amplifier = FakeAmplifier()
    supervisor = Supervisor(amplifier)
    supervisor.begin_sensing()
    supervisor.begin_self_test()
    supervisor.arm()
    assert supervisor.state is State.SENSING_ONLY
    assert not supervisor.may_move
    assert not amplifier.armed
    armed = running(FakeAmplifier())
    armed.begin_sensing()
    assert armed.state is State.RUNNING


def test_warnings_are_counted_and_end_nothing():
    supervisor = running(FakeAmplifier())
    assert supervisor.warnings == {"jerk": 0, "drift": 0}
    for what in ("jerk", "field", "field"):
        supervisor.warn(what)
    assert supervisor.warnings == {"jerk": 1, "drift": 0, "field": 2}
    assert supervisor.may_move


def held(amplifier: FakeAmplifier) -> Supervisor:
    supervisor = running(amplifier)
    supervisor.hold(Finding.SCANS_MISSING, "daq: silent", tick=5, t_ns=5)
    return supervisor


def test_a_hold_ramps_as_a_trip_does_and_can_resume():
    amplifier = FakeAmplifier()
    supervisor = held(amplifier)
    assert supervisor.is_holding
    assert not supervisor.may_move
    assert not supervisor.must_not_wait
    assert [supervisor.step() for _ in range(RAMP_TICKS)] == [False] * RAMP_TICKS
    assert supervisor.state is State.HOLD
    assert not supervisor.safe_reached
    supervisor.resume()
    assert supervisor.may_move
    assert amplifier.armed


def test_nothing_resumes_on_the_way_to_neutral_or_after_a_trip():
    supervisor = held(FakeAmplifier())
    supervisor.step()
    supervisor.resume()
    assert not supervisor.may_move
    supervisor.trip(Finding.BUTTON_PRESSED, "stop button", tick=7, t_ns=7)
    while not supervisor.step():
        supervisor.resume()
    supervisor.resume()
    assert supervisor.state is State.SAFE
    assert supervisor.holds[0].end_ns == 7


def test_a_trip_within_the_ramp_of_a_hold_does_not_begin_its_time_anew():
    supervisor = held(FakeAmplifier(failing=10_000))
    for _ in range(RAMP_TICKS):
        assert not supervisor.step()
    supervisor.trip(Finding.BUTTON_PRESSED, "stop button", tick=7, t_ns=7)
    assert [supervisor.step() for _ in range(RAMP_TICKS)] == [False] * (RAMP_TICKS - 1) + [True]
    assert not supervisor.safe_reached


def test_a_hold_that_does_not_reach_neutral_is_none():
    supervisor = held(FakeAmplifier(failing=10_000))
    assert [supervisor.step() for _ in range(2 * RAMP_TICKS)] == [False] * (2 * RAMP_TICKS - 1) + [True]
    assert supervisor.state is State.SAFE
    assert not supervisor.safe_reached
    cause = supervisor.trip_cause
    assert cause == Trip(Finding.NEUTRAL_NOT_REACHED, "daq: silent", 5, 5, CauseClass.LINK)
    assert "0x0c not acknowledged" in supervisor.ramp_failure


def test_only_what_runs_is_held():
    supervisor = Supervisor(FakeAmplifier())
    supervisor.begin_self_test()
    supervisor.hold(Finding.SCANS_MISSING, "daq: silent", tick=5, t_ns=5)
    assert supervisor.state is State.SELF_TEST
    assert supervisor.holds == []


def test_an_amplifier_that_cannot_be_armed_again_leaves_the_hold():
    amplifier = FakeAmplifier(ticks=1)
    supervisor = held(amplifier)
    supervisor.step()
    amplifier.self_test = False
    with pytest.raises(SafetyTrip):
        supervisor.resume()
    assert supervisor.state is State.HOLD


def test_states_have_words_for_people():
    assert [state.words for state in (State.RUNNING, State.HOLD_RAMP, State.HOLD, State.SAFE_RAMP)] == [
        "running", "hold", "hold", "safe ramp",
    ]  # fmt: skip


def test_a_ramp_at_a_fast_tick_has_the_same_time() -> None:
    assert [ramp_ticks_at(period) for period in (2_000_000, 1_000_000, 500_000, 250_000)] == [20, 20, 40, 80]
    supervisor = Supervisor(FakeAmplifier(ticks=60), ramp_ticks_at(250_000))
    supervisor.begin_self_test()
    supervisor.arm()
    supervisor.trip(Finding.FINISHED, "run finished", tick=1, t_ns=1)
    assert [supervisor.step() for _ in range(60)] == [False] * 59 + [True]
    assert not supervisor.was_late
