"""A CAN bus behind a Unix socket, so that the firmware's process can reach emulated nodes.

The socket is of type SOCK_SEQPACKET, and each packet is one ``struct can_frame`` (``hal.can_wire``). All connections
are one host: each hears every node, and none hears another one. A packet that is no data frame is passed over. A client
that does not read loses frames, as in a full receive queue of the kernel; ``lost`` counts them.
"""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

from hal.can_wire import FRAME_BYTES, pack_frame, unpack_frame
from hal.types import CanFrame
from sim_devices.transports.can_hub import EXTENDED, CanHub


class CanSocketServer:
    """Serves one ``CanHub``. Watch ``filenos`` for reading."""

    def __init__(self, hub: CanHub, path: Path) -> None:
        self.path = path
        self.lost = 0
        self._hub = hub
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._listener.setblocking(False)
        self._clients: dict[int, socket.socket] = {}
        hub.host = self._to_host

    @property
    def uri(self) -> str:
        """The URI for the adapters of hal."""
        return f"unix-can://{self.path}"

    def filenos(self) -> list[int]:
        return [self._listener.fileno(), *self._clients]

    def pump(self, fileno: int, t_ns: int) -> None:
        """Take what has arrived on one of ``filenos``; the hub's bus time applies from ``t_ns`` on."""
        if fileno == self._listener.fileno():
            client, _ = self._listener.accept()
            client.setblocking(False)
            self._clients[client.fileno()] = client
            return
        with contextlib.suppress(BlockingIOError):
            while packed := self._receive(fileno):
                if frame := unpack_frame(packed, t_ns):
                    can_id = frame.can_id | (EXTENDED if frame.extended else 0)
                    self._hub.send_from_host(can_id, frame.data, t_ns)
            self._clients.pop(fileno).close()

    def _receive(self, fileno: int) -> bytes:
        try:
            return self._clients[fileno].recv(FRAME_BYTES + 1)
        except ConnectionError:
            return b""

    def close(self) -> None:
        self._listener.close()
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self.path.unlink(missing_ok=True)

    def _to_host(self, can_id: int, data: bytes, t_ns: int) -> None:
        packed = pack_frame(CanFrame(can_id & ~EXTENDED, data, bool(can_id & EXTENDED)))
        for client in self._clients.values():
            try:
                client.send(packed)
            except BlockingIOError:
                self.lost += 1
            except OSError:
                pass  # it has gone; ``pump`` sees that
