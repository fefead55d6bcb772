"""A TCP port beside the pty of a serial device, which pyserial opens as ``socket://`` or ``rfc2217://``.

While a client is connected, the device speaks to it and not to the pty; commands are taken from both. One client at a
time; a second one is refused. A client that begins with a telnet command (byte 0xFF) within ``SNIFF_S`` speaks RFC
2217, every other one raw bytes. Line settings (speed, parity, modem lines) are accepted and have no effect, as on a USB
CDC device. Model limit: bytes in the kernel's socket buffers do not count as unread, so a device notices later than on
a pty that nobody reads.
"""

from __future__ import annotations

import contextlib
import importlib
import socket
import time
from typing import Any

from hal.errors import BenchError
from sim_devices.faces import ByteFace

SNIFF_S = 0.2
IAC = 0xFF
BUFFER_BYTES = 4096
ADDRESS = "127.0.0.1"


class TcpLine:
    """Puts a TCP port in front of a byte face, between a device and its pty carrier. ``port`` 0 is any free port.

    Raises ``BenchError`` when the port is taken.
    """

    def __init__(self, face: ByteFace, port: int) -> None:
        self._face = face
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((ADDRESS, port))
        except OSError as error:
            self._listener.close()
            raise BenchError(f"TCP port {port} cannot be served ({error.strerror}); choose another one") from error
        self._listener.listen(1)
        self.port = int(self._listener.getsockname()[1])
        self._client: socket.socket | None = None
        self._accepted_s = 0.0
        self._telnet: Any = None
        self._is_raw = False
        self._pending = bytearray()

    # ------------------------------------------------------------------ byte face, for the pty carrier

    @property
    def unread(self) -> int:
        return self._face.unread

    @unread.setter
    def unread(self, count: int) -> None:
        self._face.unread = len(self._pending) if self._client is not None else count

    def receive(self, data: bytes, t_ns: int) -> None:
        self._face.receive(data, t_ns)

    def take(self, max_bytes: int) -> bytes:
        """Return what the pty gets: nothing while a client is connected, which gets it instead."""
        if self._client is None:
            return self._face.take(max_bytes)
        if not (self._is_raw or self._telnet or time.monotonic() - self._accepted_s > SNIFF_S):
            return b""
        data = self._face.take(max(0, BUFFER_BYTES - len(self._pending)))
        self._pending += b"".join(self._telnet.escape(data)) if self._telnet else data
        self._flush()
        return b""

    def advance_to(self, t_ns: int) -> None:
        self._face.advance_to(t_ns)

    def next_event_ns(self) -> int | None:
        return self._face.next_event_ns()

    # ------------------------------------------------------------------ TCP

    def filenos(self) -> list[int]:
        return [self._listener.fileno(), *([] if self._client is None else [self._client.fileno()])]

    def on_readable(self, fileno: int, t_ns: int) -> None:
        """Take what arrived on one of ``filenos``: a client, or bytes for the device."""
        if fileno == self._listener.fileno():
            self._accept()
            return
        assert self._client is not None
        data = b""
        with contextlib.suppress(OSError):
            data = self._client.recv(BUFFER_BYTES)
        if not data:
            self._hang_up()
            return
        if not self._is_raw and self._telnet is None:
            self._begin(data[0] == IAC)
        if self._telnet is not None:
            data = b"".join(self._telnet.filter(data))
        if data:
            self._face.receive(data, t_ns)

    def close(self) -> None:
        """Hang up and end listening. Idempotent."""
        self._hang_up()
        self._listener.close()

    def write(self, data: bytes) -> None:
        """Send an answer of the telnet layer."""
        self._pending += data
        self._flush()

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        if self._client is not None:
            client.close()
            return
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setblocking(False)
        self._client, self._accepted_s = client, time.monotonic()

    def _begin(self, speaks_telnet: bool) -> None:
        self._is_raw = not speaks_telnet
        if speaks_telnet:
            # pyserial has this side, too; hal.backends has its only other import
            rfc2217: Any = importlib.import_module("serial.rfc2217")
            self._telnet = rfc2217.PortManager(LineSettings(self._discard), self)

    def _discard(self) -> None:
        self._pending.clear()
        while self._face.take(BUFFER_BYTES):
            pass

    def _flush(self) -> None:
        if self._client is None or not self._pending:
            return
        try:
            sent = self._client.send(self._pending)
        except BlockingIOError:
            return
        except OSError:
            self._hang_up()
            return
        del self._pending[:sent]

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self._telnet, self._is_raw = None, None, False
        self._pending.clear()


class LineSettings:
    """The port that pyserial's ``rfc2217.PortManager`` sets; settings are kept, modem lines are on."""

    def __init__(self, discard: Any) -> None:
        self.baudrate, self.bytesize, self.parity, self.stopbits = 115_200, 8, "N", 1
        self.xonxoff = self.rtscts = self.break_condition = self.ri = False
        self.dtr = self.rts = self.cts = self.dsr = self.cd = True
        self.reset_input_buffer = discard
        self.reset_output_buffer = lambda: None
