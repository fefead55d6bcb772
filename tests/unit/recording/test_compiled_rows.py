"""Rows and histograms that compiled code writes are the ones that Python writes, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.live.memory import LiveMemory, announce, put_over
from firmware_py.recording.ring import RowRing, announce_row, put_row
from firmware_py.scheduler.histogram import DurationHistogram, add_duration
from hal.compiled import kernel


@pytest.fixture(scope="module")
def compiled() -> dict[str, Any]:
    made: dict[str, Any] = {f.__name__: kernel(f) for f in (put_row, announce_row, put_over, announce, add_duration)}
    # the compiler keeps what it has compiled for; a ring that is closed has to be free
    view = RowRing.create(3, 4).view()
    copy = view._replace(words=view.words.copy(), numbers=view.numbers.copy(), rows=view.rows.copy())
    made["put_row"](copy, np.zeros(3))
    made["announce_row"](copy.words)
    made["put_over"](copy.words, copy.rows, np.zeros(3))
    made["announce"](copy.words)
    return made


@settings(max_examples=100, deadline=None)
@given(actions=st.lists(st.sampled_from(["push", "pop"]), max_size=30))
def test_a_ring_is_the_same_memory(compiled: dict[str, Any], actions: list[str]):
    plain, other = RowRing.create(3, 4), RowRing.create(3, 4)
    view = other.view()
    for k, action in enumerate(actions):
        row = np.array([k, -k, 0.5])
        if action == "push":
            taken = bool(compiled["put_row"](view, row))
            if taken:
                compiled["announce_row"](view.words)
            assert taken == plain.push(row)
        else:
            for a, b in zip(plain.pop(2), other.pop(2), strict=True):
                assert a.tobytes() == b.tobytes()
        assert (plain.pushed, plain.dropped, plain.waiting()) == (other.pushed, other.dropped, other.waiting())
    del view
    plain.close()
    other.close()


def test_live_rows_are_the_same(compiled: dict[str, Any]):
    plain, other = LiveMemory.create(2, 16), LiveMemory.create(2, 16)
    words, rows = other.view()
    for k in range(40):
        row = np.array([k, 0.5 * k])
        plain.push(row)
        compiled["put_over"](words, rows, row)
        compiled["announce"](words)
    assert plain.read(0).values.tobytes() == other.read(0).values.tobytes()
    del words, rows
    plain.close()
    other.close()


@settings(max_examples=200, deadline=None)
@given(values=st.lists(st.integers(-1000, 1 << 40), max_size=20))
def test_histograms_are_the_same(compiled: dict[str, Any], values: list[int]):
    plain, other = DurationHistogram(), DurationHistogram()
    words = np.frombuffer(other.words, np.int64)
    for k, value_ns in enumerate(values):
        plain.add(value_ns, k)
        compiled["add_duration"](words, value_ns, k)
    assert plain.words == other.words
