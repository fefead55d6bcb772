"""A CAN bus in bench time: one frame on the wire at a time, every node hears all frames but its own.

Bus time of a frame with n data bytes: 47 + 8 n bits (ISO 11898-1 classic base frame with interframe space; 67 + 8 n
with an extended identifier) plus half of the worst case of stuff bits. An extended identifier travels with bit 31
set, so that no node takes it for one of its own. Frames go out in the order in which they were queued; arbitration by
priority, error frames and retransmission are not modelled. ``silent`` is a fault hook: a broken cable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from sim_devices.faces import CanFace

HOST = -1
EXTENDED = 1 << 31


def frame_ns(n_data: int, bitrate: int, *, extended: bool = False) -> int:
    """Time on the wire of a frame with ``n_data`` bytes."""
    more = 20 if extended else 0
    stuffable = 34 + more + 8 * n_data
    return round((47 + more + 8 * n_data + (stuffable - 1) // 4 / 2) * 1e9 / bitrate)


class CanHub:
    """Connects nodes and the host on one bus. It is a timed face: ``next_event_ns`` is the end of the frame on the
    wire."""

    def __init__(self, bitrate: int) -> None:
        self.host: Callable[[int, bytes, int], None] | None = None
        self.silent = False
        self.frames = 0
        self._bitrate = bitrate
        self._nodes: list[CanFace] = []
        self._wire: deque[tuple[int, int, int, bytes]] = deque()  # end time, sender, id, data
        self._free_ns = 0

    def attach(self, node: CanFace) -> None:
        self._nodes.append(node)

    def send_from_host(self, can_id: int, data: bytes, t_ns: int) -> None:
        self._queue(HOST, can_id, data, t_ns)

    def _queue(self, sender: int, can_id: int, data: bytes, t_ns: int) -> None:
        if self.silent:
            return
        self._free_ns = max(self._free_ns, t_ns) + frame_ns(len(data), self._bitrate, extended=bool(can_id & EXTENDED))
        self._wire.append((self._free_ns, sender, can_id, data))

    def next_event_ns(self) -> int | None:
        nearest = self._wire[0][0] if self._wire else None
        for node in self._nodes:
            due = node.next_event_ns()
            if due is not None and (nearest is None or due < nearest):
                nearest = due
        return nearest

    def advance_to(self, t_ns: int) -> None:
        """Deliver what has arrived by ``t_ns`` and let the nodes act and send."""
        while self._wire and self._wire[0][0] <= t_ns:
            end_ns, sender, can_id, data = self._wire.popleft()
            self.frames += 1
            for i, node in enumerate(self._nodes):
                if i != sender:
                    node.receive(can_id, data, end_ns)
            if sender != HOST and self.host is not None:
                self.host(can_id, data, end_ns)
        for i, node in enumerate(self._nodes):
            node.advance_to(t_ns)
            for can_id, data in node.take():
                self._queue(i, can_id, data, t_ns)
