"""Socket pairs between a compiled loop and the emulated devices of virtual time."""

from __future__ import annotations

import contextlib
import os
import select
import socket

from hal.contracts import SerialPort
from hal.errors import HalError
from hal.types import PortInfo


def _new_pair() -> tuple[socket.socket, socket.socket]:
    pair = socket.socketpair()
    for end in pair:
        end.setblocking(False)
    return pair


class SocketPort:
    """``Fed`` over a port of virtual time: what the device sends passes a socket pair, and so does what is written to
    its descriptor. A read or write of Python goes around it, after what waits there. While the port takes nothing, the
    descriptor does neither: the socket's queue is full."""

    def __init__(self, port: SerialPort) -> None:
        self._port = port
        self._near, self._far = _new_pair()
        self._room = memoryview(bytearray(1 << 16))
        self._is_filled = False

    def leave_to_parent(self) -> None:
        """Go on over a pair of this process alone, with a copy of what waits in the one that a fork has shared."""
        if self._far.fileno() < 0:
            return
        near, far = _new_pair()
        for shared, opposite in ((self._near, far), (self._far, near)):
            if select.select([shared], [], [], 0.0)[0]:
                opposite.sendall(shared.recv(1 << 20, socket.MSG_PEEK))
        for shared, own in ((self._near, near), (self._far, far)):
            os.dup2(own.fileno(), shared.fileno(), inheritable=False)  # a compiled loop may know the number already
            own.close()

    def fileno(self) -> int:
        return self._near.fileno()

    def feed(self, timeout_s: float) -> None:
        self._fill_or_empty()
        if not select.select([self._near], [], [], 0.0)[0]:
            try:
                n = self._port.read_into(self._room, timeout_s)
            except HalError:
                self._far.close()  # so that the descriptor fails as well; the next call of Python says why
                return
            self._far.sendall(self._room[:n])

    def _fill_or_empty(self) -> None:
        if getattr(self._port, "is_full", False) == self._is_filled:
            return
        self._is_filled = not self._is_filled
        with contextlib.suppress(BlockingIOError):
            while self._is_filled:
                self._near.send(bytes(1 << 16))
        while not self._is_filled and select.select([self._far], [], [], 0.0)[0]:
            self._far.recv(1 << 16)

    def flush(self) -> None:
        if self._is_filled:
            return
        while self._far.fileno() >= 0 and select.select([self._far], [], [], 0.0)[0]:
            for line in self._far.recv(4096).splitlines(keepends=True):
                self._port.write(line, 0.0)  # one by one, as the driver writes them: a device draws its delays by write

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        if select.select([self._near], [], [], 0.0)[0]:
            n = os.readv(self._near.fileno(), [buf])
            if n:
                return n
        return self._port.read_into(buf, timeout_s)

    def write(self, data: bytes, timeout_s: float) -> None:
        self._port.write(data, timeout_s)

    def drain_input(self) -> int:
        n = 0
        while select.select([self._near], [], [], 0.0)[0] and (data := self._near.recv(4096)):
            n += len(data)
        return n + self._port.drain_input()

    def info(self) -> PortInfo:
        return self._port.info()

    def close(self) -> None:
        self._port.close()
        self._near.close()
        self._far.close()
