"""The instrument panel on the CAN bus: listens to the host's telemetry, sends nothing.

Source: frame table of the bench (issue 2). 0x200: tremor amplitude x, y, z in 0.1 um and frequency in 0.01 Hz,
four uint16 little endian. 0x201: state and flags uint8, lost samples, skipped ticks and worst tick (us), three
uint16 little endian. Truth face: the values last shown, in SI-named attributes, and counters.

Model limits
- A frame of the wrong length is counted in ``malformed`` and otherwise ignored; there is no display update time.
"""

from __future__ import annotations

import struct

TREMOR_ID, STATE_ID = 0x200, 0x201


class CanTelemetryListener:
    """Holds the last telemetry. ``last_ns`` is when something last arrived, -1 before that."""

    def __init__(self) -> None:
        self.amplitude_um = (0.0, 0.0, 0.0)
        self.frequency_hz = 0.0
        self.state = 0
        self.flags = 0
        self.lost_samples = 0
        self.skipped_ticks = 0
        self.worst_tick_us = 0
        self.frames = 0
        self.malformed = 0
        self.last_ns = -1

    def receive(self, can_id: int, data: bytes, t_ns: int) -> None:
        if can_id not in (TREMOR_ID, STATE_ID):
            return
        if len(data) != 8:
            self.malformed += 1
            return
        self.frames += 1
        self.last_ns = t_ns
        if can_id == TREMOR_ID:
            x, y, z, frequency = struct.unpack("<4H", data)
            self.amplitude_um = (x / 10.0, y / 10.0, z / 10.0)
            self.frequency_hz = frequency / 100.0
        else:
            values = struct.unpack("<BBHHH", data)
            self.state, self.flags, self.lost_samples, self.skipped_ticks, self.worst_tick_us = values

    def advance_to(self, t_ns: int) -> None:
        """A listener does nothing by itself."""

    def next_event_ns(self) -> int | None:
        return None

    def take(self) -> list[tuple[int, bytes]]:
        return []
