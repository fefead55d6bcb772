"""Drives a DATAQ DI-4108 in CDC mode: 8 analog inputs of 16 bit, scanned by the device's own clock.

Source: DATAQ "Data Acquisition Instrument Command Protocol", 1 Aug 2019 (sections info, slist, srate, dec,
filter, ps, start, stop, "Binary stream output formats", "Internal FIFO overflow").

The binary stream has no sync word: a scan is where the count from ``start`` says it is. Packets are sent whole,
so a read that ends inside a packet again and again means lost bytes, and is an error rather than a shift of
all channels by one byte. Not so while a backlog comes in, which is faster than the device scans: one read of a tty
gives at most 4095 bytes, and what refills it stops anywhere. Nor are the pieces of one packet lost bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers.options import Di4108Options
from drivers.registry import Driver, Site
from hal.arrays import Int16Array
from hal.contracts import Clock, SerialPort
from hal.errors import (
    BenchError,
    ErrorKind,
    HalTimeout,
    Overrun,
    ProtocolError,
    WrongDevice,
)
from hal.scan_time import ScanTimeline
from hal.types import ChannelInfo, ScanBlock, ScanConfig, ScanInfo, Status, TimeSource

MODEL = "4108"
CLOCK_HZ = 60_000_000  # sample-rate dividend; rate per channel = CLOCK_HZ / (srate * dec)
RANGE_CODES = {10.0: 0, 5.0: 1, 2.0: 2, 1.0: 3, 0.5: 4, 0.2: 5}
SRATE_MIN, SRATE_MAX, DEC_MAX = 375, 65535, 512
FIFO_SAMPLES = 1024
PACKET_S = 125e-6
"""Shortest time between two packets that is asked for: a microframe of high-speed USB."""
BUFFER_BYTES = 1 << 18  # the device's FIFO and all that a kernel keeps of a serial line


def scan_rate(rate_hz: float) -> tuple[int, int, float]:
    """Return ``(srate, dec, real rate in Hz)`` nearest to the wanted rate, with the smallest ``dec``: 1 means no
    filter."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise BenchError(f"rate_hz = {rate_hz} is not a positive number")
    best: tuple[float, int, int] | None = None
    for dec in range(1, DEC_MAX + 1):
        srate = round(CLOCK_HZ / rate_hz / dec)
        if not SRATE_MIN <= srate <= SRATE_MAX:
            continue
        miss = abs(CLOCK_HZ / (srate * dec) - rate_hz)
        if best is None or miss < best[0] - 1e-9:
            best = (miss, srate, dec)
    if best is None:
        low, high = CLOCK_HZ / (SRATE_MAX * DEC_MAX), CLOCK_HZ / SRATE_MIN
        raise BenchError(f"rate_hz = {rate_hz} is outside {low:.3g} .. {high:.6g} Hz of the DI-4108")
    _, srate, dec = best
    return srate, dec, CLOCK_HZ / (srate * dec)


def packet_code(rate_hz: float, width: int) -> int:
    """Return the ``ps`` argument: the largest packet (16 << n bytes) that still fills within a scan of ``width``
    channels, so that each scan can have a tick of its own, or within ``PACKET_S`` if scans are faster."""
    nbytes = 2 * width * max(1.0, rate_hz * PACKET_S)
    return max(0, min(7, int(math.log2(max(nbytes, 16.0) / 16.0))))


