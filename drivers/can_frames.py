"""Sends the heartbeat of this host, which the CAN drivers of one bus share."""

from __future__ import annotations

from array import array

from drivers.base import next_due_ns
from drivers.dbc import DbcDatabase
from drivers.registry import Traffic
from hal.contracts import CanBus, Clock
from hal.types import CanFrame
from hal.wire_bits import can_bits

HEARTBEAT_PERIOD_NS = 20_000_000
HEARTBEAT_BYTES = 1


BEAT_DUE_NS, BEAT_STATE, BEATS, BEAT_WORDS = range(4)
"""Places in ``HostHeartbeat.words``: due time of the next one (bench clock, ns), its data byte, number sent."""


class HostHeartbeat:
    """Sends HOST_HEARTBEAT at 50 Hz; call ``beat`` at that rate or more often. There is one per bus and process.

    A compiled loop sends it over the same ``words``."""

    def __init__(self, bus: CanBus, clock: Clock, database: DbcDatabase) -> None:
        self.words = array("q", bytes(8 * BEAT_WORDS))
        self.can_id = database.get_message_by_name("HOST_HEARTBEAT").frame_id
        self._bus = bus
        self._clock = clock

    @property
    def state(self) -> int:
        """Return the data byte, which is the supervisor's state."""
        return self.words[BEAT_STATE]

    @state.setter
    def state(self, state: int) -> None:
        self.words[BEAT_STATE] = state & 0xFF

    @property
    def sent(self) -> int:
        return self.words[BEATS]

    def beat(self) -> None:
        """Send a heartbeat if one is due, every 20 ms."""
        words, now_ns = self.words, self._clock.now_ns()
        if now_ns < words[BEAT_DUE_NS]:
            return
        words[BEAT_DUE_NS] = next_due_ns(words[BEAT_DUE_NS], now_ns, HEARTBEAT_PERIOD_NS)
        self._bus.send(CanFrame(self.can_id, bytes((words[BEAT_STATE],))), 0.0)
        words[BEATS] += 1


def host_heartbeat() -> Traffic:
    """Return the traffic of the host's heartbeat, which is sent once per bus for all devices."""
    return Traffic("HOST_HEARTBEAT", can_bits(HEARTBEAT_BYTES), 1e9 / HEARTBEAT_PERIOD_NS)
