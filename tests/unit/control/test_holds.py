"""When a hold may end, when it lasts too long, what a minute allows, and when this host stood still."""

from __future__ import annotations

from typing import Any

import pytest

from firmware_py.run.findings import CauseClass, Finding
from firmware_py.run.holds import MINUTE_NS, OPERATOR
from firmware_py.run.host_gaps import HostGaps
from firmware_py.run.safety import SafetyLimits, State
from tests.unit.control.stand import StandRun

MS = 1_000_000


class Stand:
    """A running supervisor with an amplifier that is at neutral at once."""

    def __init__(self, state: State = State.RUNNING, *, allows_host_stalls: bool = False, **limits: Any) -> None:
        run = StandRun(state, SafetyLimits(**limits), allows_host_stalls=allows_host_stalls)
        self.clock, self.limits, self.counts = run.clock, run.limits, run.counts
        self.supervisor, self.incidents = run.supervisor, run.incidents
        self.clock.burn_ns(1000 * MS)
        self.holds = self.incidents.holds

    def silence(self) -> None:
        self.incidents.report(Finding.SCANS_MISSING, device="daq", limit_ms=5.0)

    def held(self) -> Stand:
        """At neutral after a silence."""
        self.silence()
        self.supervisor.step()
        assert self.supervisor.state is State.HOLD
        return self

    def may_end_after(self, ms: float) -> bool:
        self.clock.burn_ns(round(ms * MS))
        return self.holds.may_end(self.clock.now_ns())

    def resume(self) -> None:
        self.supervisor.resume()
        self.incidents.end_hold()

    @property
    def trip(self) -> str:
        cause = self.supervisor.trip_cause
        return "" if cause is None else cause.reason


def test_a_hold_ends_after_its_time_without_interruption_and_not_before():
    stand = Stand().held()
    assert not stand.may_end_after(199.0)
    assert stand.may_end_after(1.0)
    stand.resume()
    (hold,) = stand.supervisor.holds
    assert (hold.resumed, hold.cause) == (True, CauseClass.LINK)
    assert hold.end_ns is not None
    assert hold.end_ns - hold.t_ns == 200 * MS
    assert stand.supervisor.may_move


def test_another_finding_interrupts_it_and_is_no_hold_of_its_own():
    stand = Stand().held()
    assert not stand.may_end_after(150.0)
    stand.incidents.report(Finding.MONITOR_DEAF, error="monitor: no answer")
    assert stand.holds.waits_for == "monitor: no answer"
    assert not stand.may_end_after(199.0)
    assert stand.may_end_after(1.0)
    assert len(stand.supervisor.holds) == 1
    assert list(stand.counts.noticed) == ["monitor"]


def test_a_latched_finding_ends_the_run_from_a_hold():
    stand = Stand().held()
    stand.incidents.report(Finding.BUTTON_PRESSED)
    assert stand.trip == "stop button pressed"
    assert stand.supervisor.state is State.SAFE_RAMP
    assert not stand.supervisor.holds[0].resumed


def test_the_fourth_hold_within_a_minute_is_none_and_says_so():
    stand = Stand()
    for _ in range(3):
        stand.held()
        assert stand.may_end_after(200.0)
        stand.resume()
    stand.silence()
    assert stand.trip.startswith("hold 4 within a minute, more than [firmware.safety] holds_per_minute = 3: daq")
    assert stand.supervisor.trip_cause is not None
    assert stand.supervisor.trip_cause.cause is CauseClass.LINK
    assert len(stand.supervisor.holds) == 3


def test_pauses_of_the_host_do_not_count_where_no_device_is_real():
    stand = Stand(allows_host_stalls=True)
    for _ in range(5):
        stand.incidents.report(Finding.HOST_OVERSLEPT, stall_ms=9.0, device="daq")
        stand.supervisor.step()
        assert stand.may_end_after(200.0)
        stand.resume()
    for _ in range(3):
        stand.held()
        assert stand.may_end_after(200.0)
        stand.resume()
    assert not stand.trip
    assert len(stand.supervisor.holds) == 8
    stand.silence()
    assert stand.trip.startswith("hold 4 within a minute")


def test_a_minute_later_it_is_the_first_again():
    stand = Stand(holds_per_minute=1).held()
    assert stand.may_end_after(200.0)
    stand.resume()
    stand.clock.burn_ns(MINUTE_NS - 200 * MS)
    stand.silence()
    assert not stand.trip
    assert len(stand.supervisor.holds) == 2


def test_no_holds_at_all():
    stand = Stand(holds_per_minute=0)
    stand.silence()
    assert stand.trip == "daq: no new scan for 5 ms; check its link"


