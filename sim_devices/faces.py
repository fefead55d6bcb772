"""Interfaces between an emulated device and the transport that carries it.

A wire face is sans-IO: bytes, register transactions or frames go in and come out, time is an argument, nothing
waits. Times are bench-clock nanoseconds and never run backwards. ``next_event_ns`` says when the device will do
something by itself; the transport calls ``advance_to`` then, not earlier, and if it is late, once for all events.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Volts = NDArray[np.float64]
VoltageSource = Callable[[int], Volts]  # bench time in ns -> one voltage per input, physical truth at that instant


class TimedFace(Protocol):
    """Anything that acts by itself as time passes."""

    def advance_to(self, t_ns: int) -> None: ...
    def next_event_ns(self) -> int | None: ...


class ByteFace(TimedFace, Protocol):
    """Is the wire side of a device behind a serial line."""

    unread: int
    """Bytes that were handed over but that the host has not read yet; the carrier keeps it up to date."""

    def receive(self, data: bytes, t_ns: int) -> None: ...
    def take(self, max_bytes: int) -> bytes: ...


class I2cFace(TimedFace, Protocol):
    """Is the wire side of a device on an I2C bus. Each call happens at the end of the event that it describes.

    A device may also have ``start(t_ns, byte_ns)`` and ``stop()``: the line calls them around each transfer to it.
    """

    def acknowledges(self) -> bool:
        """Answer to its own address."""
        ...

    def write(self, data: bytes, t_ns: int) -> int:
        """A write segment; returns how many bytes were acknowledged."""
        ...

    def read(self, n: int, t_ns: int) -> bytes:
        """A read segment of ``n`` bytes."""
        ...

    def general_call(self, data: bytes, t_ns: int) -> bool:
        """A write segment to address 0; False when the device does not listen there."""
        ...


class CanFace(TimedFace, Protocol):
    """A node on a CAN bus. ``take`` returns the frames it wants to send now, oldest first."""

    def receive(self, can_id: int, data: bytes, t_ns: int) -> None: ...
    def take(self) -> list[tuple[int, bytes]]: ...
