"""The output guard: whatever is wished for, what goes out stays inside limits and slew, and every change is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.output_guard import LISTED, RAMP_STEPS, OutputGuard, SentCommand
from drivers.output_guard_steps import SLEW_LIMITED
from hal.clock import VirtualClock
from hal.errors import ErrorKind, SafetyTrip
from hal.types import OutputLimit

LIMIT = OutputLimit(lo_V=5.0, hi_V=95.0, slew_V_per_s=2000.0, safe_V=50.0)
WISHES = st.lists(
    st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.integers(0, 8_000_000)), min_size=1, max_size=30
)


def guard() -> tuple[OutputGuard, VirtualClock]:
    clock = VirtualClock()
    made = OutputGuard("out", [LIMIT, LIMIT], clock)
    made.armed = True
    return made, clock


@given(WISHES)
def test_limits_and_slew_hold_for_any_wish(wishes: list[tuple[float, float, int]]):
    out, clock = guard()
    for a, b, gap_ns in wishes:
        clock.burn_ns(gap_ns)
        before = list(out.last_V)
        mask = out.admit(np.array([a, b]))
        allowed = 2000.0 * min(gap_ns * 1e-9, 0.005)
        for i, wish in enumerate((a, b)):
            assert LIMIT.lo_V <= out.next_V[i] <= LIMIT.hi_V
            assert abs(out.next_V[i] - before[i]) <= allowed + 1e-9
            # the mask tells exactly the channels that did not get their wish
            assert (mask >> i & 1 == 0) == (out.next_V[i] == wish)
        out.sent()


@given(st.floats(5.0, 95.0), st.floats(5.0, 95.0))
def test_ramp_is_straight_and_leaves_time_for_second_tries(a: float, b: float):
    out, _ = guard()
    out.start_from([a, b])
    steps = []
    done = False
    while not done:
        done = out.ramp()
        out.sent()
        steps.append(list(out.last_V))
    assert len(steps) <= RAMP_STEPS < 20
    assert steps[-1] == [50.0, 50.0]
    path = np.array([[a, b], *steps])
    assert np.abs(np.diff(path, axis=0)).max() <= max(abs(a - 50), abs(b - 50)) / RAMP_STEPS + 1e-9 or len(steps) == 1
    assert not out.armed
    assert out.at_safe_state()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite_changes_nothing(bad: float):
    out, clock = guard()
    clock.burn_ns(1_000_000)
    with pytest.raises(SafetyTrip, match="channel 1"):
        out.admit(np.array([51.0, bad]))
    assert out.next_V == [50.0, 50.0]


def test_wrong_number_of_values():
    out, _ = guard()
    with pytest.raises(SafetyTrip, match="3 values for 2"):
        out.admit(np.zeros(3))


def test_a_ramp_that_was_held_up_makes_up_no_faster_than_the_slew_limit():
    out, clock = guard()
    out.start_from([58.0, 50.0])  # 0.5 V a step; the slew limit allows 2 V in the time of one
    parts = []
    for gap_ms in (0, 1, 2, 9, 0, 0):
        clock.burn_ns(gap_ms * 1_000_000)
        out.ramp()
        out.sent()
        parts.append(round((58.0 - out.last_V[0]) / 0.5))
    assert parts == [1, 2, 4, 8, 12, 13]


def test_wishes_in_numbers():
    out, clock = guard()
    for wish, next_V, mask, clipped, slew_limited in (
        ((51.0, 52.0), [51.0, 52.0], 0b00, 0, 0),  # 2 V are what a millisecond allows
        ((60.0, 49.0), [53.0, 50.0], 0b11, 0, 2),
        ((52.0, 50.0), [52.0, 50.0], 0b00, 0, 2),
        ((4.0, 50.0), [50.0, 50.0], 0b01, 1, 3),
        ((0.0, 99.0), [48.0, 52.0], 0b11, 3, 5),
        ((48.0, 1e6), [48.0, 54.0], 0b10, 4, 6),
    ):
        clock.burn_ns(1_000_000)
        assert out.admit(np.array(wish)) == mask
        out.sent()
        assert out.last_V == out.next_V == pytest.approx(next_V)
        assert (out.clipped, out.state.words[SLEW_LIMITED]) == (clipped, slew_limited)


def test_the_limits_themselves_are_allowed():
    out, clock = guard()
    out.start_from([5.0, 95.0])
    clock.burn_ns(1_000_000)
    assert out.admit(np.array([5.0, 95.0])) == 0
    assert (out.next_V, out.clipped) == ([5.0, 95.0], 0)


def test_the_edge_of_the_slew_limit_is_allowed():
    out, clock = guard()
    clock.burn_ns(1_000_000)
    assert out.admit(np.array([52.0, 48.0])) == 0
    assert out.state.words[SLEW_LIMITED] == 0


def refused(out: OutputGuard, wish: list[float]) -> SafetyTrip:
    with pytest.raises(SafetyTrip) as caught:
        out.admit(np.array(wish))
    return caught.value


def test_a_new_guard_is_not_armed_and_has_done_nothing():
    out = OutputGuard("out", [LIMIT, LIMIT], VirtualClock())
    assert (out.armed, out.writes, out.clipped, out.state.words[SLEW_LIMITED], list(out.sent_commands())) == (
        False,
        0,
        0,
        0,
        [],
    )
    error = refused(out, [50.0, 50.0])
    assert (error.device, "not armed: call arm() first" in str(error)) == ("out", True)
    assert out.ramp()  # it is where a ramp ends
    assert out.next_V == [50.0, 50.0]


@pytest.mark.parametrize("wish", [[50.0], [50.0, float("nan")]])
def test_a_refusal_names_its_device(wish: list[float]):
    assert refused(guard()[0], wish).device == "out"


def test_what_was_sent_is_told_with_its_times_and_counted():
    out, clock = guard()
    for _ in range(2):
        clock.burn_ns(1_000_000)
        out.admit(np.array([51.0, 50.0]))
        offered_ns = clock.now_ns()
        clock.burn_ns(300_000)
        out.sent(ago_ns=100_000)
    assert next(out.sent_commands()) == SentCommand(offered_ns, offered_ns + 200_000, (51.0, 50.0))
    # the allowance grows from when it was sent: 0.1 ms ago and 0.4 ms more
    clock.burn_ns(400_000)
    out.admit(np.array([60.0, 50.0]))
    assert out.next_V[0] == pytest.approx(52.0)
    out.not_before(clock.now_ns() + 70_000)
    out.sent()
    assert next(out.sent_commands()).offered_ns == clock.now_ns() + 70_000
    assert out.writes == 3
    out.ramp()
    out.sent()
    assert out.writes == 3  # steps of a ramp are nobody's wish
    for _ in range(LISTED):
        out.sent()
    assert len(list(out.sent_commands())) == LISTED


def test_a_ramp_begins_where_the_last_wish_was():
    out, clock = guard()
    clock.burn_ns(4_000_000)
    out.admit(np.array([58.0, 50.0]))
    out.sent()
    assert not out.ramp()
    assert out.armed is False
    assert out.next_V == [57.5, 50.0]


def test_a_step_that_did_not_go_out_is_offered_again_with_the_time_lost():
    out, clock = guard()
    clock.burn_ns(7_000_000)
    out.start_from([58.0, 50.0])
    out.ramp()
    assert out.next_V[0] == 57.5
    clock.burn_ns(2_000_000)
    out.ramp()
    assert out.next_V[0] == 56.5


def test_a_late_ramp_ends_at_the_safe_state_and_not_beyond():
    out, clock = guard()
    out.start_from([58.0, 50.0])  # 0.5 V a step, 4 steps at once: 1, 5, 9, 13, 17 of 16
    seen = []
    for _ in range(5):
        done = out.ramp()
        out.sent()
        clock.burn_ns(100_000_000)
        seen.append((out.last_V[0], done))
    assert seen == [(57.5, False), (55.5, False), (53.5, False), (51.5, False), (50.0, True)]


def test_one_step_at_a_time_where_the_slew_limit_allows_less():
    out, clock = guard()
    out.start_from([95.0, 50.0])  # 45 V in 16 steps: 2.8 V each, and 2 V are allowed
    out.ramp()
    out.sent()
    clock.burn_ns(5_000_000)
    out.ramp()
    assert out.next_V[0] == pytest.approx(95.0 - 2 * 45.0 / 16)


def test_a_failed_self_test_disarms():
    out, _ = guard()
    out.require(True, "nothing")
    assert out.armed
    with pytest.raises(SafetyTrip, match="self-test failed: the reading") as caught:
        out.require(False, "the reading")
    assert out.armed is False
    assert (caught.value.kind, caught.value.device) == (ErrorKind.SAFETY, "out")
