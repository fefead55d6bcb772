"""Encodes and decodes the CAN node's frames and judges its link, in the interpreter and compiled, on the same memory.

They read no clock, raise nothing and import no numba. Data bytes of a frame are ``bytes`` in the interpreter and an
array in compiled code. A compiled loop gives the functions to ``hal.compiled.kernel``.
"""

from __future__ import annotations

from array import array
from typing import Any, NamedTuple

import numpy as np

CHANNELS = 3
FULL_V = 100.0
CODES_PER_V = 65535.0 / FULL_V
DISARMED, ARMED, SAFE_RAMP, FAULT = range(4)
SETPOINT_BYTES = STATUS_BYTES = 8
CODE_BYTES = 6
STATUS_LIMIT_NS = 100_000_000
"""Longest time without a STATUS frame: ten of its periods."""
COUNTER_LAG_LIMIT = 64
"""Largest number of set points in a row that no STATUS has acknowledged."""
COMMAND_EVERY = 5
"""Ticks of a ramp from one COMMAND to the next."""
RECEIVE_LIMIT = 32
"""Largest number of frames received per tick, so that a flooded bus cannot delay it."""

STATE, COUNTER, ACKNOWLEDGED, STATUS_NS, SAFE_STEPS, ASKED_NS, WORDS = range(7)
"""Places in ``NodeMemory.words``: the node's state, the counter of the next set point, the last one that a STATUS has
acknowledged, the bench time of that (ns), steps since the safe state was requested, and the bench time of that."""
WELL, SILENT, LEFT, LAGS = range(4)
"""The answers of ``link_fault``: nothing, no STATUS, a node that is not armed, set points that are not accepted."""


def _crc_table() -> bytes:
    table = bytearray(256)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        table[byte] = crc
    return bytes(table)


CRC_TABLE = _crc_table()
"""CRC-8/SAE-J1850 of each byte: polynomial 0x1D. A checksum begins with 0xFF and is inverted at the end."""


class NodeMemory(NamedTuple):
    """Holds what the driver knows of its node: ``words`` as named above, ``measured_V`` (3,), ``setpoint`` (8,) the
    data bytes of the next SETPOINT, ``crc`` (256,)."""

    words: Any
    measured_V: Any
    setpoint: Any
    crc: Any

    def view(self) -> NodeMemory:
        """Return numpy arrays over the same memory, for compiled code."""
        return NodeMemory(
            np.frombuffer(self.words, np.int64), np.frombuffer(self.measured_V, np.float64),
            np.frombuffer(self.setpoint, np.uint8), np.frombuffer(self.crc, np.uint8).copy(),
        )  # fmt: skip


def new_node() -> NodeMemory:
    """Return the memory before the first STATUS."""
    return NodeMemory(
        array("q", bytes(8 * WORDS)), array("d", [float("nan")] * CHANNELS), bytearray(SETPOINT_BYTES), CRC_TABLE
    )


def encode_setpoint(node: NodeMemory, values_V: Any) -> None:
    """Put ``values_V`` (3,), within 0 .. FULL_V, the counter and the checksum into ``setpoint``."""
    data = node.setpoint
    for i in range(CHANNELS):
        code = int(values_V[i] * CODES_PER_V + 0.5)
        data[2 * i] = code & 0xFF
        data[2 * i + 1] = code >> 8
    data[CODE_BYTES] = node.words[COUNTER]
    crc = 0xFF
    for i in range(CODE_BYTES + 1):
        crc = node.crc[crc ^ data[i]]
    data[CODE_BYTES + 1] = crc ^ 0xFF


def note_setpoint(node: NodeMemory) -> None:
    """Note that the bus has taken ``setpoint``."""
    node.words[COUNTER] = (node.words[COUNTER] + 1) & 0xFF


def decode_status(node: NodeMemory, data: Any, t_ns: int) -> bool:
    """Take the STATUS ``data`` that came at ``t_ns``, unless a newer one was taken. Return False if its length is
    wrong."""
    if len(data) != STATUS_BYTES:
        return False
    words = node.words
    if t_ns < words[STATUS_NS]:
        return True
    for i in range(CHANNELS):
        node.measured_V[i] = (data[2 * i] | data[2 * i + 1] << 8) / CODES_PER_V
    words[STATE] = min(data[CODE_BYTES], FAULT)
    words[ACKNOWLEDGED] = data[CODE_BYTES + 1]
    words[STATUS_NS] = t_ns
    return True


def lag(node: NodeMemory) -> int:
    """Return how many set points no STATUS has acknowledged, modulo 256."""
    return (node.words[COUNTER] - 1 - node.words[ACKNOWLEDGED]) & 0xFF


def link_fault(node: NodeMemory, now_ns: int) -> int:
    """Return what is wrong with an armed node at ``now_ns``, WELL if nothing is."""
    words = node.words
    if now_ns - words[STATUS_NS] > STATUS_LIMIT_NS:
        return SILENT
    if words[STATE] != ARMED:
        return LEFT
    return LAGS if (words[COUNTER] - 1 - words[ACKNOWLEDGED]) & 0xFF > COUNTER_LAG_LIMIT else WELL


def must_ask(node: NodeMemory, now_ns: int) -> bool:
    """Return True if this step of the way to the safe state begins with a COMMAND."""
    words = node.words
    if words[SAFE_STEPS] == 0:
        words[ASKED_NS] = now_ns
    return words[SAFE_STEPS] % COMMAND_EVERY == 0


def is_safe(node: NodeMemory) -> bool:
    """Return True once the node reports that it is disarmed, with its outputs at the safe state; then count anew."""
    words = node.words
    if words[STATE] != DISARMED or words[STATUS_NS] <= words[ASKED_NS]:
        return False
    words[SAFE_STEPS] = 0
    return True
