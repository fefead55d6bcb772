"""A CAN hub on python-can, for nodes and host in different processes: a vcan interface, or UDP multicast.

UDP multicast has three traps (measured), and this is what is done about them: a bus hears its own frames in spite of
``receive_own_messages=False`` (identifiers that our nodes send are dropped on reception); two groups on one port hear
each other (every bus gets a port of its own); a burst is cut at 256 unread frames (the socket is emptied on every turn
of the loop). ``hop_limit=0`` keeps the frames on this machine.
"""

from __future__ import annotations

import socket
from typing import Any

from hal.backends.can_package import import_can
from hal.errors import BenchError
from sim_devices.transports.can_hub import EXTENDED, CanHub

GROUP = "239.74.163.2"


def free_udp_port() -> int:
    """A UDP port that nobody uses at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


class CanCarrier:
    """Joins ``hub`` to an open python-can bus: what its nodes send goes out, what the host sends comes in.

    ``hears_itself`` is True for a bus that returns the frames that it sent."""

    def __init__(self, hub: CanHub, bus: Any, uri: str, *, hears_itself: bool) -> None:
        self.uri = uri
        self._message: Any = import_can().Message
        self._bus = bus
        self._hub = hub
        self._hears_itself = hears_itself
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
        if self._hears_itself:
            self._own_ids.add(can_id)
        self._bus.send(self._message(arbitration_id=can_id, data=data, is_extended_id=False, check=True))


def on_multicast(hub: CanHub, port: int) -> CanCarrier:
    """Join ``hub`` to UDP multicast at ``port``."""
    bus = import_can().Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False)
    return CanCarrier(hub, bus, f"udp-multicast://{GROUP}:{port}", hears_itself=True)


def on_socketcan(hub: CanHub, interface: str) -> CanCarrier:
    """Join ``hub`` to a CAN interface of the kernel. Raises ``BenchError`` when it cannot be opened."""
    try:
        bus = import_can().Bus(interface="socketcan", channel=interface)
    except OSError as error:
        raise BenchError(
            f"CAN interface '{interface}' cannot be opened ({error.strerror}); make it with: "
            f"ip link add dev {interface} type vcan && ip link set {interface} up"
        ) from error
    return CanCarrier(hub, bus, f"socketcan://{interface}", hears_itself=False)
