"""Serves a Unix stream socket on which other programs control an emulated world: one JSON order and one answer per
line.

Orders are described in ``sim_devices.control`` and docs/emulate.md.
"""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Callable
from pathlib import Path

MAX_LINE = 1 << 24
"""Longest order in bytes; a client that sends a longer one is cut off. Long columns are played from a file."""


class ControlSocket:
    """Serves ``answer(line) -> line`` at ``path``; both lines are without their newline."""

    def __init__(self, path: Path, answer: Callable[[bytes], bytes]) -> None:
        self._path = path
        self._answer = answer
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._listener.setblocking(False)
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}

    def filenos(self) -> list[int]:
        return [self._listener.fileno(), *self._clients]

    def pump(self) -> None:
        """Answer what has arrived, without waiting."""
        for fileno in select.select(self.filenos(), (), (), 0)[0]:
            self.on_readable(fileno)

    def on_readable(self, fileno: int) -> None:
        """Take what arrived on one of ``filenos`` and answer every complete line."""
        if fileno == self._listener.fileno():
            with contextlib.suppress(OSError):
                client, _ = self._listener.accept()
                client.settimeout(1.0)  # for a client that does not read its answers
                self._clients[client.fileno()] = (client, bytearray())
            return
        client, buffer = self._clients[fileno]
        try:
            data = client.recv(1 << 16)
            buffer += data
            *lines, rest = bytes(buffer).split(b"\n") if b"\n" in data else [bytes(buffer)]
            for line in lines:
                if line.strip():
                    client.sendall(self._answer(line) + b"\n")
            buffer[:] = rest
        except OSError:
            data = b""
        if not data or len(buffer) > MAX_LINE:
            del self._clients[fileno]
            client.close()

    def close(self) -> None:
        """Hang up on every client and remove the socket. Idempotent."""
        self._listener.close()
        for client, _ in self._clients.values():
            client.close()
        self._clients.clear()
        self._path.unlink(missing_ok=True)
