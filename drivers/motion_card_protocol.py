"""Decodes the motion card's text line, its 15-byte packet and its button, from bytes and times, without port or clock.

Source: Erat 2018, sections 4.2.1, 4.2.2, 6.2, 6.3, with erratum 112 (packet: big-endian int16
a_x a_y a_z w_x w_y w_z T, then status), 113 (the text says not whether its numbers are counts or scaled: both are
read) and 121 (a press of exactly 0.5 s is long). Neither format has a checksum: a changed digit cannot be seen.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from hal.types import STANDARD_GRAVITY

Fields = Literal["raw", "scaled"]

INACTIVE, ROTATE, ZOOM = 0, 1, 2  # card status, section 6.2
LONG_PRESS_NS = 500_000_000
SPIKE_NS = 20_000_000  # section 6.3: from the release on
PACKET = struct.Struct(">7hB")
START, END = b"#:", b"\r\n"
LINE_BYTES = 55  # at most, with counts: '#:', seven times '-32768:', '2:', line end
LONGEST_LINE = 128  # scaled fields need more
_NUMBER = re.compile(rb"-?\d{1,5}(\.\d{1,8})?")

IMU_CHARACTERISTIC = "bf470002-767b-467d-a4c0-e8e050c0d96e"
BATTERY_CHARACTERISTIC = "00002a19-0000-1000-8000-00805f9b34fb"  # 0x2A19 of service 0x180F


@dataclass(frozen=True, slots=True)
class CardReading:
    """Holds one message: accelerometer and gyro x, y, z and temperature as sent (counts, or g, deg/s, degC), status."""

    values: tuple[float, float, float, float, float, float, float]
    status: int


def decode_packet(packet: bytes) -> CardReading:
    """Decode a notification of the IMU characteristic. Raises ``ValueError`` for another length or status."""
    if len(packet) != PACKET.size:
        raise ValueError(f"packet has {len(packet)} bytes instead of {PACKET.size}")
    *counts, status = PACKET.unpack(packet)
    if status > ZOOM:
        raise ValueError(f"card status {status} is not 0, 1 or 2")
    ax, ay, az, wx, wy, wz, t = counts
    return CardReading((ax, ay, az, wx, wy, wz, t), status)


def decode_battery(value: bytes) -> int:
    """Return the battery level (characteristic 0x2A19) in percent. Raises ``ValueError`` for any other content."""
    if len(value) != 1 or value[0] > 100:
        raise ValueError(f"battery level {value.hex()!r} is not one byte of 0 .. 100")
    return value[0]


def line_bytes(fields: Fields) -> int:
    """Return the bytes of the longest line that a card sends, for the load of its serial line."""
    return LINE_BYTES if fields == "raw" else LONGEST_LINE


def decode_line(line: bytes, fields: Fields) -> CardReading:
    """Decode one line without its ``\\r\\n``: ``#:`` and eight numbers, each followed by ``:``. Else ``ValueError``."""
    parts = line.split(b":")
    if len(parts) != 10 or parts[0] != b"#" or parts[9] != b"":
        raise ValueError("not '#:' and eight fields")
    values: list[float] = []
    for part in parts[1:8]:
        match = _NUMBER.fullmatch(part)
        if match is None or (fields == "raw" and match.group(1)):
            raise ValueError(f"field {part!r} is no number of form {fields}")
        values.append(float(part))
    if fields == "raw" and not all(-32768 <= v <= 32767 for v in values):
        raise ValueError("counts beyond 16 bit")
    if parts[8] not in (b"0", b"1", b"2"):
        raise ValueError(f"card status {parts[8]!r} is not 0, 1 or 2")
    ax, ay, az, wx, wy, wz, t = values
    return CardReading((ax, ay, az, wx, wy, wz, t), int(parts[8]))


