"""Carries I2C transfers over a Unix stream socket to the process of the emulated world.

Request: u8 address, u8 number of segments, i64 LE monotonic time of the request in ns, then per segment u8 kind (0
write, 1 read), u16 LE length and, for a write, the data. Reply: u8 status (0 ok, 1 address NACK, 2 data NACK, 3 bus
error), u16 LE length, the bytes of all read segments. One request is one transfer. A real adapter begins when it is
asked; the time is there so that an emulated one need not charge for the wake-up of its process.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import time
from collections.abc import Sequence

from hal.backends.i2c_checks import check_address
from hal.errors import (
    BusError,
    Closed,
    DeviceNotFound,
    Disconnected,
    ErrorKind,
    HalError,
    HalTimeout,
    I2cNack,
    ProtocolError,
)
from hal.i2c_carrier import SOCKET
from hal.types import I2cOp, I2cWrite, PortInfo

HEAD = struct.Struct("<BBq")
SEGMENT = struct.Struct("<BH")
REPLY = struct.Struct("<BH")


class UnixI2c:
    """Makes transfers on one emulated bus. ``timeout_s`` bounds one transfer.

    A transfer without an answer raises ``HalTimeout``, a server that is gone raises ``Disconnected``. Both close the
    connection, because half an answer may still be under way: the next transfer connects again.
    """

    CARRIER = SOCKET

    def __init__(self, path: str, speed_hz: int = 400_000, timeout_s: float = 0.5) -> None:
        self._path = path
        self._speed_hz = speed_hz
        self._timeout_s = timeout_s
        self._reply = memoryview(bytearray(1 << 16))
        self._open = True
        self._socket: socket.socket | None = None
        try:
            self._connect()
        except OSError as error:
            raise DeviceNotFound(f"nobody serves this socket: {error}", device=path) from error

    def _connect(self) -> socket.socket:
        if self._socket is None:
            made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                # the kernel's own timeouts: Python's would cost two more system calls per transfer
                limit = struct.pack("@ll", int(self._timeout_s), round(self._timeout_s % 1 * 1e6))
                made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
                made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
                made.connect(self._path)
            except OSError:
                made.close()
                raise
            self._socket = made
        return self._socket

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        check_address(address, self._path)
        if not self._open:
            raise Closed("the bus is closed", device=self._path)
        parts = [HEAD.pack(address, len(ops), time.monotonic_ns())]
        for op in ops:
            if isinstance(op, I2cWrite):
                parts.append(SEGMENT.pack(0, len(op.data)))
                parts.append(op.data)
            else:
                parts.append(SEGMENT.pack(1, op.n))
        try:
            connection = self._connect()
            connection.sendall(b"".join(parts))
            n = self._receive_at_least(connection, REPLY.size, 0)
            status, length = REPLY.unpack_from(self._reply)
            n = self._receive_at_least(connection, REPLY.size + length, n)
        except OSError as error:
            raise self._spoilt(error) from error
        if n != REPLY.size + length:
            self._disconnect()
            raise ProtocolError(f"{n} bytes in a reply of {REPLY.size + length}", device=self._path)
        if status:
            raise _error(status, address, self._path)
        wanted = sum(op.n for op in ops if not isinstance(op, I2cWrite))
        if length != wanted:
            self._disconnect()  # it answers another request, and so would the next one
            raise ProtocolError(f"{length} bytes were read where {wanted} were asked for", device=self._path)
        return self._reply[REPLY.size : n].tobytes()

    def _spoilt(self, error: OSError) -> HalError:
        self._disconnect()
        if error.errno == errno.EAGAIN:
            return HalTimeout(f"the emulated bus gave no answer within {self._timeout_s} s", device=self._path)
        return Disconnected(f"the emulated bus has gone: {error}", device=self._path)

    def for_thread(self) -> UnixI2c:
        """See ``I2cCarrier``: a connection of its own, since requests and replies of one take turns."""
        return UnixI2c(self._path, self._speed_hz, self._timeout_s)

    def fileno(self) -> int:
        """Return the descriptor of the connection, -1 if there is none."""
        try:
            return self._connect().fileno()
        except OSError:
            return -1

    def failure(self, code: int, address: int) -> HalError:
        """See ``I2cCarrier``."""
        return _error(code, address, self._path) if code > 0 else self._spoilt(OSError(-code, os.strerror(-code)))

    def _receive_at_least(self, connection: socket.socket, wanted: int, have: int) -> int:
        while have < wanted:
            n = connection.recv_into(self._reply[have:])
            if n == 0:
                raise ConnectionResetError("connection closed")
            have += n
        return have

    def info(self) -> PortInfo:
        return PortInfo(
            uri=f"unix-i2c://{self._path}",
            description="I2C bus of the emulated world",
            emulated=True,
            details={"speed_hz": str(self._speed_hz)},
        )

    def close(self) -> None:
        self._open = False
        self._disconnect()


def _error(status: int, address: int, device: str) -> BusError:
    if status == 1:
        return I2cNack(f"nobody answers at address 0x{address:02X}", device=device)
    if status == 2:
        return I2cNack(f"device 0x{address:02X} refused a data byte", kind=ErrorKind.NACK_DATA, device=device)
    return BusError(f"bus error in a transfer with 0x{address:02X}", device=device)
