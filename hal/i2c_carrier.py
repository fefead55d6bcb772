"""Describes the I2C adapters whose transfers a compiled loop can make by itself."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from hal.errors import HalError

LINUX, SOCKET, PYTHON = range(3)
"""How a transfer is made: ``ioctl(I2C_RDWR)``, the socket of an emulated bus, or a function of Python."""


@runtime_checkable
class I2cCarrier(Protocol):
    """An adapter whose transfers compiled code can make (``hal.i2c_kernels``)."""

    CARRIER: int

    def for_thread(self) -> I2cCarrier:
        """Return an adapter of the same bus that a thread may use while another one uses this one. Close it as well."""
        ...

    def fileno(self) -> int:
        """Return the descriptor; it may be another one after a failure."""
        ...

    def failure(self, code: int, address: int) -> HalError:
        """Return the error that ``transfer`` raises for what ``hal.i2c_kernels.transfer`` returned."""
        ...

    def close(self) -> None: ...
