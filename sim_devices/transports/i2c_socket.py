"""An I2C bus behind a Unix stream socket, so that the firmware's process can reach emulated devices.

Request: u8 address, u8 number of operations, then per operation u8 kind (0 write, 1 read), u16 LE length and, for
a write, the data. Reply: u8 status (0 ok, 1 address NACK, 2 data NACK, 3 bus error), u16 LE length, data. One
request at a time per connection; several connections share the bus in turn. The answer leaves when the bus time
of the transfer has passed, so the caller waits as long as it would for a real adapter. A request that breaks the
format closes the connection.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from hal.types import I2cOp, I2cRead, I2cWrite
from sim_devices.transports.i2c_line import I2cLine, Transfer, TransferResult

MAX_OPS = 42  # Linux I2C_RDWR_IOCTL_MAX_MSGS
MAX_LENGTH = 8192  # Linux i2c-dev limit of one message


class I2cSocketServer:
    """Serves one ``I2cLine``. A timed face: register it with the world, watch ``filenos`` for reading."""

    def __init__(self, line: I2cLine, path: Path) -> None:
        self.path = path
        self._line = line
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._listener.setblocking(False)
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}
        self._queue: deque[tuple[int, int, Sequence[I2cOp]]] = deque()  # client, address, operations
        self._active: tuple[int, Transfer] | None = None
        self._due_ns = 0
        self._reply_ns = 0

    def filenos(self) -> list[int]:
        return [self._listener.fileno(), *self._clients]

    def on_readable(self, fileno: int, t_ns: int) -> None:
        """Take what arrived on one of ``filenos``; a complete request starts its transfer at ``t_ns``."""
        if fileno == self._listener.fileno():
            client, _ = self._listener.accept()
            client.setblocking(False)
            self._clients[client.fileno()] = (client, bytearray())
            return
        client, buffer = self._clients[fileno]
        data = b""
        with contextlib.suppress(ConnectionError):
            data = client.recv(65536)
        buffer += data
        try:
            while (request := _parse(buffer)) is not None:
                self._queue.append((fileno, *request))
        except ValueError:
            data = b""
        if not data:
            self._drop(fileno)
        self._start_next(t_ns)

    def reply_ns(self) -> int | None:
        """When the transfer under way is over: nobody needs to wake for its single segments."""
        return self._reply_ns if self._active is not None else None

    def next_event_ns(self) -> int | None:
        return self._due_ns if self._active is not None else None

    def advance_to(self, t_ns: int) -> None:
        while self._active is not None and self._due_ns <= t_ns:
            fileno, transfer = self._active
            try:
                self._due_ns = next(transfer)
            except StopIteration as done:
                self._active = None
                self._answer(fileno, done.value)
                self._start_next(t_ns)

    def close(self) -> None:
        self._listener.close()
        for client, _ in self._clients.values():
            client.close()
        self._clients.clear()
        self.path.unlink(missing_ok=True)

    def _start_next(self, t_ns: int) -> None:
        if self._active is None and self._queue:
            fileno, address, ops = self._queue.popleft()
            transfer = self._line.transfer(address, ops, t_ns)
            self._active = (fileno, transfer)
            self._due_ns = next(transfer)
            self._reply_ns = t_ns + self._line.duration_ns(ops)

    def _answer(self, fileno: int, result: TransferResult) -> None:
        status, data = result
        if fileno in self._clients:
            try:
                self._clients[fileno][0].sendall(struct.pack("<BH", status, len(data)) + data)
            except OSError:
                self._drop(fileno)

    def _drop(self, fileno: int) -> None:
        client, _ = self._clients.pop(fileno)
        client.close()
        self._queue = deque(item for item in self._queue if item[0] != fileno)


def _parse(buffer: bytearray) -> tuple[int, Sequence[I2cOp]] | None:
    """The first complete request, removed from ``buffer``; ``None`` when more bytes are needed."""
    if len(buffer) < 2:
        return None
    address, count = buffer[0], buffer[1]
    if address > 0x7F or not 1 <= count <= MAX_OPS:
        raise ValueError("not an I2C request")
    ops: list[I2cOp] = []
    at = 2
    for _ in range(count):
        if len(buffer) < at + 3:
            return None
        kind, length = struct.unpack_from("<BH", buffer, at)
        at += 3
        if kind > 1 or length > MAX_LENGTH:
            raise ValueError("not an I2C request")
        if kind == 1:
            ops.append(I2cRead(length))
            continue
        if len(buffer) < at + length:
            return None
        ops.append(I2cWrite(bytes(buffer[at : at + length])))
        at += length
    del buffer[:at]
    return address, ops
