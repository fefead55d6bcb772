"""What is called unsafe, uncounted or unseen."""

from __future__ import annotations

import numpy as np

from tools.faults.campaign import FaultRow, moved_unseen, totals
from tools.faults.fault import Fault, InWorld
from tools.faults.judge import Observation, Seen, judge, neutral_ms, rough_demands

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


def test_neutral_counts_from_the_decision_and_needs_every_channel():
    ramp = [(k * MS, 0, 90.0 - 2.0 * k) for k in range(21)]
    assert neutral_ms(ramp, 0) == 20.0
    assert neutral_ms([*ramp, (30 * MS, 1, 51.0)], 0) is None


def test_a_refusal_moves_nothing():
    o = Observation.refusal("f", "p", 1, "no such device")
    assert (o.answer, o.unsafe, o.uncounted) == ("refused", 0, 0)
