"""The output guard's functions give the same bits in the interpreter and compiled, over the same memory layout."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.output_guard_steps import (
    ARMED,
    NOT_ARMED,
    NOT_FINITE,
    GuardState,
    admit,
    new_state,
    next_ramp_step,
    note_sent,
)
from hal.compiled import kernel
from hal.types import OutputLimit

LIMITS = [OutputLimit(lo_V=5.0, hi_V=95.0, slew_V_per_s=2000.0, safe_V=50.0)] * 2
VOLTS = st.one_of(st.floats(-200.0, 200.0), st.sampled_from([math.nan, math.inf, -math.inf]))
CALLS = st.lists(
    st.tuples(st.sampled_from("aarsx"), VOLTS, VOLTS, st.integers(0, 9_000_000)), min_size=1, max_size=40
)  # admit, ramp, sent, arm


@pytest.fixture(scope="module")
def compiled() -> tuple[Any, Any, Any]:
    return kernel(admit), kernel(next_ramp_step), kernel(note_sent)


def memory(state: GuardState) -> list[bytes]:
    return [part.tobytes() for part in state]


@settings(max_examples=200, deadline=None)
@given(calls=CALLS)
def test_interpreter_and_compiled_code_agree_bit_for_bit(compiled: tuple[Any, Any, Any], calls: list[Any]):
    plain, other = (new_state(LIMITS, 0, 16, 0.001, 0.005) for _ in range(2))
    view = other.view()
    admit_c, ramp_c, sent_c = compiled
    now_ns = 0
    for call, a, b, gap_ns in calls:
        now_ns += gap_ns
        match call:
            case "a":
                assert admit(plain, [a, b], now_ns) == admit_c(view, np.array([a, b]), now_ns)
            case "r":
                assert next_ramp_step(plain, now_ns) == ramp_c(view, now_ns)
            case "s":
                note_sent(plain, now_ns)
                sent_c(view, now_ns)
            case _:
                plain.words[ARMED] = view.words[ARMED] = 1
        assert memory(plain) == memory(other)


def test_a_view_is_the_same_memory():
    state = new_state(LIMITS, 0, 16, 0.001, 0.005)
    state.view().last_V[1] = 7.0
    assert state.last_V == array("d", [50.0, 7.0])


def test_refusals_leave_the_next_command_alone():
    state = new_state(LIMITS, 0, 16, 0.001, 0.005)
    assert admit(state, [60.0, 60.0], 1_000_000) == NOT_ARMED
    state.words[ARMED] = 1
    assert admit(state, [60.0, math.nan], 1_000_000) == NOT_FINITE - 1
    assert state.next_V == array("d", [50.0, 50.0])
