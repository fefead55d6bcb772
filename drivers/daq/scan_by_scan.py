"""Implements blocks, gaps and times for a DAQ that sends its scans one by one with a sequence number."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from hal.arrays import Int16Array
from hal.contracts import Clock, SerialPort
from hal.scan_time import ScanTimeline
from hal.types import ScanBlock, ScanConfig, ScanInfo, Status, TimeSource


class ScanByScan(ABC):
    """Implements ``AnalogInputScan`` for such a DAQ on a serial port. Its driver defines the bytes in both directions.

    ``modulo``: the sequence number that follows the last one is 0.
    """

    modulo = 1 << 16

    def __init__(self, port: SerialPort, clock: Clock, name: str) -> None:
        self.name = name
        self._port, self._clock = port, clock
        self._room, self._text = bytearray(4096), b""
        self._config = ScanConfig(1.0, (), ())
        self._dt_ns, self._next = 1_000_000_000, 0
        self._timeline = ScanTimeline(1e9)
        self._kept: tuple[int, Sequence[int]] | None = None

    @abstractmethod
    def begin(self, config: ScanConfig) -> None:
        """Tell the device to scan; the first scan has sequence number 0."""

    @abstractmethod
    def next_scan(self, timeout_s: float) -> tuple[int, Sequence[int]] | None:
        """Return sequence number and counts of the next scan, or ``None`` after ``timeout_s``."""

    @abstractmethod
    def stop(self) -> None: ...

    def line(self, timeout_s: float) -> bytes | None:
        """Return the next line without its end, or ``None`` after ``timeout_s``; a partial line stays buffered."""
        limit_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while b"\n" not in self._text:
            left_s = max(0.0, (limit_ns - self._clock.now_ns()) * 1e-9)
            n = self._port.read_into(memoryview(self._room), left_s)
            if n == 0:
                return None
            self._text += self._room[:n]
        line, _, self._text = self._text.partition(b"\n")
        return line.rstrip(b"\r")

    def forget_input(self) -> None:
        """Discard the input that has arrived and is not read yet."""
        self._port.drain_input()
        self._text = b""

    def configure(self, config: ScanConfig) -> ScanInfo:
        self._config = config
        lsb_V = tuple(range_V / 32768.0 for range_V in config.range_V)
        return ScanInfo(config.rate_hz, config.channels, config.range_V, lsb_V, 1, simultaneous=False)

    def start(self) -> None:
        self._dt_ns = round(1e9 / self._config.rate_hz)
        self._timeline, self._next, self._kept = ScanTimeline(self._dt_ns), 0, None
        self._timeline.warm_up()
        self.begin(self._config)

    def read_scans(self, out: Int16Array, timeout_s: float) -> ScanBlock:
        n = lost = 0
        while n < len(out):
            scan, self._kept = self._kept or self.next_scan(0.0 if n else timeout_s), None
            if scan is None:
                break
            gap = (scan[0] - self._next) % self.modulo
            if gap and n:  # a block has no gap: the rest comes with the next one
                self._kept = scan
                break
            out[n] = scan[1]
            n, lost, self._next = n + 1, lost + gap, scan[0] + 1
        now_ns = self._clock.now_ns()
        if n == 0:
            return ScanBlock(0, now_ns, 0, self._timeline.next_seq, TimeSource.DEVICE_CLOCK)
        t0_ns, seq0, _ = self._timeline.stamp(lost + n, now_ns)
        first_ns, status = t0_ns + lost * self._dt_ns, Status.GAP if lost else Status.OK
        return ScanBlock(n, first_ns, self._dt_ns, seq0 + lost, TimeSource.DEVICE_CLOCK, status, lost)

    def close(self) -> None:
        self.stop()
        self._port.close()
