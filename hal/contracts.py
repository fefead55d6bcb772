"""Defines the contracts of buses and devices: a driver may assume these and nothing else.

Each bus has one required method (embedded-hal). A timeout bounds one whole call, in seconds; ``0`` polls.
``close()`` is idempotent. No method prints or retries. Every adapter, emulated or not, passes
``tests/contract``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable

from hal.arrays import Array, Int16Array
from hal.types import CanFrame, CanStats, I2cOp, OutputLimit, PortInfo, ScanBlock, ScanConfig, ScanInfo


class Clock(Protocol):
    """Counts monotonic integer nanoseconds; every process of a bench sees the same time."""

    def now_ns(self) -> int:
        """Return the time now, in ns."""
        ...

    def sleep_until_ns(self, t_ns: int) -> int:
        """Return at or after ``t_ns``; the result is the lateness in ns (>= 0)."""
        ...


class SerialPort(Protocol):
    """Carries bytes both ways, 8N1. Modem lines are not part of the contract (a pty has none)."""

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        """Read 1..len(buf) bytes as soon as any are there; 0 means that ``timeout_s`` passed.

        Raises ``Disconnected`` when the peer is gone.
        """
        ...

    def write(self, data: bytes, timeout_s: float) -> None:
        """Write all of ``data`` or raise ``HalTimeout`` (with ``partial``) or ``Disconnected``."""
        ...

    def drain_input(self) -> int:
        """Discard the bytes that have arrived. Return their number."""
        ...

    def info(self) -> PortInfo: ...
    def close(self) -> None: ...


class I2cBus(Protocol):
    """Makes transfers as an I2C master. Addresses have 7 bits, right-aligned."""

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        """Send one START, a repeated START between the segments and one STOP.

        Return the bytes of all read segments, in order. Raises ``I2cNack`` (kind says address or data),
        ``BusError`` or ``Disconnected``.
        """
        ...

    def info(self) -> PortInfo: ...
    def close(self) -> None: ...


class CanBus(Protocol):
    """Sends and receives classic CAN frames (up to 8 data bytes). It does not receive its own frames."""

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        """Queue one frame. Raises ``HalTimeout`` when the queue stays full for ``timeout_s``."""
        ...

    def recv(self, timeout_s: float) -> CanFrame | None:
        """Return the next frame, or ``None`` after ``timeout_s``. Its ``t_ns`` is on the bench clock."""
        ...

    def stats(self) -> CanStats: ...
    def info(self) -> PortInfo: ...
    def close(self) -> None: ...


class GattClient(Protocol):
    """Connects to one Bluetooth Low Energy peripheral. Characteristics are named by their 128-bit UUID."""

    def subscribe(self, characteristic: str, timeout_s: float) -> None:
        """Switch notifications on; from now on they queue. Raises ``DeviceNotFound`` without such a characteristic."""
        ...

    def receive(self, timeout_s: float) -> tuple[str, bytes, int] | None:
        """Return the oldest notification as characteristic, value and time of arrival (bench clock, ns), or ``None``.

        Raises ``Disconnected`` when the link is gone and nothing is left in the queue.
        """
        ...

    def read(self, characteristic: str, timeout_s: float) -> bytes:
        """Return the value of a characteristic. Raises ``HalTimeout``."""
        ...

    def info(self) -> PortInfo: ...
    def close(self) -> None: ...


class AnalogInputScan(Protocol):
    """Delivers hardware-timed scans of several channels."""

    def configure(self, config: ScanConfig) -> ScanInfo:
        """Set the device up and return the settings that it really uses. Raises ``BenchError`` when it cannot."""
        ...

    def start(self) -> None: ...

    def read_scans(self, out: Int16Array, timeout_s: float) -> ScanBlock:
        """Fill rows of ``out`` (max_scans, n_channels) with raw counts, oldest first; ``block.n`` is the number of
        rows.

        Waits for the first scan at most ``timeout_s``, then takes all scans that have arrived. Missing scans are
        reported (``lost``, ``Status.GAP``); ``Overrun`` is raised when the device stopped by itself. ``n == 0`` means
        timeout. Volts are ``counts * lsb_V``.
        """
        ...

    def stop(self) -> None: ...
    def close(self) -> None: ...


class AnalogOutput(Protocol):
    """Drives a group of analog outputs that move together and have a safe state. ``name`` is its bench entry."""

    name: str
    limits: tuple[OutputLimit, ...]

    @property
    def commands_sent(self) -> int:
        """Return the number of ``write`` calls whose values were sent; a slow device may skip some for newer ones."""
        ...

    @property
    def commanded_V(self) -> Sequence[float]:
        """Return the set points in V sent to the device last, by ``write`` or by the ramp to its safe state."""
        ...

    def arm(self) -> None:
        """Allow ``write``. Raises ``SafetyTrip`` when the self-test fails."""
        ...

    def write(self, values_V: Array) -> int:
        """Output ``values_V`` (n_channels,) in V at the load.

        Return a bit mask: bit i is set if channel i was clipped to its limits or slew limited, so 0 means that no
        value was changed. Clipping is no error. Raises ``SafetyTrip`` before ``arm()`` and for a value that
        is not finite; nothing is output then. Raises what the bus raises if the transfer fails.
        """
        ...

    def safe_step(self) -> bool:
        """Make one step of the ramp to ``safe_V``; return True once it is reached. Works armed or not, and disarms."""
        ...

    def readback_V(self) -> Array:
        """Return the outputs that the device itself reports (n_channels,), in V."""
        ...

    def close(self) -> None:
        """Go to the safe state unless it is reached, then release the device."""
        ...


ARMING_STEP_S = 0.001
"""Time that passes after each step of ``ArmsInSteps.arming``."""


@runtime_checkable
class ArmsInSteps(Protocol):
    """Defines an analog output whose arming leaves its caller free to do something else in between."""

    def arming(self) -> Iterator[None]:
        """Do what ``arm`` does; after each step the caller lets ``ARMING_STEP_S`` pass. An output is not armed before
        the last step."""
        ...