def test_a_hold_whose_outputs_cannot_be_armed_is_given_up():
    stand = Stand().held()
    for _ in range(15):
        assert stand.may_end_after(200.0)
        stand.holds.note_refusal(stand.clock.now_ns())
        stand.holds.interrupt(stand.clock.now_ns(), "piezo: no answer")
        assert not stand.holds.has_timed_out(stand.clock.now_ns())
    stand.clock.burn_ns(200 * MS)
    assert stand.holds.has_timed_out(stand.clock.now_ns())


def test_a_person_may_try_again_at_any_time():
    stand = Stand(rearm="operator").held()
    assert not stand.may_end_after(200.0)
    stand.holds.note_refusal(stand.clock.now_ns())
    assert not stand.may_end_after(10_000.0)
    assert not stand.holds.has_timed_out(stand.clock.now_ns())


def test_a_hold_that_does_not_become_good_is_given_up():
    stand = Stand().held()
    for _ in range(29):
        stand.clock.burn_ns(100 * MS)
        stand.silence()
        assert not stand.holds.has_timed_out(stand.clock.now_ns())
    stand.clock.burn_ns(100 * MS)
    assert stand.holds.has_timed_out(stand.clock.now_ns())
    stand.incidents.abandon_hold()
    assert stand.trip == (
        "daq: no new scan for 5 ms; check its link; it has not passed within 3000 ms ([firmware.safety] hold_limit_ms)"
    )


def test_what_it_waits_for_in_the_end_is_told_beside_the_first_cause():
    stand = Stand().held()
    stand.holds.interrupt(stand.clock.now_ns(), "attitude is not aligned")
    stand.incidents.abandon_hold()
    assert "check its link; then attitude is not aligned; it has not" in stand.trip


def test_nothing_is_given_up_without_a_hold():
    stand = Stand()
    stand.incidents.abandon_hold()
    assert not stand.trip
    assert stand.holds.as_status(stand.clock.now_ns()) is None


def test_the_operator_is_heard_only_once_the_cause_has_passed():
    stand = Stand(rearm="operator").held()
    assert not stand.holds.ask()
    assert not stand.may_end_after(200.0), "an order that came too early is not kept"
    assert stand.holds.waits_for == OPERATOR
    assert not stand.may_end_after(60_000.0)
    assert not stand.holds.has_timed_out(stand.clock.now_ns()), "a person may take any time"
    status = stand.holds.as_status(stand.clock.now_ns())
    assert status is not None
    assert (status["class"], status["waits_for"], status["rearm"]) == ("link", OPERATOR, "operator")
    assert stand.holds.ask()
    stand.silence()
    assert not stand.may_end_after(0.0), "what came between takes the order back"
    assert not stand.may_end_after(200.0)
    assert stand.holds.ask()
    assert stand.may_end_after(0.0)


def test_within_the_self_test_the_time_begins_anew_and_nothing_is_held():
    stand = Stand(State.SELF_TEST)
    stand.silence()
    assert stand.supervisor.state is State.SELF_TEST
    assert stand.supervisor.holds == []
    assert stand.holds.good_ms(stand.clock.now_ns()) == 0.0
    assert list(stand.counts.noticed) == ["no scans"]


def test_a_run_that_only_looks_ends_for_what_is_no_doubt():
    stand = Stand(State.SENSING_ONLY)
    stand.silence()
    assert stand.trip == "daq: no new scan for 5 ms; check its link"


def test_the_list_of_holds_counts_from_the_start_of_the_run():
    stand = Stand().held()
    stand.may_end_after(200.0)
    stand.resume()
    stand.silence()
    now_ns = stand.clock.now_ns() + 30 * MS
    first, second = stand.holds.as_list(500 * MS, now_ns)
    assert first == {
        "t_s": 0.5, "cause": "daq: no new scan for 5 ms; check its link", "class": "link", "length_s": 0.2,
        "finding": "scans_missing", "t_ns": 1000 * MS, "resumed": True, "neutral_ms": None,
    }  # fmt: skip
    assert not second["resumed"]
    assert second["t_s"] == pytest.approx(0.7)
    assert second["length_s"] == pytest.approx(0.03)


def test_a_gap_of_the_host_is_remembered_for_a_while():
    gaps = HostGaps(5.0)
    gaps.record(10 * MS, 14 * MS)
    assert gaps.stalls == 0
    gaps.record(10 * MS, 15 * MS)
    gaps.record(20 * MS, 50 * MS)
    gaps.record(60 * MS, 66 * MS)
    assert (gaps.stalls, gaps.longest_ms) == (3, 30.0)
    assert gaps.recent_ms(76 * MS, 10.0) == 6.0
    assert gaps.recent_ms(77 * MS, 10.0) == 0.0
