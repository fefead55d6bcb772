"""Parts that the CAN drivers share: the heartbeat of this host."""

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
"""Places in ``HostHeartbeat.words``: when the next one is due, its data byte, and how many were sent."""


class HostHeartbeat:
    """HOST_HEARTBEAT at 50 Hz, sent by whoever calls ``beat`` often enough. One per bus and process.

    A compiled loop sends it over the same ``words``."""

    def __init__(self, bus: CanBus, clock: Clock, database: DbcDatabase) -> None:
        self.words = array("q", bytes(8 * BEAT_WORDS))
        self.can_id = database.get_message_by_name("HOST_HEARTBEAT").frame_id
        self._bus = bus
        self._clock = clock

    @property
    def state(self) -> int:
        """The data byte."""
        return self.words[BEAT_STATE]

    @state.setter
    def state(self, state: int) -> None:
        self.words[BEAT_STATE] = state & 0xFF

    @property
    def sent(self) -> int:
        return self.words[BEATS]

    def beat(self) -> None:
        """Send if 20 ms have passed since the last one."""
        words, now_ns = self.words, self._clock.now_ns()
        if now_ns < words[BEAT_DUE_NS]:
            return
        words[BEAT_DUE_NS] = next_due_ns(words[BEAT_DUE_NS], now_ns, HEARTBEAT_PERIOD_NS)
        self._bus.send(CanFrame(self.can_id, bytes((words[BEAT_STATE],))), 0.0)
        words[BEATS] += 1


def host_heartbeat() -> Traffic:
    """Return the traffic of the host's heartbeat, which is sent once per bus for all devices."""
    return Traffic("HOST_HEARTBEAT", can_bits(HEARTBEAT_BYTES), 1e9 / HEARTBEAT_PERIOD_NS)
