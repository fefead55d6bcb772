"""A three-channel piezo amplifier with its own CAN controller.

Source: frame table of the bench (issue 2).

| id | from | bytes |
| --- | --- | --- |
| 0x120 SETPOINT | host, each tick | uint16 LE x 3 in 100 V / 65535, counter, CRC-8/SAE-J1850 over bytes 0..6 |
| 0x121 STATUS | node, 100 Hz | uint16 LE x 3 same unit, state, last accepted counter |
| 0x122 COMMAND | host | 0 safe, 1 arm; complement of byte 0 |
| 0x700 heartbeat | host, 50 Hz | state |
| 0x701 heartbeat | node, 10 Hz | state |

States: 0 disarmed, 1 armed, 2 safe ramp, 3 fault. Truth face: ``output_V``, the counters, ``on_output``.

Model limits
- Not in the table, decided here: an armed node that gets no valid setpoint for 10 ms, or no host heartbeat for
  500 ms after the last one (or after arming), ramps to its neutral 50 V at 5 V/ms and is then disarmed; a
  setpoint with a wrong CRC, a wrong length or the counter of the one before is counted and ignored; gaps in the
  counter are counted and accepted; 50 bad setpoints in a row are a fault, which a safe command clears once the
  output is at neutral; setpoints are ignored unless armed.
- ``measured`` is the commanded output: the amplifier's dynamics are the plant's.
- The output moves the instant a frame has arrived; the ramp moves in 1 ms steps.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum

SETPOINT_ID, STATUS_ID, COMMAND_ID, HOST_HEARTBEAT_ID, HEARTBEAT_ID = 0x120, 0x121, 0x122, 0x700, 0x701
UNIT_V = 100.0 / 65535
NEUTRAL = 0x8000
STATUS_PERIOD_NS = 10_000_000
HEARTBEAT_PERIOD_NS = 100_000_000
SETPOINT_TIMEOUT_NS = 10_000_000
HOST_TIMEOUT_NS = 500_000_000
RAMP_STEP_NS = 1_000_000
RAMP_STEP = round(5.0 / UNIT_V)
FAULT_AFTER = 50


class NodeState(IntEnum):
    DISARMED = 0
    ARMED = 1
    SAFE_RAMP = 2
    FAULT = 3


def crc8_sae_j1850(data: bytes) -> int:
    """Polynomial 0x1D, start 0xFF, final XOR 0xFF, not reflected; "123456789" gives 0x4B."""
    crc = 0xFF
    for byte in data:
        crc = _CRC_TABLE[crc ^ byte]
    return crc ^ 0xFF


def _crc_table() -> tuple[int, ...]:
    table: list[int] = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ (0x1D if value & 0x80 else 0)
        table.append(value & 0xFF)
    return tuple(table)


_CRC_TABLE = _crc_table()


class CanPiezoNode:
    """Emulates one node. ``on_output(channel, volts, t_ns)`` is called for each output that changes."""

    def __init__(self, *, on_output: Callable[[int, float, int], None] | None = None, start_ns: int = 0) -> None:
        self.state = NodeState.DISARMED
        self.codes = [NEUTRAL] * 3
        self.silent = False
        self.accepted = 0
        self.rejected = 0
        self.counter_gaps = 0
        self.watchdog_trips = 0
        self._on_output = on_output
        self._counter: int | None = None
        self._bad_in_row = 0
        self._frames: list[tuple[int, bytes]] = []
        self._status_ns = start_ns
        self._heartbeat_ns = start_ns
        self._setpoint_deadline_ns = 0
        self._host_deadline_ns = 0
        self._ramp_ns = 0

    @property
    def output_V(self) -> list[float]:
        """Return the demand to the amplifier, in V."""
        return [code * UNIT_V for code in self.codes]

    # ------------------------------------------------------------------ wire face

    def receive(self, can_id: int, data: bytes, t_ns: int) -> None:
        if self.silent:
            return
        self.advance_to(t_ns)
        if can_id == SETPOINT_ID:
            self._setpoint(data, t_ns)
        elif can_id == COMMAND_ID and len(data) == 2 and data[0] ^ data[1] == 0xFF:
            self._command(data[0], t_ns)
        elif can_id == HOST_HEARTBEAT_ID:
            self._host_deadline_ns = t_ns + HOST_TIMEOUT_NS

    def next_event_ns(self) -> int | None:
        due = min(self._status_ns, self._heartbeat_ns)
        if self.state is NodeState.ARMED:
            due = min(due, self._setpoint_deadline_ns, self._host_deadline_ns)
        elif self._ramping:
            due = min(due, self._ramp_ns)
        return due

    def advance_to(self, t_ns: int) -> None:
        if self.state is NodeState.ARMED:
            deadline_ns = min(self._setpoint_deadline_ns, self._host_deadline_ns)
            if deadline_ns <= t_ns:
                self.watchdog_trips += 1
                self._ramp_down(NodeState.SAFE_RAMP, deadline_ns)
        while self._ramping and self._ramp_ns <= t_ns:
            self._ramp_step(self._ramp_ns)
        if self._status_ns <= t_ns:
            self._status_ns += (1 + (t_ns - self._status_ns) // STATUS_PERIOD_NS) * STATUS_PERIOD_NS
            self._queue(STATUS_ID, struct.pack("<3HBB", *self.codes, self.state, self._counter or 0))
        if self._heartbeat_ns <= t_ns:
            self._heartbeat_ns += (1 + (t_ns - self._heartbeat_ns) // HEARTBEAT_PERIOD_NS) * HEARTBEAT_PERIOD_NS
            self._queue(HEARTBEAT_ID, bytes((self.state,)))

    def take(self) -> list[tuple[int, bytes]]:
        if not self._frames:
            return []
        frames, self._frames = self._frames, []
        return frames

    # ------------------------------------------------------------------ inside

    @property
    def _ramping(self) -> bool:
        away = any(code != NEUTRAL for code in self.codes)
        return self.state is NodeState.SAFE_RAMP or (self.state is NodeState.FAULT and away)

    def _queue(self, can_id: int, data: bytes) -> None:
        if not self.silent:
            self._frames.append((can_id, data))

    def _setpoint(self, data: bytes, t_ns: int) -> None:
        if len(data) != 8 or crc8_sae_j1850(data[:7]) != data[7] or data[6] == self._counter:
            self.rejected += 1
            self._bad_in_row += 1
            if self._bad_in_row >= FAULT_AFTER and self.state is not NodeState.FAULT:
                self._ramp_down(NodeState.FAULT, t_ns)
            return
        self._bad_in_row = 0
        if self.state is not NodeState.ARMED:
            return
        if self._counter is not None and data[6] != (self._counter + 1) & 0xFF:
            self.counter_gaps += 1
        self._counter = data[6]
        self.accepted += 1
        self._setpoint_deadline_ns = t_ns + SETPOINT_TIMEOUT_NS
        for channel, code in enumerate(struct.unpack_from("<3H", data)):
            self._output(channel, code, t_ns)

    def _command(self, order: int, t_ns: int) -> None:
        if order == 1 and self.state is NodeState.DISARMED:
            self.state = NodeState.ARMED
            self._counter = None
            self._setpoint_deadline_ns = t_ns + SETPOINT_TIMEOUT_NS
            self._host_deadline_ns = t_ns + HOST_TIMEOUT_NS
        elif order == 0 and self.state is NodeState.ARMED:
            self._ramp_down(NodeState.SAFE_RAMP, t_ns)
        elif order == 0 and self.state is NodeState.FAULT and not self._ramping:
            self.state = NodeState.DISARMED
            self._bad_in_row = 0

    def _ramp_down(self, state: NodeState, t_ns: int) -> None:
        self.state = state
        self._ramp_ns = t_ns + RAMP_STEP_NS

    def _ramp_step(self, t_ns: int) -> None:
        for channel, code in enumerate(self.codes):
            step = max(-RAMP_STEP, min(RAMP_STEP, NEUTRAL - code))
            self._output(channel, code + step, t_ns)
        self._ramp_ns += RAMP_STEP_NS
        if self.state is NodeState.SAFE_RAMP and all(code == NEUTRAL for code in self.codes):
            self.state = NodeState.DISARMED

    def _output(self, channel: int, code: int, t_ns: int) -> None:
        if code != self.codes[channel]:
            self.codes[channel] = code
            if self._on_output is not None:
                self._on_output(channel, code * UNIT_V, t_ns)
