"""The CAN node's functions give the same memory compiled as in the interpreter; frames agree with the DBC."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.dbc import load_database
from drivers.piezo.can_loop import node_decode, node_encode, node_fault, node_is_safe, node_must_ask, node_note
from drivers.piezo.can_node import (
    ACKNOWLEDGED,
    CODES_PER_V,
    COUNTER,
    NodeMemory,
    decode_status,
    encode_setpoint,
    is_safe,
    link_fault,
    must_ask,
    new_node,
    note_setpoint,
)
from tests.wire.drivers.test_can_drivers_wire import crc_bit_by_bit

volts = st.lists(st.floats(0.0, 100.0), min_size=3, max_size=3)
Step = tuple[str, object]
steps = st.lists(
    st.one_of(
        st.tuples(st.just("write"), volts),
        st.tuples(st.just("status"), st.binary(min_size=6, max_size=9)),
        st.tuples(st.just("fault"), st.just(None)),
        st.tuples(st.just("safe"), st.just(None)),
    ),
    max_size=40,
)  # fmt: skip


def run(node: NodeMemory, moves: Sequence[Step], ticks: Sequence[int], *, compiled: bool) -> list[object]:
    """Return what each move returned, and the memory after all."""
    encode, note, decode, fault, ask, safe = (
        (node_encode, node_note, node_decode, node_fault, node_must_ask, node_is_safe)
        if compiled
        else (encode_setpoint, note_setpoint, decode_status, link_fault, must_ask, is_safe)
    )
    seen, now_ns = list[object](), 0
    for (what, value), tick_ns in zip(moves, ticks, strict=False):
        now_ns += tick_ns
        match what, value:
            case "write", list():
                encode(node, np.array(value) if compiled else value)  # pyright: ignore[reportUnknownArgumentType]
                note(node)
                seen.append(bytes(node.setpoint))
            case "status", bytes():
                seen.append(decode(node, np.frombuffer(value, np.uint8) if compiled else value, now_ns))
            case "fault", _:
                seen.append(fault(node, now_ns))
            case _:
                seen.append((ask(node, now_ns), safe(node)))
    return [*seen, list(node.words), np.array(node.measured_V).tobytes()]


@settings(deadline=None)
@given(steps, st.lists(st.integers(-5_000_000, 60_000_000), min_size=40, max_size=40))
def test_both_ways_are_one(moves: list[Step], ticks: list[int]):
    assert run(new_node(), moves, ticks, compiled=False) == run(new_node().view(), moves, ticks, compiled=True)


@settings(deadline=None)
@given(volts, st.integers(0, 255))
def test_a_setpoint_is_that_of_the_dbc(values_V: list[float], counter: int):
    node = new_node().view()
    node.words[COUNTER] = counter
    node_encode(node, np.array(values_V))
    sent = load_database().get_message_by_name("SETPOINT").decode(bytes(node.setpoint))
    named = [sent[f"setpoint_{i}"] for i in (1, 2, 3)]
    assert np.allclose(named, values_V, rtol=0.0, atol=0.5 / CODES_PER_V + 1e-9)
    assert sent["counter"] == counter
    assert bytes(node.setpoint)[7] == crc_bit_by_bit(bytes(node.setpoint)[:7])


@settings(deadline=None)
@given(st.binary(min_size=8, max_size=8))
def test_a_status_is_that_of_the_dbc(data: bytes):
    node = new_node().view()
    assert node_decode(node, np.frombuffer(data, np.uint8), 5)
    said = load_database().get_message_by_name("STATUS").decode(data)
    assert np.allclose(node.measured_V, [said[f"measured_{i}"] for i in (1, 2, 3)], atol=1e-9)
    assert node.words[ACKNOWLEDGED] == said["last_counter"]
