"""What is called unsafe, uncounted or unseen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import DEFAULT_BENCH
from tools.research.faults.campaign import FaultRow, moved_unseen, totals
from tools.research.faults.fault import Fault, InWorld, Kill
from tools.research.faults.judge import Observation, Seen, judge, neutral_ms, rough_demands
from tools.research.faults.pairs import draw_pairs
from tools.research.faults.phases import HOLD, LEARNING, PHASES, SELF_TEST, STEADY, accepted_answers
from tools.research.faults.trial import command_wire_ns

MS = 1_000_000


def outcome(reason: str, decided_ms: int, noticed: dict[str, int] | None = None, **samples: int) -> dict[str, object]:
    return {
        "safe_state": {"reason": reason, "reached": True},
        "safe_ns": decided_ms * MS,
        "armed_ns": 1,
        "noticed": noticed or {},
        "samples": {"received": 100, "lost": 0, "unread": 0} | samples,
    }


def seen(answer: dict[str, object], tip_um: np.ndarray, scans: int = 100) -> Seen:
    n = len(tip_um)
    path = np.zeros((n, 3))
    path[:, 0] = tip_um * 1e-6
    demands = [(0, 0, 50.0)]
    return Seen(20 * MS, answer, np.arange(n) * MS, path, demands, scans)


def test_a_trip_is_timed_from_the_strike_and_the_tip_until_the_decision():
    tip = np.zeros(100)
    tip[25:] = 6.0
    tip[40:] = 90.0
    o = judge("f", "p", 1, seen(outcome("daq: gone", 31), tip), np.zeros((100, 3)))
    assert (o.answer, o.tripped_ms, o.moved_ms, o.astray_um) == ("safe state", 11.0, 5.0, 6.0)
    assert not moved_unseen(o)


def test_an_ordinary_end_is_no_trip_and_a_count_is_a_notice():
    o = judge(
        "f", "p", 1, seen(outcome("run finished", 99, {"scans came late": 23 * MS}), np.zeros(100)), np.zeros((100, 3))
    )
    assert (o.answer, o.detect_ms) == ("noticed", 3.0)


def test_what_was_noticed_before_the_strike_does_not_count():
    o = judge("f", "p", 1, seen(outcome("run finished", 99, {"x": 3 * MS}), np.zeros(100)), np.zeros((100, 3)))
    assert o.answer == "none"


def test_a_tip_astray_that_nobody_knows_of_is_unseen():
    tip = np.where(np.arange(100) > 50, 6.0, 0.0)
    o = judge("f", "p", 1, seen(outcome("run finished", 99), tip), np.zeros((100, 3)))
    assert moved_unseen(o)
    row = FaultRow(Fault("f", InWorld("x", ""), "safe state"), "p", (o,))
    assert totals([row])["of_these_known_within_20_ms"] == 0


def test_scans_that_nobody_knows_of_are_uncounted():
    o = judge("f", "p", 1, seen(outcome("run finished", 99, lost=3), np.zeros(100), scans=110), np.zeros((100, 3)))
    assert o.uncounted == 110 - 103 - 1


def test_rough_demands():
    assert rough_demands([(0, 0, 50.0), (MS, 0, 69.0), (2 * MS, 0, 90.0)]) == 1  # 21 V in one tick
    assert rough_demands([(0, 0, 50.0), (MS, 0, 101.0)]) == 2  # out of range, and too fast
    assert rough_demands([(0, 0, 0.0), (50 * MS, 0, 99.0)]) == 0  # five ticks' worth after a pause


def test_a_command_that_was_on_the_wire_when_a_hold_began_is_not_driven_in_it():
    hold = {"t_ns": 50 * MS, "length_s": 0.03, "cause": "overflow", "resumed": True}
    answer = seen(outcome("run finished", 99) | {"holds": [hold]}, np.zeros(100))
    answer.demands.extend([(40 * MS, 0, 31.0), (53 * MS, 0, 30.0), (63 * MS, 0, 50.0)])
    at_once, on_serial = answer, replace(answer, wire_ns=round(3.2 * MS))
    assert judge("f", "p", 1, at_once, np.zeros((100, 3))).rough == 1
    assert judge("f", "p", 1, on_serial, np.zeros((100, 3))).rough == 0
    on_serial.demands.insert(-1, (54 * MS, 0, 29.0))
    assert judge("f", "p", 1, on_serial, np.zeros((100, 3))).rough == 1


@pytest.mark.parametrize(("bench", "least_ms", "most_ms"), [("micron-e727", 2.5, 3.5), ("micron-can", 0.1, 0.4)])
def test_the_time_of_a_command_on_the_wire_is_that_of_the_bus(bench: str, least_ms: float, most_ms: float):
    assert least_ms < 1e-6 * command_wire_ns(DEFAULT_BENCH.with_name(f"{bench}.toml")) < most_ms
    assert command_wire_ns(DEFAULT_BENCH) == 0, "a transfer over I2C has ended when the driver goes on"


def test_what_the_run_without_the_fault_noticed_as_well_is_not_the_answer_to_one_that_did_not_strike():
    late = outcome("run finished", 99, {"no scans": 27 * MS})
    none = replace(seen(late, np.zeros(100)), happened=False)
    reference = np.zeros((100, 3))
    assert judge("f", "p", 1, none, reference, usual={"no scans": 27 * MS}).answer == "none"
    assert judge("f", "p", 1, none, reference, usual={"no scans": 26 * MS}).answer == "noticed"
    assert judge("f", "p", 1, seen(late, np.zeros(100)), reference, usual={"no scans": 27 * MS}).answer == "noticed"


def test_neutral_counts_from_the_decision_and_needs_every_channel():
    ramp = [(k * MS, 0, 90.0 - 2.0 * k) for k in range(21)]
    assert neutral_ms(ramp, 0) == 20.0
    assert neutral_ms([*ramp, (30 * MS, 1, 51.0)], 0) is None


def test_a_refusal_moves_nothing():
    o = Observation.refusal("f", "p", 1, "no such device", "start")
    assert (o.answer, o.rough, o.false_neutral, o.uncounted) == ("refused", 0, False, 0)


def test_no_fault_excuses_a_report_of_neutral_that_is_none():
    answer = seen(outcome("piezo: gone", 31), np.zeros(100))
    answer.demands.append((40 * MS, 0, 62.0))
    o = judge("f", "p", 1, answer, np.zeros((100, 3)))
    assert o.false_neutral
    row = FaultRow(Fault("f", InWorld("x", ""), "safe state", names=("piezo",), own_output=True), "p", (o,))
    assert row.unsafe == 1
    assert not row.is_good


def test_the_tip_is_not_judged_where_the_outputs_rest():
    tip = np.where(np.arange(100) > 50, 600.0, 0.0)
    o = judge("f", "p", 1, seen(outcome("run finished", 99), tip), np.zeros((100, 3)), phase=HOLD)
    assert (o.moved_ms, o.astray_um, o.phase) == (None, 0.0, "hold")


def test_a_hold_that_another_cause_began_is_not_the_answer_to_the_fault_unless_it_lasts():
    hold = {"t_ns": 10 * MS, "length_s": 0.05, "cause": "overflow", "resumed": True}
    resumed = outcome("run finished", 99) | {"holds": [hold]}
    lasts = outcome("run finished", 99) | {"holds": [hold | {"resumed": False}]}
    assert judge("f", "p", 1, seen(resumed, np.zeros(100)), np.zeros((100, 3)), phase=HOLD).answer == "none"
    o = judge("f", "p", 1, seen(lasts, np.zeros(100)), np.zeros((100, 3)), phase=HOLD)
    assert (o.answer, o.held_on, o.known_by) == ("holds", True, "")


def test_instants_stay_in_their_phase_and_repeat():
    for phase in PHASES:
        for seed in range(200):
            begin_ns, strike_ns = phase.instants_ns(seed)
            assert phase.from_s * 1e9 <= begin_ns <= phase.to_s * 1e9
            assert begin_ns <= strike_ns <= begin_ns + phase.within_s * 1e9
            assert phase.instants_ns(seed) == (begin_ns, strike_ns)


def test_a_fault_that_latches_may_never_be_answered_by_outputs_that_work():
    latching = Fault("f", InWorld("x", ""), "safe state")
    for phase in (SELF_TEST, LEARNING, STEADY, HOLD):
        assert not accepted_answers(latching, phase.name) & {"none", "noticed", "resumes", "harmless"}


def test_pairs_are_drawn_once_each_and_keep_what_is_worse():
    one = Fault("one", InWorld("x", ""), "safe state", ("a",), watch_s=0.2)
    two = Fault("two", InWorld("y", ""), "holds", ("b",), own_output=True)
    dead = Fault("dead", Kill("firmware"), "safe state")
    groups = draw_pairs([one, two, dead], 50, 3)
    pairs = [pair for group in groups for pair in group]
    assert sorted(pair.name for pair in pairs) == ["one + two", "two + one"]
    assert groups == draw_pairs([one, two, dead], 50, 3)
    for pair in pairs:
        assert (pair.expected, pair.own_output, set(pair.names)) == ("safe state", True, {"a", "b"})
        assert "holds" in accepted_answers(pair, STEADY.name)


def test_nothing_is_the_right_answer_to_a_fault_that_has_not_struck_after_all():
    fault = Fault("f", InWorld("x", ""), "holds")
    quiet = judge("f", "p", 1, seen(outcome("run finished", 99), np.zeros(100)), np.zeros((100, 3)))
    none, struck = replace(quiet, happened=False), replace(quiet, happened=True)
    tripped = replace(none, tripped_ms=3.0)
    row = FaultRow(fault, "p", (none, struck, tripped))
    assert [row.is_as_expected(o) for o in row.observations] == [True, False, False]


def test_a_slow_fault_is_none_that_a_bench_without_read_back_must_tell_in_time():
    slow = Fault("f", InWorld("x", ""), "safe state", slow=True)
    late = replace(judge("f", "p", 1, seen(outcome("x", 99), np.zeros(100)), np.zeros((100, 3))), moved_ms=1.0)
    assert totals([FaultRow(slow, "p", (late,))])["ours_moving_the_tip_5_um"] == 0
    assert totals([FaultRow(slow.with_read_back(), "p", (late,))])["ours_moving_the_tip_5_um"] == 1
