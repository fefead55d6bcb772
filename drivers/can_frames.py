"""Parts that the CAN drivers share: the checksum of setpoints and the heartbeat of this host."""

from __future__ import annotations

from drivers.base import next_due_ns
from drivers.dbc import DbcDatabase
from drivers.registry import Traffic
from hal.contracts import CanBus, Clock
from hal.types import CanFrame
from hal.wire_bits import can_bits

HEARTBEAT_PERIOD_NS = 20_000_000
HEARTBEAT_BYTES = 1


def _crc_table() -> bytes:
    table = bytearray(256)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        table[byte] = crc
    return bytes(table)


_CRC_TABLE = _crc_table()


def crc8_j1850(data: bytes) -> int:
    """Return the CRC-8/SAE-J1850: polynomial 0x1D, start 0xFF, result inverted; "123456789" gives 0x4B."""
    table = _CRC_TABLE
    crc = 0xFF
    for byte in data:
        crc = table[crc ^ byte]
    return crc ^ 0xFF


class HostHeartbeat:
    """HOST_HEARTBEAT at 50 Hz, sent by whoever calls ``beat`` often enough. One per bus and process."""

    def __init__(self, bus: CanBus, clock: Clock, database: DbcDatabase) -> None:
        self.state = 0
        self.sent = 0
        self._bus = bus
        self._clock = clock
        self._id = database.get_message_by_name("HOST_HEARTBEAT").frame_id
        self._due_ns = 0

    def beat(self) -> None:
        """Send if 20 ms have passed since the last one."""
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return
        self._due_ns = next_due_ns(self._due_ns, now_ns, HEARTBEAT_PERIOD_NS)
        self._bus.send(CanFrame(self._id, bytes((self.state & 0xFF,))), 0.0)
        self.sent += 1


def host_heartbeat() -> Traffic:
    """Return the traffic of the host's heartbeat, which is sent once per bus for all devices."""
    return Traffic("HOST_HEARTBEAT", can_bits(HEARTBEAT_BYTES), 1e9 / HEARTBEAT_PERIOD_NS)