class LineParser:
    """Finds the lines in a byte stream. ``bad_frames`` counts lines that were none, after the first good end.

    A disturbance costs the line it hits; if it hits a line's end, that line and, at most, no other: the next
    ``#:`` begins anew. Where the stream begins in the middle of a line, that rest is no bad frame.
    """

    def __init__(self, fields: Fields = "raw") -> None:
        self.frames = 0
        self.bad_frames = 0
        self.discarded_bytes = 0
        self._fields: Fields = fields
        self._buffer = bytearray()
        self._synchronised = False

    def feed(self, data: bytes | bytearray | memoryview) -> list[CardReading]:
        """Return all readings that ``data`` completes, oldest first."""
        self._buffer += data
        readings: list[CardReading] = []
        while (end := self._buffer.find(END)) >= 0:
            line = bytes(self._buffer[:end])
            del self._buffer[: end + len(END)]
            self._take(line, readings)
        if len(self._buffer) > LONGEST_LINE:
            self._drop_too_long()
        return readings

    def reset(self) -> None:
        """Forget what has arrived, keep the counts: after a reconnection."""
        self._buffer.clear()
        self._synchronised = False

    def _take(self, line: bytes, readings: list[CardReading]) -> None:
        start = line.rfind(START)
        if start > 0:
            # the end of the line before was lost, or something came in between
            self._bad(start)
            line = line[start:]
        try:
            readings.append(decode_line(line, self._fields))
            self.frames += 1
        except ValueError:
            self._bad(len(line))
        self._synchronised = True

    def _drop_too_long(self) -> None:
        start = self._buffer.rfind(START)
        keep = len(self._buffer) - start if start > 0 else 1 if self._buffer.endswith(b"#") else 0
        if keep > LONGEST_LINE:
            keep = 0
        self._bad(len(self._buffer) - keep)
        del self._buffer[: len(self._buffer) - keep]

    def _bad(self, n: int) -> None:
        self.discarded_bytes += n
        self.bad_frames += self._synchronised


class ActivationButton:
    """Derives the card's status from its switch (section 6.2).

    A short press changes status 0 to 1, and 1 or 2 to 0. A long press, of 0.5 s or more, changes any status to 2 at
    the moment when the 0.5 s are over, not at the release. ``presses`` counts both kinds.
    """

    def __init__(self) -> None:
        self.status = INACTIVE
        self.presses = 0
        self._since_ns: int | None = None
        self._long = False

    def update(self, pressed: bool, t_ns: int) -> int:
        """Process the state of the switch at ``t_ns``, and return the status."""
        if self._since_ns is None:
            if pressed:
                self._since_ns = t_ns
                self._long = False
                self.presses += 1
            return self.status
        if not self._long and t_ns - self._since_ns >= LONG_PRESS_NS:
            self._long = True
            self.status = ZOOM
        if not pressed:
            if not self._long:
                self.status = ROTATE if self.status == INACTIVE else INACTIVE
            self._since_ns = None
        return self.status


class SpikeFilter:
    """Rejects the mechanical spike of a click (section 6.3): no sample is used while the button is pressed, nor for
    20 ms after its release. ``held`` counts the samples that were not used."""

    def __init__(self, hold_ns: int = SPIKE_NS) -> None:
        self.held = 0
        self._hold_ns = hold_ns
        self._until_ns: int | None = None

    def admit(self, pressed: bool, t_ns: int) -> bool:
        """Return True if a sample of ``t_ns`` may be used."""
        if pressed:
            self._until_ns = t_ns + self._hold_ns
        good = not pressed and (self._until_ns is None or t_ns >= self._until_ns)
        self.held += not good
        return good


def to_si(fields: Fields, accel_lsb_mps2: float, gyro_lsb_rad_s: float) -> Callable[[CardReading], list[float]]:
    """Convert readings to m/s^2 (3), rad/s (3), degC from counts of the MPU-6050 (T/340 + 36.53) or g, deg/s, degC."""
    if fields == "raw":
        accel, gyro, slope, zero = accel_lsb_mps2, gyro_lsb_rad_s, 1.0 / 340.0, 36.53
    else:
        accel, gyro, slope, zero = STANDARD_GRAVITY, math.pi / 180.0, 1.0, 0.0
    factors = (accel, accel, accel, gyro, gyro, gyro, slope)

    def convert(reading: CardReading) -> list[float]:
        values = [v * f for v, f in zip(reading.values, factors, strict=True)]
        values[6] += zero
        return values

    return convert
