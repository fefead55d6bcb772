"""The shared-memory rings: order, wrap-around, exact drop counts; a deque is the model."""

from __future__ import annotations

import os
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.recording.errors import RecordingError
from firmware_py.recording.ring import EventRing, RowRing


def second_end(ring: RowRing) -> RowRing:
    """The same memory mapped again, as another process would."""
    return RowRing(os.dup(ring.fd))


@given(st.integers(1, 7), st.lists(st.one_of(st.just("push"), st.integers(1, 5)), max_size=80))
def test_rows_come_out_in_order_and_drops_are_exact(capacity: int, actions: list[str | int]) -> None:
    producer = RowRing.create(3, capacity)
    consumer = second_end(producer)
    model: deque[int] = deque()
    pushed = dropped = 0
    for action in actions:
        if action == "push":
            taken = producer.push(np.array([pushed, -pushed, 0.5]))
            assert taken == (len(model) < capacity)
            if taken:
                model.append(pushed)
            else:
                dropped += 1
            pushed += 1
        else:
            numbers, rows = consumer.pop(int(action))
            assert len(numbers) <= int(action)
            assert len(numbers) > 0 or not model
            for number, row in zip(numbers.tolist(), rows.tolist(), strict=True):
                assert number == model.popleft()
                assert row == [number, -number, 0.5]
        assert (producer.pushed, producer.dropped) == (pushed, dropped)
        assert (consumer.pushed, consumer.dropped, consumer.waiting()) == (pushed, dropped, len(model))
        assert producer.full() == (len(model) == capacity)
    producer.close()
    consumer.close()


def test_rows_keep_every_bit() -> None:
    ring = RowRing.create(2, 4)
    row = np.array([0x7FF8_0000_DEAD_BEEF, 0x8000_0000_0000_0000], dtype=np.uint64).view(np.float64)
    ring.push(row)
    _, rows = ring.pop(1)
    assert rows.view(np.uint64).tolist() == [[0x7FF8_0000_DEAD_BEEF, 0x8000_0000_0000_0000]]
    ring.close()


def test_a_full_ring_keeps_the_oldest_and_numbers_show_the_gap() -> None:
    ring = RowRing.create(1, 3)
    assert [ring.push(np.array([float(i)])) for i in range(5)] == [True, True, True, False, False]
    assert ring.pop(2)[0].tolist() == [0, 1]
    ring.push(np.array([5.0]))
    assert ring.pop(8)[0].tolist() == [2]  # a pop stops where the memory wraps
    assert ring.pop(8)[0].tolist() == [5]
    assert (ring.pushed, ring.dropped) == (6, 2)
    ring.close()


def test_what_was_pushed_survives_the_producer() -> None:
    producer = RowRing.create(1, 8)
    consumer = second_end(producer)
    producer.push(np.array([42.0]))
    producer.close()
    assert consumer.pop(8)[1].tolist() == [[42.0]]
    consumer.close()


def test_the_consumer_reports_back() -> None:
    producer = RowRing.create(1, 8)
    consumer = second_end(producer)
    consumer.report(written=7, state=2)
    assert (producer.written, producer.state) == (7, 2)
    producer.close()
    consumer.close()


@given(st.lists(st.one_of(st.binary(max_size=40), st.none()), max_size=60))
def test_events_come_out_whole_and_numbered(actions: list[bytes | None]) -> None:
    producer = EventRing.create(128)
    consumer = EventRing(os.dup(producer.fd))
    model: deque[tuple[int, bytes]] = deque()
    used = pushed = dropped = 0
    for action in actions:
        if action is None:
            expected = model.popleft() if model else None
            assert consumer.pop() == expected
            used -= 12 + len(expected[1]) if expected else 0
        else:
            fits = used + 12 + len(action) <= 128
            assert producer.push(action) == fits
            if fits:
                model.append((pushed, action))
                used += 12 + len(action)
            dropped += not fits
            pushed += 1
        assert (producer.pushed, producer.dropped) == (consumer.pushed, consumer.dropped) == (pushed, dropped)
    producer.close()
    consumer.close()


def test_an_event_larger_than_the_ring_is_dropped_and_counted() -> None:
    ring = EventRing.create(64)
    assert not ring.push(bytes(100))
    assert ring.dropped == 1
    assert ring.push(b"small")
    assert ring.pop() == (1, b"small")
    ring.close()


def test_the_wrong_memory_is_refused() -> None:
    ring = EventRing.create(4096)
    with pytest.raises(RecordingError, match="not a recording ring of this kind"):
        RowRing(os.dup(ring.fd))
    ring.close()


def test_a_machine_with_other_memory_ordering_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(RecordingError, match=r"x86-64; this machine is aarch64"):
        RowRing.create(1, 1)
