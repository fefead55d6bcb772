"""Decodes the DI-4108's binary stream in compiled kernels, which the driver and a compiled loop share.

``accept`` looks at bytes that have just been read and decides how many of all can be trusted; ``decode`` turns those
into scans. Neither reads a port or a clock. See ``drivers.daq.di4108`` for the rules and their source.
Importing this module imports numba; the driver does so when it configures a scan.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel
from hal.scan_time import ScanTimeline
from hal.scan_time_kernel import shifted_kernel, stamp_kernel
from hal.scan_time_state import TIMELINE

Record = Any

MISALIGNED_LIMIT = 3
"""Largest number of reads in a row that may end inside a packet; a tty may split one packet."""
MISALIGNED_PACKETS = 2.0
"""Time that such reads must have lasted, in packets at the device's rate, before bytes count as lost."""
OVERFLOW_TAIL = (115, 116, 111, 112, 32, 48, 49)
"""The bytes ``stop 01``, with which the device ends its stream after its FIFO has overflowed."""
WAIT, READY, OVERFLOWED, MISALIGNED = 0, 1, 2, 3
"""Verdicts of ``accept``: more bytes are needed; whole scans are there; the device has stopped itself; bytes are
missing, so that channels cannot be told apart."""

STREAM = np.dtype(
    [
        ("scan_bytes", "i8"), ("packet_bytes", "i8"), ("byte_ns", "f8"),
        ("end", "i8"), ("good", "i8"), ("received", "i8"), ("arrival_ns", "i8"), ("late_ns", "f8"),
        ("misaligned", "i8"), ("misaligned_ns", "i8"), ("in_doubt", "i8"), ("overflowed", "i8"),
        ("timeline", TIMELINE, (1,)),
    ]
)  # fmt: skip
"""State of a stream. ``end``: bytes in the buffer; ``good``: how many of these are known to be aligned; ``received``:
bytes since ``start``; ``late_ns``: of the last read, of which only changes mean something; ``misaligned``: reads in a
row that ended inside a packet, the first at ``misaligned_ns``; ``in_doubt``: a backlog's reads end anywhere, and the
first one after it that does not tells."""


def new_stream(width: int, packet_bytes: int, rate_hz: float) -> Record:
    """Return the state (1,) of a stream of ``width`` channels before its first byte."""
    stream = np.zeros(1, STREAM)
    stream["scan_bytes"], stream["packet_bytes"] = 2 * width, packet_bytes
    stream["byte_ns"] = 1e9 / rate_hz / (2 * width)
    ScanTimeline(1e9 / rate_hz, state=stream["timeline"][0])
    return stream


def restart(stream: Record) -> None:
    """Forget the bytes of an earlier scan; the timeline's owner restarts that."""
    for name in ("end", "good", "received", "misaligned", "in_doubt", "overflowed"):
        stream[name] = 0


def scans_ready(stream: Record) -> bool:
    """Return True if ``decode`` finds a scan without more bytes."""
    return bool(stream["good"][0] >= stream["scan_bytes"][0])


@cache
def warm_up() -> None:
    """Compile or load the kernels, once in a process."""
    stream = new_stream(1, 16, 1000.0)
    room = np.zeros(64, np.uint8)
    accept(stream, room, 16, 0)
    decode(stream, room, np.zeros((8, 1), np.int16))


@kernel
def accept(stream: Record, buffer: NDArray[np.uint8], n: int, now_ns: int) -> int:
    """Count ``n`` bytes that were read to ``buffer[end : end + n]`` at ``now_ns``. Return the verdict."""
    s = stream[0]
    s.arrival_ns = now_ns
    s.end += n
    s.received += n
    late_ns = now_ns - s.received * s.byte_ns
    catching_up = late_ns < s.late_ns - s.packet_bytes * s.byte_ns
    s.late_ns = late_ns
    if s.received % s.packet_bytes == 0:
        if catching_up and s.in_doubt != 0:
            return WAIT
        s.misaligned = 0
        s.in_doubt = 0
        s.good = s.end
        return READY if s.good >= s.scan_bytes else WAIT
    if _ends_with_overflow(buffer, s.end):
        s.overflowed = 1
        s.end -= len(OVERFLOW_TAIL)
        s.good = s.end
        return OVERFLOWED
    if catching_up:
        s.in_doubt = 1
        return WAIT
    if s.misaligned == 0:
        s.misaligned_ns = now_ns
    s.misaligned += 1
    lasted = (now_ns - s.misaligned_ns) / (s.packet_bytes * s.byte_ns)
    return MISALIGNED if s.misaligned > MISALIGNED_LIMIT and lasted >= MISALIGNED_PACKETS else WAIT


@kernel
def _ends_with_overflow(buffer: NDArray[np.uint8], end: int) -> bool:
    first = end - len(OVERFLOW_TAIL)
    if first < 0:
        return False
    alike = 0
    for i in range(len(OVERFLOW_TAIL)):
        alike += buffer[first + i] == OVERFLOW_TAIL[i]
    return alike == len(OVERFLOW_TAIL)


@kernel
def decode(stream: Record, buffer: NDArray[np.uint8], rows: NDArray[np.int16]) -> tuple[int, int, int, int, bool]:
    """Move the trusted scans from ``buffer`` to ``rows`` (at most len(rows), scan_bytes / 2).

    Return their number n, the time of the first (ns), its sequence number, the scans lost before it, and whether the
    last arrivals say that the device's clock has stepped; n == 0: nothing was there.
    """
    s = stream[0]
    n = min(s.good // s.scan_bytes, len(rows))
    if n == 0:
        return 0, 0, 0, 0, False
    width = s.scan_bytes // 2
    at = 0
    for k in range(n):
        for i in range(width):
            rows[k, i] = np.int16(buffer[at] | np.int64(buffer[at + 1]) << 8)
            at += 2
    t0_ns, seq0, lost = stamp_kernel(s.timeline, n, s.arrival_ns)
    s.good -= at
    s.end -= at
    for i in range(s.end):
        buffer[i] = buffer[at + i]
    return n, t0_ns, seq0, lost, shifted_kernel(s.timeline)
