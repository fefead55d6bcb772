"""The output guard: whatever is wished for, what goes out stays inside limits and slew, and every change is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.clock import VirtualClock
from hal.errors import SafetyTrip
from hal.output_guard import RAMP_STEPS, OutputGuard
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
