"""A CAN hub on python-can's UDP multicast interface, for nodes and host in different processes.

Its three traps (measured, ``ecosystem.md`` section 2) and what is done about them: a bus hears its own frames in
spite of ``receive_own_messages=False`` (identifiers that our nodes send are dropped on reception); two groups on
one port hear each other (every bus gets a port of its own); a burst is cut at 256 unread frames (the socket is
emptied on every turn of the loop). ``hop_limit=0`` keeps the frames on this machine.
"""

from __future__ import annotations

import importlib
import socket
from typing import Any

from sim_devices.transports.can_hub import EXTENDED, CanHub

GROUP = "239.74.163.2"


def free_udp_port() -> int:
    """A UDP port that nobody uses at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


class CanMulticast:
    """Joins ``hub`` to a multicast port: what its nodes send goes out, what the host sends comes in."""

    def __init__(self, hub: CanHub, port: int) -> None:
        can: Any = importlib.import_module("can")
        self.uri = f"udp-multicast://{GROUP}:{port}"
        self._message: Any = can.Message
        self._bus: Any = can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False)
        self._hub = hub
        self._own_ids: set[int] = set()
        hub.host = self._to_host

    def fileno(self) -> int:
        return int(self._bus.fileno())

    def pump(self, t_ns: int) -> None:
        """Hand what has arrived to the nodes; the hub's bus time applies from ``t_ns`` on."""
        while (message := self._bus.recv(0)) is not None:
            can_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
            if can_id not in self._own_ids:
                self._hub.send_from_host(can_id, bytes(message.data), t_ns)

    def close(self) -> None:
        self._bus.shutdown()

    def _to_host(self, can_id: int, data: bytes, t_ns: int) -> None:
        self._own_ids.add(can_id)
        self._bus.send(self._message(arbitration_id=can_id, data=data, is_extended_id=False, check=True))
