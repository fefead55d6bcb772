"""Describes the CAN buses on which a compiled loop can send and receive by itself."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from hal.errors import HalError

SOCKET, PYTHON = range(2)
"""How frames travel: a socket that carries ``struct can_frame``, or functions of Python."""


@runtime_checkable
class CanCarrier(Protocol):
    """A bus on which compiled code can send and receive (``hal.can_kernels``)."""

    CARRIER: int

    def for_thread(self, can_ids: Iterable[int]) -> CanCarrier:
        """Return a connection to the same bus that a thread may use while another one uses this one. It receives
        ``can_ids`` and, if it cannot select, others. Close it as well."""
        ...

    def fileno(self) -> int:
        """Return the non-blocking descriptor, -1 if there is none."""
        ...

    def failure(self, code: int) -> HalError:
        """Return the error for what ``hal.can_kernels.send`` or ``receive`` returned."""
        ...

    def close(self) -> None: ...
