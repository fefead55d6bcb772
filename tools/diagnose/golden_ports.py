"""Ports that play a transcript to a driver, and note when it asks for something else than was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import Disconnected, ErrorKind, I2cNack
from hal.middleware.trace import Entry
from hal.types import CanFrame, CanStats, I2cOp, I2cWrite, PortInfo


@dataclass(frozen=True)
class Divergence:
    """Is raised when the driver does ``found`` at ``entry`` of the transcript of ``bus``, where ``recorded`` was."""

    bus: str
    entry: int
    recorded: str
    found: str


class _Replay:
    def __init__(self, bus: str, entries: list[Entry], clock: Clock, log: list[Divergence]) -> None:
        self.bus, self.entries, self.clock, self.log = bus, entries, clock, log
        self.at = 0
        self._start_ns: int | None = None

    def due_ns(self) -> int:
        """Return the time of the next entry on our clock. The first entry is now."""
        if self._start_ns is None:
            self._start_ns = self.clock.now_ns()
        return self._start_ns + self.entries[self.at].t_ns

    def next(self) -> Entry | None:
        return self.entries[self.at] if self.at < len(self.entries) else None

    def part(self, observed: str) -> Disconnected:
        """Note the divergence; the error ends the scenario."""
        entry = self.next()
        recorded = f"{entry.verb} {' '.join(entry.words)}" if entry is not None else "the end of the transcript"
        self.log.append(Divergence(self.bus, self.at, recorded, observed))
        return Disconnected(f"{self.bus}: the driver parts from the transcript at entry {self.at}: {observed}")

    def info(self) -> PortInfo:
        return PortInfo(f"transcript://{self.bus}", "transcript", True)

    def close(self) -> None:
        """Nothing to close."""


class ReplaySerial(_Replay):
    """Replays a transcript as a SerialPort."""

    _rest = b""

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        end_ns = self.clock.now_ns() + round(timeout_s * 1e9)
        if not self._rest:
            entry = self.next()
            if entry is None or entry.verb != "r" or self.due_ns() > end_ns:
                self.clock.sleep_until_ns(end_ns)
                return 0
            self.clock.sleep_until_ns(self.due_ns())
            self._rest = bytes.fromhex(entry.words[0])
            self.at += 1
        n = min(len(buf), len(self._rest))
        buf[:n], self._rest = self._rest[:n], self._rest[n:]
        return n

    def write(self, data: bytes, timeout_s: float) -> None:
        while (entry := self.next()) is not None and entry.verb == "r":
            self.at += 1  # it did not wait for all that had come then
        self._rest = b""
        if entry is None or bytes.fromhex(entry.words[0]) != data:
            raise self.part(f"w {data.hex()}")
        self.clock.sleep_until_ns(self.due_ns())
        self.at += 1

    def drain_input(self) -> int:
        dropped, self._rest = len(self._rest), b""
        return dropped


class ReplayI2c(_Replay):
    """Replays a transcript as an I2cBus."""

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        entry = self.next()
        asked = [f"w{op.data.hex()}" if isinstance(op, I2cWrite) else f"r{op.n}" for op in ops]
        words = list(entry.words) if entry is not None else []
        failed = "!" in words
        segments = words[1 : words.index("!")] if failed else words[1:]
        then = [w if w[0] == "w" else f"r{len(w[1:]) // 2}" for w in segments]
        if entry is None or int(words[0], 16) != address or then != asked:
            raise self.part(f"x {address:02x} {' '.join(asked)}")
        self.clock.sleep_until_ns(self.due_ns())
        self.at += 1
        if failed:
            raise I2cNack(f"recorded: {words[-1]}", kind=ErrorKind.NACK_ADDRESS, device=self.bus)
        return b"".join(bytes.fromhex(w[1:]) for w in segments if w[0] == "r")


class ReplayCan(_Replay):
    """Replays a transcript as a CanBus."""

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        sent = f"{frame.can_id:08x}" if frame.extended else f"{frame.can_id:03x}"
        while (entry := self.next()) is not None and entry.verb == "r":
            self.at += 1
        if entry is None or " ".join(entry.words) != f"{sent} {frame.data.hex()}".strip():
            raise self.part(f"t {sent} {frame.data.hex()}")
        self.at += 1

    def recv(self, timeout_s: float) -> CanFrame | None:
        entry, end_ns = self.next(), self.clock.now_ns() + round(timeout_s * 1e9)
        if entry is None or entry.verb != "r" or self.due_ns() > end_ns:
            self.clock.sleep_until_ns(end_ns)
            return None
        self.clock.sleep_until_ns(self.due_ns())
        self.at += 1
        can_id, *data = entry.words
        return CanFrame(int(can_id, 16), bytes.fromhex("".join(data)), len(can_id) > 3, self.clock.now_ns())

    def stats(self) -> CanStats:
        return CanStats()


def replay_port(
    bus: str, kind: str, entries: list[Entry], clock: Clock, log: list[Divergence]
) -> SerialPort | I2cBus | CanBus:
    """A port of ``kind`` that plays ``entries``."""
    if kind == "serial":
        return ReplaySerial(bus, entries, clock, log)
    return ReplayI2c(bus, entries, clock, log) if kind == "i2c" else ReplayCan(bus, entries, clock, log)
