"""Defines the errors of the hardware layer: a portable kind for code, a message and a cause for people.

Every message says what happened, where, and what to do. Sources: embedded-hal ``ErrorKind`` (portable
kinds), nidaqmx (partial progress), ophyd-async (one tree of all failed connections).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum


class ErrorKind(Enum):
    """Names the kind of an error, independent of device and backend."""

    CONFIG = "config"
    NOT_FOUND = "not found"
    NACK_ADDRESS = "address not acknowledged"
    NACK_DATA = "data not acknowledged"
    ARBITRATION = "arbitration lost"
    BUS = "bus error"
    CRC = "checksum"
    FRAMING = "framing"
    TIMEOUT = "timeout"
    OVERRUN = "overrun"
    DISCONNECTED = "disconnected"
    IDENTITY = "wrong device"
    PROTOCOL = "protocol"
    SAFETY = "safety"
    CLOSED = "closed"


class HalError(Exception):
    """Is the base class of all hardware errors.

    ``device`` names the bench entry (``"daq"``, ``"i2c0"``), ``partial`` says how far a transfer got and
    ``lost`` how many samples are gone; the original exception is ``__cause__``.
    """

    default_kind = ErrorKind.BUS

    def __init_subclass__(cls, *, kind: ErrorKind | None = None) -> None:
        super().__init_subclass__()
        cls.default_kind = kind or cls.default_kind

    def __init__(
        self,
        message: str,
        *,
        kind: ErrorKind | None = None,
        device: str = "",
        partial: int = 0,
        lost: int = 0,
    ) -> None:
        super().__init__(f"{device}: {message}" if device else message)
        self.kind = kind or self.default_kind
        self.device = device
        self.partial = partial
        self.lost = lost


def name_device(error: HalError, name: str) -> HalError:
    """Put the bench's ``name`` of a device in front of the message, for a port that knows only its path. In place."""
    if not str(error).startswith(name):
        error.args = (f"{name}: {error}",)
    return error


class BenchError(HalError, kind=ErrorKind.CONFIG):
    """The bench description or a configuration is wrong (exit status 2)."""


class DeviceNotFound(HalError, kind=ErrorKind.NOT_FOUND):
    """A declared device or port is not there (exit status 4)."""


class BusError(HalError):
    """A transfer failed on the wire."""


class I2cNack(BusError, kind=ErrorKind.NACK_ADDRESS):
    """Is raised when no device acknowledges the address, or the device refuses a data byte."""


class HalTimeout(HalError, kind=ErrorKind.TIMEOUT):
    """A bounded wait ended without an answer."""


class Overrun(HalError, kind=ErrorKind.OVERRUN):
    """Is raised when a buffer overflowed. ``lost`` is the number of lost samples, as far as it is known."""


class Disconnected(HalError, kind=ErrorKind.DISCONNECTED):
    """Is raised when the port or its peer is gone."""


class ProtocolError(HalError, kind=ErrorKind.PROTOCOL):
    """The device answered something its manual does not allow."""


class WrongDevice(HalError, kind=ErrorKind.IDENTITY):
    """The identity check failed."""


class SafetyTrip(HalError, kind=ErrorKind.SAFETY):
    """An output was refused or driven to its safe state."""


class LeaseLost(SafetyTrip):
    """A command came too late: a guardian has the outputs, or will have them."""


class Closed(HalError, kind=ErrorKind.CLOSED):
    """Used after ``close()``."""


class OpenFailed(HalError, kind=ErrorKind.NOT_FOUND):
    """Several devices failed to open: one tree, every cause."""

    def __init__(self, errors: Sequence[HalError]) -> None:
        lines = "\n".join(f"  - {e}" for e in errors)
        super().__init__(f"{len(errors)} part(s) of the bench did not open:\n{lines}")
        self.errors = tuple(errors)
