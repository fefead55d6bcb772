"""A serial CAN adapter (slcan) as a byte face: frames of a ``CanHub`` as ASCII on a pty.

Source: LAWICEL CANUSB manual, "CANUSB ASCII commands". Commands end with CR; CR alone means done, BEL (07h) refused;
a sent frame is confirmed by ``z`` or ``Z`` and CR.

Model limits
- Nothing is taken from the bit rate chosen with ``Sn`` (the hub has its own); filters (``M``, ``m``) and time
  stamps (``Z1``) are acknowledged and ignored; the serial line itself takes no time.
- Remote frames are confirmed and go nowhere; the nodes send base frames only.
- Frames that arrive when 256 kB are waiting for the host are dropped and show in bit 0 of ``F``.
"""

from __future__ import annotations

from sim_devices.transports.can_hub import EXTENDED, CanHub

OK, REFUSED = b"\r", b"\x07"
MAX_WAITING = 256 * 1024
MAX_COMMAND = 32


class SlcanAdapter:
    """Joins the host to ``hub`` through ASCII commands."""

    def __init__(self, hub: CanHub) -> None:
        self.unread = 0
        self.open = False
        self.dropped = 0
        self._hub = hub
        self._listen_only = False
        self._line = bytearray()
        self._out = bytearray()
        hub.host = self._to_host

    def receive(self, data: bytes, t_ns: int) -> None:
        for byte in data:
            if byte == 0x0D:
                line = self._line.decode("latin-1")
                self._line.clear()
                self._out += self._execute(line, t_ns)
            elif len(self._line) < MAX_COMMAND:
                self._line.append(byte)

    def take(self, max_bytes: int) -> bytes:
        data = bytes(self._out[:max_bytes])
        del self._out[:max_bytes]
        return data

    def advance_to(self, t_ns: int) -> None:
        """The hub acts; the adapter only passes on."""

    def next_event_ns(self) -> int | None:
        return None

    def _to_host(self, can_id: int, data: bytes, t_ns: int) -> None:
        if not self.open:
            return
        if len(self._out) > MAX_WAITING:
            self.dropped += 1
            return
        self._out += f"t{can_id:03X}{len(data)}{data.hex().upper()}\r".encode()

    def _execute(self, line: str, t_ns: int) -> bytes:
        name, rest = line[:1], line[1:]
        if name in ("", "S", "s", "M", "m", "Z"):
            return REFUSED if self.open and name in ("S", "s") else OK
        if name in ("O", "L", "C"):
            if name != "C" and self.open:
                return REFUSED
            self.open, self._listen_only = name != "C", name == "L"
            return OK
        if name == "V":
            return b"V1013\r"
        if name == "N":
            return b"NA123\r"
        if name == "F":
            return b"F01\r" if self.dropped else b"F00\r"
        if name in ("t", "T", "r", "R") and self.open and not self._listen_only:
            return self._send(name, rest, t_ns)
        return REFUSED

    def _send(self, name: str, rest: str, t_ns: int) -> bytes:
        digits = 3 if name in ("t", "r") else 8
        try:
            can_id, length = int(rest[:digits], 16), int(rest[digits : digits + 1], 16)
            data = bytes.fromhex(rest[digits + 1 :])
        except ValueError:
            return REFUSED
        if (
            length > 8
            or (name in ("t", "T") and len(data) != length)
            or can_id > (0x7FF if digits == 3 else 0x1FFFFFFF)
        ):
            return REFUSED
        if name in ("t", "T"):
            self._hub.send_from_host(can_id | (EXTENDED if name == "T" else 0), data, t_ns)
        return b"z\r" if digits == 3 else b"Z\r"
