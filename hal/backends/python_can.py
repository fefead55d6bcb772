"""CanBus over python-can: virtual (one process), udp_multicast (across processes), slcan, socketcan.

Traps of udp_multicast that are handled here: a bus hears its own frames (each frame carries its sender's mark
in python-can's ``channel`` field); groups on one port hear each other (IP_MULTICAST_ALL off); the receive queue
holds 256 frames and drops the rest silently (larger queue asked for, and the mark counts, so that what was
dropped is known); the default hop limit puts frames on the network (0 keeps them on this machine).
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
from collections.abc import Iterable
from typing import Any, TypeVar

from hal.backends.can_package import import_can
from hal.can_carrier import SOCKET
from hal.contracts import Clock
from hal.errors import BenchError, BusError, Closed, DeviceNotFound, Disconnected, HalError, HalTimeout
from hal.types import CanFrame, CanStats, PortInfo, TimeSource

IP_MULTICAST_ALL = 49  # linux/in.h; the socket module has no name for it
SO_RCVBUFFORCE = 33
RECEIVE_BYTES = 4 << 20
MARK_SEPARATOR = "#"
Bus = TypeVar("Bus", bound="PythonCan")


def open_virtual(name: str, clock: Clock) -> PythonCan:
    """Open a bus that carries frames between buses of the same name inside this process."""
    return _open(f"virtual-can://{name}", clock, PythonCan, interface="virtual", channel=name)


def open_socketcan(name: str, clock: Clock) -> SocketCan:
    """Open a Linux CAN interface. ``ip link`` sets its bitrate."""
    return _open(f"socketcan://{name}", clock, SocketCan, interface="socketcan", channel=name)


def open_slcan(path: str, bitrate: int, clock: Clock, wait_s: float = 0.0) -> PythonCan:
    """Open a serial CAN adapter (LAWICEL protocol). Boards that reset when opened need ``wait_s`` of about 2 s."""
    return _open(
        f"slcan://{path}",
        clock,
        PythonCan,
        interface="slcan",
        channel=path,
        bitrate=bitrate,
        sleep_after_open=wait_s,
        timeout=0,
    )


def open_udp_multicast(group: str, port: int, clock: Clock) -> PythonCan:
    """Open a bus that carries frames between processes of this machine. Each bench needs a port of its own."""
    bus = _open(
        f"udp-multicast://{group}:{port}",
        clock,
        PythonCan,
        interface="udp_multicast",
        channel=group,
        port=port,
        hop_limit=0,
        fd=False,
        marked=True,
    )
    bus.widen_receive_queue()
    return bus


def _open(uri: str, clock: Clock, kind: type[Bus], *, marked: bool = False, **options: Any) -> Bus:
    can = import_can()
    try:
        bus: Any = can.Bus(**options)
    except ValueError as error:
        raise BenchError(str(error), device=uri) from error
    except (OSError, can.CanError, ImportError) as error:
        if isinstance(error.__cause__, ValueError):
            raise BenchError(str(error), device=uri) from error
        raise DeviceNotFound(f"does not open: {error}", device=uri) from error
    return kind(bus, can, uri, clock, marked)


class PythonCan:
    """Holds one open python-can bus. It delivers classic data frames; remote, error and FD frames are only counted."""

    def __init__(self, bus: Any, can: Any, uri: str, clock: Clock, marked: bool) -> None:
        self._bus = bus
        self._message = can.Message
        self._errors: tuple[type[Exception], ...] = (can.CanError, OSError, ValueError)
        self._timeout_error: type[Exception] = can.CanTimeoutError
        self._uri = uri
        self._clock = clock
        self._open = True
        self._wait: list[int] = []
        with contextlib.suppress(NotImplementedError):  # the in-process bus has no descriptor
            self._wait.append(bus.fileno())
        self._stats = CanStats()
        # the mark tells our own frames from others' and counts them
        self._mark = f"{os.getpid():x}.{id(self):x}" if marked else None
        self._sent = 0
        self._heard: dict[str, int] = {}

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        if not self._open:
            raise Closed("the bus is closed", device=self._uri)
        if len(frame.data) > 8:
            raise BenchError(f"{len(frame.data)} data bytes in a classic CAN frame", device=self._uri)
        channel = None
        if self._mark is not None:
            channel = f"{self._mark}{MARK_SEPARATOR}{self._sent}"
            self._sent += 1
        message = self._message(
            arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended, channel=channel
        )
        try:
            self._bus.send(message, timeout_s)
        except self._timeout_error as error:
            raise HalTimeout(f"frame 0x{frame.can_id:X} not sent in {timeout_s} s", device=self._uri) from error
        except self._errors as error:
            raise self._failed(error) from error
        self._stats.tx += 1

    def recv(self, timeout_s: float) -> CanFrame | None:
        if not self._open:
            raise Closed("the bus is closed", device=self._uri)
        end = time.monotonic() + timeout_s
        left_s = timeout_s
        while True:
            try:
                # python-can's own waiting is per byte with slcan and ends early at an acknowledgement: we wait
                if self._wait:
                    if not select.select(self._wait, (), (), left_s)[0]:
                        return None
                    message = self._bus.recv(0.0)
                else:
                    message = self._bus.recv(left_s)
                    if message is None:
                        return None
            except self._errors as error:
                raise self._failed(error) from error
            left_s = max(0.0, end - time.monotonic())
            if message is None:
                continue
            if not self._is_mine(message.channel) and self._is_data(message):
                self._stats.rx += 1
                return CanFrame(
                    message.arbitration_id,
                    bytes(message.data),
                    message.is_extended_id,
                    self._bench_time_ns(message.timestamp),
                    TimeSource.KERNEL if self._mark or "socketcan" in self._uri else TimeSource.HOST,
                )

    def _is_data(self, message: Any) -> bool:
        if message.is_error_frame:
            self._stats.error_frames += 1
            return False
        return not (message.is_remote_frame or message.is_fd)

    def _is_mine(self, channel: object) -> bool:
        if self._mark is None or not isinstance(channel, str):
            return False
        mark, _, number = channel.partition(MARK_SEPARATOR)
        if not number.isdecimal():
            return False
        # a jump in a sender's count is what the full receive queue has thrown away
        before = self._heard.get(mark)
        self._heard[mark] = int(number)
        if before is not None and mark != self._mark:
            self._stats.dropped += max(0, int(number) - before - 1)
        return mark == self._mark

    def _bench_time_ns(self, epoch_s: float) -> int:
        """python-can stamps with the wall clock; the bench clock's distance to it is measured anew each time."""
        now_ns = self._clock.now_ns()
        age_ns = time.time_ns() - int(epoch_s * 1e9)
        return now_ns - max(0, age_ns) if 0 < age_ns < 10_000_000_000 else now_ns

    def widen_receive_queue(self) -> None:
        """Ask the kernel for room, and only for frames of our own group."""
        with contextlib.closing(socket.socket(fileno=os.dup(self._bus.fileno()))) as same:
            try:
                same.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BYTES)
            except OSError:  # without root the system grants less
                same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
            if same.family == socket.AF_INET:
                with contextlib.suppress(OSError):
                    same.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)

    def stats(self) -> CanStats:
        return CanStats(self._stats.rx, self._stats.tx, self._stats.dropped, self._stats.error_frames)

    def info(self) -> PortInfo:
        emulated = self._uri.startswith(("virtual-can", "udp-multicast", "slcan:///dev/pts/"))
        return PortInfo(self._uri, "CAN bus (python-can)", emulated)

    def close(self) -> None:
        if self._open:
            self._open = False
            with contextlib.suppress(*self._errors):
                self._bus.shutdown()

    def _failed(self, error: Exception) -> HalError:
        cause = error.__cause__ or error.__context__
        codes = {getattr(e, "errno", None) for e in (error, cause)}
        if codes & {errno.EIO, errno.ENODEV, errno.ENXIO, errno.ENETDOWN, errno.EBADF} or "returned no data" in str(
            error
        ):
            return Disconnected(f"the adapter has gone: {error}", device=self._uri)
        return BusError(str(error) or type(error).__name__, device=self._uri)


class SocketCan(PythonCan):
    """A Linux CAN interface, whose raw sockets carry ``struct can_frame``."""

    CARRIER = SOCKET

    def for_thread(self, can_ids: Iterable[int]) -> SocketCan:
        """See ``CanCarrier``: a socket of its own, whose filter lets ``can_ids`` pass."""
        bus = open_socketcan(self._bus.channel, self._clock)
        bus.receive_only(can_ids)
        return bus

    def receive_only(self, can_ids: Iterable[int]) -> None:
        """Let the kernel pass base frames with ``can_ids`` alone, and never wait in a read or write."""
        self._bus.set_filters([{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in can_ids])
        os.set_blocking(self.fileno(), False)

    def fileno(self) -> int:
        """See ``CanCarrier``."""
        return int(self._bus.fileno())

    def failure(self, code: int) -> HalError:
        """See ``CanCarrier``."""
        if -code in (errno.EAGAIN, errno.ENOBUFS):
            return HalTimeout("the bus takes no more frames: its queue is full", device=self._uri)
        return self._failed(OSError(-code, os.strerror(-code)))
