"""Implements SerialPort over pyserial, which opens and configures the port; waits use select on its descriptor.

The port's own timeout stays 0 for ever, because changing it reconfigures the port on some systems and may
corrupt a byte (pyserial issue 394); each call brings its own.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import select
import time
from typing import Any

from hal.errors import BenchError, BusError, Closed, DeviceNotFound, Disconnected, HalError, HalTimeout
from hal.types import PortInfo

# a peer that has gone: USB removal, master side of a pty closed
_GONE = {errno.EIO, errno.ENXIO, errno.ENODEV, errno.EBADF, errno.EPIPE}


class PyserialPort:
    """Opens a tty (USB CDC, UART or pty), 8N1, exclusively.

    Raises ``DeviceNotFound`` when the path is absent, busy or forbidden.
    """

    def __init__(self, path: str, baud: int = 115200) -> None:
        serial: Any = importlib.import_module("serial")
        self._path = path
        try:
            self._port: Any = serial.Serial(path, baudrate=baud, timeout=0, write_timeout=0, exclusive=True)
        except ValueError as error:
            raise BenchError(f"baud {baud} cannot be set: {error}", device=path) from error
        except OSError as error:  # SerialException is one
            raise _open_error(path, error) from error
        self._baud = baud
        # the FTDI default of 16 ms would be most of the loop's latency; a pty and CDC have no such timer
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            self._port.set_low_latency_mode(True)
        self._fd: int = self._port.fileno()
        self._wait = [self._fd]

    def fileno(self) -> int:
        """Return the non-blocking descriptor, for a compiled loop; -1 when the port is closed."""
        return self._fd

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        try:
            if not select.select(self._wait, (), (), timeout_s)[0]:
                return 0
            n = os.readv(self._fd, [buf])
        except BlockingIOError:
            return 0
        except (OSError, ValueError) as error:
            raise self._failed(error) from error
        if n == 0 and len(buf):
            raise Disconnected("the port was closed at the other end", device=self._path)
        return n

    def write(self, data: bytes, timeout_s: float) -> None:
        try:
            done = os.write(self._fd, data)  # the ordinary case: all of it at once
        except BlockingIOError:
            done = 0
        except OSError as error:
            raise self._failed(error) from error
        if done < len(data):
            self._write_rest(memoryview(data)[done:], done, timeout_s)

    def _write_rest(self, rest: memoryview, done: int, timeout_s: float) -> None:
        end = time.monotonic() + timeout_s
        while rest:
            left = end - time.monotonic()
            try:
                ready = left > 0 and select.select((), self._wait, (), left)[1]
                if not ready:
                    raise HalTimeout(
                        f"only {done} of {done + len(rest)} bytes written in {timeout_s} s",
                        device=self._path,
                        partial=done,
                    )
                n = os.write(self._fd, rest)
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._failed(error) from error
            done += n
            rest = rest[n:]

    def drain_input(self) -> int:
        total = 0
        buf = memoryview(bytearray(4096))
        while n := self.read_into(buf, 0.0):
            total += n
        return total

    def info(self) -> PortInfo:
        # /dev/pts is where a pseudo-terminal lives: nobody sells a device there
        return PortInfo(
            uri=f"serial://{self._path}?baud={self._baud}",
            description="serial port (pyserial)",
            emulated=self._path.startswith("/dev/pts/"),
        )

    def close(self) -> None:
        if self._fd >= 0:
            self._fd = -1
            self._wait = [-1]
            with contextlib.suppress(OSError):
                self._port.close()

    def _failed(self, error: Exception) -> HalError:
        if self._fd < 0:
            return Closed("the port is closed", device=self._path)
        if isinstance(error, OSError) and error.errno in _GONE:
            return Disconnected(f"the port has gone ({error.strerror})", device=self._path)
        return BusError(str(error), device=self._path)


def _open_error(path: str, error: OSError) -> HalError:
    code = error.errno or getattr(error.__cause__, "errno", None)
    if code == errno.EACCES:
        hint = "no permission: add yourself to the group that owns it (usually dialout)"
    elif code == errno.EBUSY or "lock" in str(error):
        hint = "in use by another program"
    elif code in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        hint = "not there: is the device plugged in and switched on?"
    else:
        hint = str(error)
    return DeviceNotFound(f"{hint} ('micron doctor' lists the ports)", device=path)
