"""Socket pairs in place of the ptys between an emulated world in real time and its firmware.

What a pty costs is the kernel's: its worker carries the bytes. A stream socket has none, so the difference between the
two is the pty's. ``install`` makes every emulated world that this process starts afterwards use sockets.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import sys
import tempfile
import termios
from pathlib import Path
from typing import Any

import sim_devices.process_world
from hal.backends.pyserial_port import PyserialPort
from sim_devices.faces import ByteFace
from sim_devices.process_world import ProcessWorld
from sim_devices.transports.pty_carrier import LINE_BUFFER_BYTES, READ_BYTES

SCHEME = "serial://"


class SocketSerial(PyserialPort):
    """Is the firmware's end: a port whose descriptor is that of a connected stream socket."""

    def __init__(self, path: str) -> None:
        self._port = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._port.connect(path)
        self._port.setblocking(False)
        self._path, self._baud = path, 0
        self._fd = self._port.fileno()
        self._wait = [self._fd]


class SocketWorld(ProcessWorld):
    """Is the world in the firmware's process; its own process is this module."""

    PROGRAM = "benchmarks.socket_line"

    def endpoint(self, bus: str) -> Any:
        """Return the URI of ``bus``, and for a serial bus the open port."""
        uri = super().endpoint(bus)
        return SocketSerial(uri.removeprefix(SCHEME)) if uri.startswith(SCHEME) else uri


class SocketCarrier:
    """Carries bytes over one connection, as ``PtyCarrier`` does over a pty. It takes one client, and no other one."""

    def __init__(self, face: ByteFace) -> None:
        self._face = face
        self._pending = b""
        self._folder = tempfile.mkdtemp(prefix="micron-")
        self.path = str(Path(self._folder) / "line.sock")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.bind(self.path)
        self._socket.listen(1)
        self._socket.setblocking(False)
        self._is_connected = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def refresh(self) -> None:
        """Tell the face when the host has read all; until then it counts what was handed over since."""
        if self._is_connected and not self._has_unread():
            self._face.unread = len(self._pending)

    def receive(self, t_ns: int) -> None:
        """Take the host's connection, or hand what it has written to the face, without waiting."""
        if not self._is_connected:
            connection, _ = self._socket.accept()
            self._socket.close()
            self._socket, self._is_connected = connection, True
            connection.setblocking(False)
            return
        with contextlib.suppress(BlockingIOError):
            if data := self._socket.recv(READ_BYTES):
                self._face.receive(data, t_ns)
            else:
                self.unplug()

    def send(self) -> None:
        """Give the host what the face has for it, as far as there is room. ``refresh`` comes before."""
        if not self._is_connected:
            return
        if not self._pending:
            self._pending = self._face.take(max(0, LINE_BUFFER_BYTES - self._face.unread))
            self._face.unread += len(self._pending)
        if self._pending:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                self._pending = self._pending[self._socket.send(self._pending) :]

    def unplug(self) -> None:
        """Hang up on the host. Idempotent."""
        self._socket.close()
        self._is_connected = False
        with contextlib.suppress(OSError):
            os.unlink(self.path)
            os.rmdir(self._folder)

    def _has_unread(self) -> bool:
        answer = fcntl.ioctl(self._socket.fileno(), termios.TIOCOUTQ, b"\0\0\0\0")
        return struct.unpack("i", answer)[0] > 0


def install() -> None:
    """Let worlds of this process have socket pairs in place of ptys."""
    sim_devices.process_world.ProcessWorld = SocketWorld


if __name__ == "__main__":
    from sim_devices import process

    process.PtyCarrier = SocketCarrier  # type: ignore[misc, assignment]
    sys.exit(process.main(sys.argv[1:]))