class Di4108:
    """Implements ``AnalogInputScan``, and two switch outputs, on a serial port.

    ``configure`` -> ``start`` -> ``read_scans`` ... -> ``stop``. One command is under way at a time and every
    echo is verified within ``answer_timeout_s``.
    """

    def __init__(self, port: SerialPort, clock: Clock, *, name: str = "daq", answer_timeout_s: float = 0.5) -> None:
        self.name = name
        self.firmware = ""
        self.serial_number = ""
        self.scans = 0
        self.lost = 0
        self.port = port
        self._clock = clock
        self._answer_timeout_s = answer_timeout_s
        self._info: ScanInfo | None = None
        self._scanning = False
        self._digital_bits = 0
        self._buf = bytearray(BUFFER_BYTES)
        self._view = memoryview(self._buf)
        self._bytes = np.frombuffer(self._buf, dtype=np.uint8)
        self._width = 0
        self.dt_ns = 0
        # made by configure: kernels pull in numba, which a command that never scans does not pay
        self._kernels: Any = None
        self._stream: Any = None
        self._timeline = ScanTimeline(1e6)

    # identity and configuration

    def probe(self) -> str:
        """Stop a scan, and return the identity: "DI-4108 firmware 1.01 serial ...".

        Raises ``WrongDevice`` for another model and ``HalTimeout`` without an answer.
        """
        self.stop()
        model = self._ask("info 1")
        if model != MODEL:
            raise WrongDevice(f"expected a DATAQ DI-{MODEL}, found model {model!r}", device=self.name)
        version = self._ask("info 2")
        try:
            self.firmware = f"{int(version, 16) / 100:.2f}"  # 65 is hexadecimal 101, version 1.01
        except ValueError:
            raise ProtocolError(f"firmware version {version!r} is not hexadecimal", device=self.name) from None
        self.serial_number = self._ask("info 6")[:8]
        return f"DI-{MODEL} firmware {self.firmware} serial {self.serial_number}"

    def configure(self, config: ScanConfig) -> ScanInfo:
        """Set scan list, ranges, rate and packet size. Raises ``BenchError`` if the device cannot do that."""
        channels = config.channels
        if not channels or len(set(channels)) != len(channels) or not all(0 <= c <= 7 for c in channels):
            raise BenchError(
                f"channels {list(channels)}: 1 to 8 different numbers of 0..7 are needed", device=self.name
            )
        if len(config.range_V) != len(channels):
            raise BenchError(f"{len(config.range_V)} ranges for {len(channels)} channels", device=self.name)
        for range_V in config.range_V:
            if range_V not in RANGE_CODES:
                raise BenchError(f"range_V = {range_V} is not one of {sorted(RANGE_CODES)}", device=self.name)
        srate, dec, rate_hz = scan_rate(config.rate_hz)
        self.stop()
        width = len(channels)
        code = packet_code(rate_hz, width)
        self._command("encode 0")
        self._command(f"ps {code}")
        for i, (channel, range_V) in enumerate(zip(channels, config.range_V, strict=True)):
            self._command(f"slist {i} {RANGE_CODES[range_V] << 8 | channel}")
        for channel in channels:
            # last point: its delay is known to be none, that of the averaging filter is not documented
            self._command(f"filter {channel} 0")
        self._command(f"dec {dec}")
        self._command(f"srate {srate}")
        self._command("endo 3")
        self._command(f"dout {self._digital_bits}")
        self._width = width
        self.dt_ns = round(1e9 / rate_hz)
        self._load_kernels(width, 16 << code, rate_hz)
        self._info = ScanInfo(
            rate_hz=rate_hz,
            channels=tuple(channels),
            range_V=tuple(config.range_V),
            lsb_V=tuple(range_V / 32768.0 for range_V in config.range_V),
            buffer_scans=FIFO_SAMPLES // width,
            simultaneous=False,
        )
        return self._info

    def _load_kernels(self, width: int, packet_bytes: int, rate_hz: float) -> None:
        """Compile or load the kernels and create their state, so that no read waits for that."""
        from drivers.daq import di4108_kernels

        self._kernels = di4108_kernels
        di4108_kernels.warm_up()
        self._stream = di4108_kernels.new_stream(width, packet_bytes, rate_hz)
        self._timeline = ScanTimeline(1e9 / rate_hz, state=self._stream["timeline"][0])

    def channels(self) -> Sequence[ChannelInfo]:
        """Return one voltage channel per configured input, in scan order."""
        info = self._require_info()
        return [
            ChannelInfo(f"ai{c}", "V", -r, r, lsb)
            for c, r, lsb in zip(info.channels, info.range_V, info.lsb_V, strict=True)
        ]

    # scanning

    def start(self) -> None:
        """Begin to scan; scan 0 is the first one after this."""
        self._require_info()
        self.port.drain_input()
        self._kernels.restart(self._stream)
        self._timeline.restart()
        self.port.write(b"start 0\r", self._answer_timeout_s)
        self._scanning = True

    def read_scans(self, out: Int16Array, timeout_s: float) -> ScanBlock:
        """See ``AnalogInputScan.read_scans``. ``seq0`` counts device scans from ``start``, lost ones included.

        Raises ``Overrun`` if the device reported a FIFO overflow and ``ProtocolError`` (framing) if bytes are missing.
        Both end the scan, and ``start`` begins a new one.
        """
        if out.shape[1] != self._width:
            raise BenchError(f"room for {out.shape[1]} channels, {self._width} are scanned", device=self.name)
        kernels, stream = self._kernels, self._stream
        self._receive(0.0 if kernels.scans_ready(stream) else timeout_s)
        return self.block_of(*kernels.decode(stream, self._bytes, out))

    def block_of(self, n: int, t0_ns: int, seq0: int, lost: int, shifted: bool) -> ScanBlock:
        """Return the results of ``decode`` as ``read_scans`` does; a compiled loop hands scans over by it."""
        stream = self._stream
        if n == 0:
            if stream["overflowed"][0]:
                self._raise_overrun()
            return ScanBlock(0, int(stream["arrival_ns"][0]), 0, self._timeline.next_seq, TimeSource.DEVICE_CLOCK)
        self.scans += n
        self.lost += lost
        status = Status.GAP if lost else Status.OK
        if shifted:
            status |= Status.SHIFTED
        return ScanBlock(n, t0_ns, self.dt_ns, seq0, TimeSource.DEVICE_CLOCK, status, lost)

    def _receive(self, timeout_s: float) -> None:
        """Read until at least one whole scan can be trusted, the time is up or the device has stopped."""
        kernels, stream = self._kernels, self._stream
        now_ns = self._clock.now_ns()
        limit_ns = now_ns + round(timeout_s * 1e9)
        verdict = kernels.OVERFLOWED if stream["overflowed"][0] else kernels.WAIT
        while verdict == kernels.WAIT:
            end = int(stream["end"][0])
            if end == BUFFER_BYTES:
                self._raise_backlog()
            n = self.port.read_into(self._view[end:], timeout_s)
            if n == 0:
                return
            now_ns = self._clock.now_ns()
            verdict = kernels.accept(stream, self._bytes, n, now_ns)
            timeout_s = max(0.0, (limit_ns - now_ns) * 1e-9)
        self.obey(verdict)

    def obey(self, verdict: int) -> None:
        """Handle the ``verdict`` of ``accept``. Raises ``ProtocolError`` if bytes are missing."""
        kernels, stream = self._kernels, self._stream
        if verdict == kernels.OVERFLOWED:
            self._scanning = False
        elif verdict == kernels.MISALIGNED:
            raise ProtocolError(
                f"{stream['misaligned'][0]} reads in a row ended inside a packet of {stream['packet_bytes'][0]} bytes: "
                "bytes were lost and channels cannot be told apart; start the scan again",
                kind=ErrorKind.FRAMING,
                device=self.name,
            )

    @property
    def memory(self) -> tuple[Any, Any]:
        """Return the stream's record and the buffer of bytes that its kernels work on; a compiled loop uses both."""
        return self._stream, self._bytes

    def _raise_backlog(self) -> None:
        lost = self._timeline.due_by(self._clock.now_ns())
        raise Overrun(
            f"a backlog of more than {BUFFER_BYTES // 1024} kB: the host stood still, and its {lost} scans are given "
            "up; start the scan again",
            device=self.name,
            lost=lost,
        )

    def _raise_overrun(self) -> None:
        lost = self._timeline.due_by(self._clock.now_ns())
        raise Overrun(
            f"the device stopped itself: its FIFO of {FIFO_SAMPLES} samples overflowed because the host did not "
            f"read for {FIFO_SAMPLES // max(1, self._width)} scans; at least {lost} scans lost",
            device=self.name,
            lost=lost,
        )

    def stop(self) -> None:
        """End the scan and discard what is still arriving, within a time limit. May be called without a scan."""
        self.port.write(b"stop\r", self._answer_timeout_s)
        limit_ns = self._clock.now_ns() + round(self._answer_timeout_s * 1e9)
        tail = b""
        chunk = self._view[-4096:]
        while not tail.endswith(b"stop\r"):
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            n = self.port.read_into(chunk, left_s) if left_s > 0 else 0
            if n == 0:
                raise HalTimeout(
                    f"no echo of 'stop' within {self._answer_timeout_s} s: is this a DI-{MODEL} in CDC mode, "
                    "and switched on?",
                    device=self.name,
                )
            tail = (tail + bytes(chunk[:n]))[-64:].rstrip(b"\x00\n")
        self._scanning = False
        self.port.drain_input()

    def close(self) -> None:
        """Stop if scanning, then close the port. Idempotent."""
        try:
            if self._scanning:
                self.stop()
        finally:
            self._scanning = False
            self.port.close()

    # switch outputs

    def write_digital(self, bits: int) -> None:
        """Set switch outputs 0 and 1 (bit 0 and 1). During a scan the device does not echo, so this does not wait."""
        if not 0 <= bits <= 3:
            raise BenchError(f"digital outputs {bits:#x}: only bits 0 and 1 are outputs", device=self.name)
        self._digital_bits = bits
        if self._scanning:
            self.port.write(f"dout {bits}\r".encode(), self._answer_timeout_s)
        else:
            self._command(f"dout {bits}")

    # command and echo

    def _require_info(self) -> ScanInfo:
        if self._info is None:
            raise BenchError("configure() comes first", device=self.name)
        return self._info

    def _command(self, text: str) -> None:
        answer = self._exchange(text)
        if answer != text:
            raise ProtocolError(f"sent {text!r}, echo was {answer!r}", device=self.name)

    def _ask(self, text: str) -> str:
        answer = self._exchange(text)
        if not answer.startswith(text + " "):
            raise ProtocolError(f"sent {text!r}, answer was {answer!r}", device=self.name)
        return answer[len(text) + 1 :].strip()

    def _exchange(self, text: str) -> str:
        self.port.write(text.encode() + b"\r", self._answer_timeout_s)
        limit_ns = self._clock.now_ns() + round(self._answer_timeout_s * 1e9)
        line = b""
        while not line.endswith(b"\r"):
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            n = self.port.read_into(self._view[:256], left_s) if left_s > 0 else 0
            if n == 0:
                raise HalTimeout(
                    f"no answer to {text!r} within {self._answer_timeout_s} s, got {line!r}",
                    device=self.name,
                    partial=len(line),
                )
            line += bytes(self._view[:n])
        return _clean(line)


def _clean(line: bytes) -> str:
    """Return the text of an echo without LF and NULs, which the manual allows between echoes."""
    return line.replace(b"\x00", b"").replace(b"\n", b"").decode("latin-1").strip("\r")


def _open(site: Site) -> Di4108:
    return Di4108(site.bench.serial(site.spec.bus or ""), site.bench.clock, name=site.name)


DRIVER = Driver(Di4108Options, _open, "daq", bits_per_s=lambda options: 0.0, has_kernels=True)
"""It streams over USB, whose capacity is far beyond its scans."""
