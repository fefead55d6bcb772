"""Writes transcripts: it wraps any port and records every transfer with its time, as a golden file for tests.

Line format (one transfer per line, times in ns since the first line, bytes in hex):

    # transcript serial serial:///dev/ttyACM0
    0 w 73746f700d              serial: written / r read
    81000 x 48 w01 r8583        I2C: address, segments in order; "! reason" at the end when it failed
    90000 t 120 00110022aa      CAN: sent / r received; an extended id has eight digits
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TextIO

from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import BenchError, HalError
from hal.types import CanFrame, CanStats, I2cOp, I2cWrite, PortInfo


@dataclass(frozen=True, slots=True)
class Entry:
    """Holds one line: time since the start, verb (w, r, x, t) and the words after it."""

    t_ns: int
    verb: str
    words: tuple[str, ...]


def read_transcript(lines: Iterable[str]) -> list[Entry]:
    """Parse a transcript. Raises ``BenchError`` naming the line that is not one."""
    entries: list[Entry] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0] == "#":
            continue
        try:
            entries.append(Entry(int(words[0]), words[1], tuple(words[2:])))
        except (ValueError, IndexError):
            raise BenchError(f"transcript line {number} is not 'time verb data': {line.rstrip()!r}") from None
    return entries


class _Log:
    def __init__(self, sink: TextIO, clock: Clock, kind: str, uri: str) -> None:
        self._sink = sink
        self._clock = clock
        self._start_ns: int | None = None
        sink.write(f"# transcript {kind} {uri}\n")

    def __call__(self, text: str) -> None:
        now_ns = self._clock.now_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        self._sink.write(f"{now_ns - self._start_ns} {text}\n")


class _Traced:
    """Passes on what leaves no line."""

    def __init__(self, below: SerialPort | I2cBus | CanBus, clock: Clock, kind: str, sink: TextIO) -> None:
        self._below = below
        self._log = _Log(sink, clock, kind, below.info().uri)

    def info(self) -> PortInfo:
        return self._below.info()

    def close(self) -> None:
        self._below.close()


class TraceSerial(_Traced):
    """SerialPort that writes its transcript to ``sink`` (the caller opens and closes it)."""

    def __init__(self, port: SerialPort, clock: Clock, sink: TextIO) -> None:
        super().__init__(port, clock, "serial", sink)
        self._port = port

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        n = self._port.read_into(buf, timeout_s)
        if n:
            self._log(f"r {buf[:n].hex()}")
        return n

    def write(self, data: bytes, timeout_s: float) -> None:
        self._port.write(data, timeout_s)
        self._log(f"w {data.hex()}")

    def drain_input(self) -> int:
        return self._port.drain_input()


class TraceI2c(_Traced):
    """I2cBus that writes its transcript to ``sink``, failures included."""

    def __init__(self, bus: I2cBus, clock: Clock, sink: TextIO) -> None:
        super().__init__(bus, clock, "i2c", sink)
        self._bus = bus

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        try:
            result = self._bus.transfer(address, ops)
        except HalError as error:
            asked = " ".join(f"w{op.data.hex()}" if isinstance(op, I2cWrite) else f"r{'??' * op.n}" for op in ops)
            self._log(f"x {address:02x} {asked} ! {error.kind.value}")
            raise
        words: list[str] = []
        done = 0
        for op in ops:
            if isinstance(op, I2cWrite):
                words.append(f"w{op.data.hex()}")
            else:
                words.append(f"r{result[done : done + op.n].hex()}")
                done += op.n
        self._log(f"x {address:02x} {' '.join(words)}")
        return result


class TraceCan(_Traced):
    """CanBus that writes its transcript to ``sink``."""

    def __init__(self, bus: CanBus, clock: Clock, sink: TextIO) -> None:
        super().__init__(bus, clock, "can", sink)
        self._bus = bus

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        self._bus.send(frame, timeout_s)
        self._log(f"t {_frame(frame)}")

    def recv(self, timeout_s: float) -> CanFrame | None:
        frame = self._bus.recv(timeout_s)
        if frame is not None:
            self._log(f"r {_frame(frame)}")
        return frame

    def stats(self) -> CanStats:
        return self._bus.stats()


def _frame(frame: CanFrame) -> str:
    return f"{frame.can_id:08x} {frame.data.hex()}" if frame.extended else f"{frame.can_id:03x} {frame.data.hex()}"
