"""Carries CAN frames over a Unix socket to the process of the emulated world.

The socket is of type SOCK_SEQPACKET and carries ``struct can_frame`` (``hal.can_wire``), as a raw CAN socket of the
kernel does. All connections together are one host: none hears what another one sends.
"""

from __future__ import annotations

import errno
import os
import select
import socket
from collections.abc import Iterable

from hal.can_carrier import SOCKET
from hal.can_wire import FRAME_BYTES, MAX_DATA, pack_frame, unpack_frame
from hal.contracts import Clock
from hal.errors import BenchError, Closed, DeviceNotFound, Disconnected, HalError, HalTimeout
from hal.types import CanFrame, CanStats, PortInfo

ROOM = FRAME_BYTES + 1
"""A longer packet is seen to be no frame."""


class UnixCan:
    """Holds one connection to an emulated bus. What is no data frame is counted as an error frame."""

    CARRIER = SOCKET

    def __init__(self, path: str, clock: Clock) -> None:
        self._path = path
        self._clock = clock
        self._stats = CanStats()
        self._open = True
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(path)
        except OSError as error:
            self._socket.close()
            raise DeviceNotFound(f"nobody serves this socket: {error}", device=path) from error
        self._socket.setblocking(False)

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        if not self._open:
            raise Closed("the bus is closed", device=self._path)
        if len(frame.data) > MAX_DATA:
            raise BenchError(f"{len(frame.data)} data bytes in a classic CAN frame", device=self._path)
        packed = pack_frame(frame)
        try:
            try:
                self._socket.send(packed)
            except BlockingIOError:
                select.select((), [self._socket], (), timeout_s)
                self._socket.send(packed)
        except OSError as error:
            raise self._failed(error) from error
        self._stats.tx += 1

    def recv(self, timeout_s: float) -> CanFrame | None:
        if not self._open:
            raise Closed("the bus is closed", device=self._path)
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            try:
                packed = self._socket.recv(ROOM)
            except BlockingIOError:
                left_s = (end_ns - self._clock.now_ns()) * 1e-9
                if left_s <= 0.0 or not select.select([self._socket], (), (), left_s)[0]:
                    return None
                continue
            except OSError as error:
                raise self._failed(error) from error
            if not packed:
                raise Disconnected("the emulated bus has gone", device=self._path)
            if frame := unpack_frame(packed, self._clock.now_ns()):
                self._stats.rx += 1
                return frame
            self._stats.error_frames += 1

    def _failed(self, error: OSError) -> HalError:
        if error.errno in (errno.EAGAIN, errno.ENOBUFS):
            return HalTimeout("the bus takes no more frames: its queue is full", device=self._path)
        return Disconnected(f"the emulated bus has gone: {error}", device=self._path)

    def for_thread(self, can_ids: Iterable[int]) -> UnixCan:
        """See ``CanCarrier``."""
        return UnixCan(self._path, self._clock)

    def fileno(self) -> int:
        """See ``CanCarrier``."""
        return self._socket.fileno()

    def failure(self, code: int) -> HalError:
        """See ``CanCarrier``."""
        return self._failed(OSError(-code, os.strerror(-code)))

    def stats(self) -> CanStats:
        return CanStats(self._stats.rx, self._stats.tx, self._stats.dropped, self._stats.error_frames)

    def info(self) -> PortInfo:
        return PortInfo(f"unix-can://{self._path}", "CAN bus of the emulated world", emulated=True)

    def close(self) -> None:
        self._open = False
        self._socket.close()
