"""Implements I2cBus over smbus2 on Linux. It uses only ``i2c_rdwr``, which is one combined transfer without the 32-byte
limit of SMBus blocks.

Error numbers: Linux ``Documentation/i2c/fault-codes.rst``.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import importlib
import os
from collections.abc import Sequence
from typing import Any

from hal.backends.i2c_checks import check_address
from hal.errors import BusError, Closed, DeviceNotFound, Disconnected, ErrorKind, HalError, HalTimeout, I2cNack
from hal.i2c_carrier import LINUX
from hal.types import I2cOp, I2cWrite, PortInfo


class Smbus2I2c:
    """``/dev/i2c-N`` (``bus`` is the number) or any path. The kernel's device tree sets the bus speed.

    ``exclusive`` takes the lock of the bus (``flock``), as a serial port is opened exclusively: two programs that
    command one amplifier would undo each other's outputs. The lock ends with the process. Programs of others that do
    not ask for it (i2c-tools) are not kept away.
    """

    CARRIER = LINUX

    def __init__(self, bus: int | str, speed_hz: int = 400_000, *, exclusive: bool = True) -> None:
        smbus2: Any = importlib.import_module("smbus2")
        self._message: Any = smbus2.i2c_msg
        self._device = f"/dev/i2c-{bus}" if isinstance(bus, int) else bus
        self._speed_hz = speed_hz
        self._open = True
        try:
            self._bus: Any = smbus2.SMBus(bus)
        except OSError as error:
            hint = {
                errno.ENOENT: "not there: enable I2C (raspi-config, device tree) or load i2c-dev",
                errno.EACCES: "no permission: add yourself to the group that owns it (usually i2c)",
            }.get(error.errno or 0, str(error))
            raise DeviceNotFound(hint, device=self._device) from error
        try:
            if exclusive:
                fcntl.flock(self._bus.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.close()
            raise DeviceNotFound(
                "the bus is in use by another program of ours, or twice in the bench file; end the other one first",
                device=self._device,
            ) from error
        except OSError:
            pass  # no locks here: better an unlocked bus than none

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        check_address(address, self._device)
        if not self._open:
            raise Closed("the bus is closed", device=self._device)
        message = self._message
        messages: list[Any] = []
        reads: list[Any] = []
        for op in ops:
            if isinstance(op, I2cWrite):
                messages.append(message.write(address, op.data))
            else:
                messages.append(message.read(address, op.n))
                reads.append(messages[-1])
        try:
            self._bus.i2c_rdwr(*messages)
        except OSError as error:
            raise _error(error, address, self._device) from error
        return b"".join(bytes(m) for m in reads)

    def for_thread(self) -> Smbus2I2c:
        """See ``I2cCarrier``: the kernel lets transfers take turns."""
        return self

    def fileno(self) -> int:
        """Return the descriptor of the adapter."""
        return self._bus.fd

    def failure(self, code: int, address: int) -> HalError:
        """See ``I2cCarrier``."""
        return _error(OSError(-code, os.strerror(-code)), address, self._device)

    def info(self) -> PortInfo:
        return PortInfo(
            uri=f"linux-i2c://{self._device.removeprefix('/dev/i2c-')}",
            description="Linux I2C bus (smbus2)",
            emulated=False,
            details={"requested_speed_hz": str(self._speed_hz)},
        )

    def close(self) -> None:
        if self._open:
            self._open = False
            with contextlib.suppress(OSError):
                self._bus.close()


def _error(error: OSError, address: int, device: str) -> HalError:
    text = f"address 0x{address:02X}: {error.strerror or error}"
    match error.errno:
        case errno.ENXIO | errno.EREMOTEIO:
            # Linux has no code of its own for a refused data byte; many adapters say EREMOTEIO for both
            return I2cNack(f"nobody acknowledges at {text}", device=device)
        case errno.EAGAIN:
            return BusError(f"arbitration lost, {text}", kind=ErrorKind.ARBITRATION, device=device)
        case errno.EBADMSG:
            return BusError(text, kind=ErrorKind.CRC, device=device)
        case errno.ETIMEDOUT:
            return HalTimeout(f"the bus is held low too long, {text}", device=device)
        case errno.ENODEV | errno.ESHUTDOWN | errno.EBADF:
            return Disconnected(f"the adapter has gone, {text}", device=device)
        case _:
            return BusError(text, device=device)
