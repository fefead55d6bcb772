"""Describes the ports that a compiled loop reads and writes by their descriptors."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from hal.clock import VirtualClock
from hal.contracts import Clock


@runtime_checkable
class Descriptor(Protocol):
    """Describes a port with a non-blocking file descriptor."""

    def fileno(self) -> int: ...


@runtime_checkable
class Fed(Descriptor, Protocol):
    """Describes a port of virtual time. ``feed`` lets time pass until bytes are there, at most ``timeout_s``, and puts
    them where the descriptor reads them; ``flush`` takes to the device what was written to the descriptor."""

    def feed(self, timeout_s: float) -> None: ...
    def flush(self) -> None: ...


def lacks_descriptor(port: object, clock: Clock) -> str:
    """Return why a compiled loop cannot use ``port``; empty if it can."""
    if isinstance(clock, VirtualClock):
        return "" if isinstance(port, Fed) else "emulated time has no descriptors; add --realtime"
    return "" if isinstance(port, Descriptor) else f"its port ({type(port).__name__}) has no file descriptor"
