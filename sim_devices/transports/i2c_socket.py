"""An I2C bus behind a Unix stream socket, so that the firmware's process can reach emulated devices.

Request: u8 address, u8 number of operations, i64 LE monotonic time of the request in ns, then per operation u8 kind (0
write, 1 read), u16 LE length and, for a write, the data. Reply: u8 status (0 ok, 1 address NACK, 2 data NACK, 3 bus
error), u16 LE length, data. One request at a time per connection; several connections share the bus in turn. The
transfer begins when it was asked for, unless the emulated world has gone past that or the bus was busy; the answer
leaves when its bus time has passed, so the caller waits as long as it would for a real adapter. A request that breaks
the format closes the connection.
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
_HEAD = struct.Struct("<BBq")


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
        # start, client, address, operations; a client is its socket, since the next one may have its descriptor
        self._queue: deque[tuple[int, socket.socket, int, Sequence[I2cOp]]] = deque()
        self._active: tuple[socket.socket, Transfer] | None = None
        self._due_ns = 0
        self._reply_ns = 0
        self._free_ns = 0
        self._held: list[tuple[socket.socket, bytes]] | None = None

    @property
    def has_clients(self) -> bool:
        """Somebody is connected."""
        return bool(self._clients)

    def filenos(self) -> list[int]:
        return [self._listener.fileno(), *self._clients]

    def on_readable(self, fileno: int, reached_ns: int, now_ns: int, behind_ns: int = 0) -> None:
        """Take what arrived on one of ``filenos``. The transfer of a complete request becomes due when it was asked
        for, but not before ``reached_ns``, up to which the world has gone, nor after ``now_ns``. ``behind_ns`` is how
        far these are behind the machine's clock."""
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
                asked_ns, address, ops = request
                self._queue.append((min(max(asked_ns - behind_ns, reached_ns), now_ns), client, address, ops))
        except ValueError:
            data = b""
        if not data:
            self._drop(fileno)

    def reply_ns(self) -> int | None:
        """Return the time at which the transfer in progress ends, or ``None`` if there is none.

        The loop can sleep until then, because the single segments need no action at their own times."""
        return self._reply_ns if self._active is not None else None

    def next_event_ns(self) -> int | None:
        if self._active is not None:
            return self._due_ns
        return max(self._queue[0][0], self._free_ns) if self._queue else None

    def advance_to(self, t_ns: int) -> None:
        while (due_ns := self.next_event_ns()) is not None and due_ns <= t_ns:
            if self._active is None:
                self._start(due_ns)
                continue
            client, transfer = self._active
            try:
                self._due_ns = next(transfer)
            except StopIteration as done:
                self._active = None
                self._free_ns = due_ns
                self._answer(client, done.value)

    def hold(self) -> None:
        """Keep answers back until ``release``: for who lets a transfer end a little before its time has come."""
        if self._held is None:
            self._held = []

    def release(self) -> None:
        held, self._held = self._held, None
        for client, answer in held or ():
            self._say(client, answer)

    def close(self) -> None:
        self._listener.close()
        for client, _ in self._clients.values():
            client.close()
        self._clients.clear()
        self.path.unlink(missing_ok=True)

    def _start(self, t_ns: int) -> None:
        _, client, address, ops = self._queue.popleft()
        transfer = self._line.transfer(address, ops, t_ns)
        self._active = (client, transfer)
        self._due_ns = next(transfer)
        self._reply_ns = t_ns + self._line.duration_ns(ops)

    def _answer(self, client: socket.socket, result: TransferResult) -> None:
        status, data = result
        answer = struct.pack("<BH", status, len(data)) + data
        if self._held is None:
            self._say(client, answer)
        else:
            self._held.append((client, answer))

    def _say(self, client: socket.socket, answer: bytes) -> None:
        fileno = client.fileno()
        if fileno in self._clients:  # -1 after it was dropped
            try:
                client.sendall(answer)
            except OSError:
                self._drop(fileno)

    def _drop(self, fileno: int) -> None:
        client, _ = self._clients.pop(fileno)
        client.close()
        self._queue = deque(item for item in self._queue if item[1] is not client)


def _parse(buffer: bytearray) -> tuple[int, int, Sequence[I2cOp]] | None:
    """Time, address and operations of the first complete request, removed from ``buffer``; ``None`` when more bytes
    are needed."""
    if buffer and (buffer[0] > 0x7F or (len(buffer) > 1 and not 1 <= buffer[1] <= MAX_OPS)):
        raise ValueError("not an I2C request")
    if len(buffer) < _HEAD.size:
        return None
    address, count, asked_ns = _HEAD.unpack_from(buffer)
    ops: list[I2cOp] = []
    at = _HEAD.size
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
    return asked_ns, address, ops
