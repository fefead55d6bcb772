"""A pseudo-terminal that carries a byte face, so that the real pyserial opens a real port.

A pty swallows some 20 kB before it blocks, far more than a device's FIFO. The carrier therefore keeps the slave
open itself, asks it how much the host has not read (FIONREAD) and never has more under way than the kernel's
4095-byte line buffer can count; the face sees that number as ``unread`` and applies its own limit. (Bytes that the
kernel's worker has not moved yet are not counted: on a busy machine an overflow may be noticed that much later.)
Unplugging closes the master: the host reads EOF or gets EIO, as when a USB adapter is pulled.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import termios
import tty

from sim_devices.faces import ByteFace

LINE_BUFFER_BYTES = 4095
READ_BYTES = 4096


class PtyCarrier:
    """Carries bytes over one pty. The host opens ``path``; ``fileno`` is for a selector and -1 when unplugged."""

    def __init__(self, face: ByteFace) -> None:
        self._face = face
        self._pending = b""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)

    def fileno(self) -> int:
        return self._master

    def refresh(self) -> None:
        """Tell the face how much the host has not read."""
        if self._master >= 0:
            self._face.unread = self._count_unread()

    def receive(self, t_ns: int) -> None:
        """Hand what the host has written to the face, without waiting."""
        if self._master >= 0:
            with contextlib.suppress(BlockingIOError):
                self._face.receive(os.read(self._master, READ_BYTES), t_ns)

    def send(self) -> None:
        """Give the host what the face has for it, as far as there is room. ``refresh`` comes before."""
        if self._master < 0:
            return
        if not self._pending:
            self._pending = self._face.take(max(0, LINE_BUFFER_BYTES - self._face.unread))
            self._face.unread += len(self._pending)
        if self._pending:
            with contextlib.suppress(BlockingIOError):
                written = os.write(self._master, self._pending)
                self._pending = self._pending[written:]

    def unplug(self) -> None:
        """Fault hook and end of life: hang up on the host. Idempotent."""
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def _count_unread(self) -> int:
        answer = fcntl.ioctl(self._slave, termios.FIONREAD, b"\0\0\0\0")
        return struct.unpack("i", answer)[0] + len(self._pending)
