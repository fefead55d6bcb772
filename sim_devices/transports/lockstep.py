"""Ports for virtual time: hal contracts straight onto wire faces, no process, no waiting.

Who waits moves the clock; the world's own events run while it moves. Bus time passes on the same clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import NoReturn

from hal.backends.i2c_checks import check_address
from hal.clock import VirtualClock
from hal.errors import BenchError, BusError, Closed, Disconnected, ErrorKind, I2cNack
from hal.types import CanFrame, CanStats, I2cOp, PortInfo, TimeSource
from sim_devices.faces import ByteFace
from sim_devices.transports.can_hub import EXTENDED, CanHub
from sim_devices.transports.i2c_line import I2cLine, I2cStatus, TransferResult

USB_TRANSFER_NS = 125_000  # one high-speed USB microframe between a full packet and the host


class _Port:
    """``on_activity`` is called after the host has done something that may change what the device does next."""

    def __init__(self, name: str, clock: VirtualClock, on_activity: Callable[[], None], description: str) -> None:
        self._name = name
        self._clock = clock
        self._on_activity = on_activity
        self._description = description
        self._closed = False
        self.unplugged = False

    def info(self) -> PortInfo:
        return PortInfo(f"sim://{self._name}", self._description, emulated=True, details={"clock": "virtual"})

    def close(self) -> None:
        self._closed = True

    def unplug(self) -> None:
        """Remove the adapter for good (fault hook)."""
        self.unplugged = True

    def _refuse(self) -> NoReturn:
        if self._closed:
            raise Closed("used after close()", device=self._name)
        raise Disconnected("the emulated cable is unplugged; plug it in and start again", device=self._name)


class LockstepSerialPort(_Port):
    """Implements ``hal`` SerialPort on a byte face. ``latency_ns`` passes between a device's packet and the waiting
    host."""

    def __init__(
        self,
        name: str,
        face: ByteFace,
        clock: VirtualClock,
        on_activity: Callable[[], None],
        *,
        latency_ns: int = 0,
    ) -> None:
        super().__init__(name, clock, on_activity, "emulated serial device in virtual time")
        self._face = face
        self._latency_ns = latency_ns

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        if self._closed or self.unplugged:
            self._refuse()
        data = self._face.take(len(buf))
        if not data and timeout_s > 0.0:
            data = self._wait(len(buf), timeout_s)
        buf[: len(data)] = data
        return len(data)

    def _wait(self, room: int, timeout_s: float) -> bytes:
        clock = self._clock
        deadline_ns = clock.now_ns() + round(timeout_s * 1e9)
        while True:
            event_ns = clock.next_event_ns()
            if event_ns is None or event_ns > deadline_ns:
                clock.advance_to(deadline_ns)
                return self._face.take(room)
            clock.advance_to(event_ns)
            if self.unplugged:
                self._refuse()
            data = self._face.take(room)
            if data:
                clock.advance_to(clock.now_ns() + self._latency_ns)
                return data

    def write(self, data: bytes, timeout_s: float) -> None:
        if self._closed or self.unplugged:
            self._refuse()
        self._face.receive(bytes(data), self._clock.now_ns())
        self._on_activity()

    def drain_input(self) -> int:
        if self._closed or self.unplugged:
            self._refuse()
        n = 0
        while data := self._face.take(4096):
            n += len(data)
        return n


class LockstepI2cBus(_Port):
    """Implements ``hal`` I2cBus on an ``I2cLine``. A transfer takes its bus time.

    The adapter drives the wire by itself: a transfer that has begun goes on when the host that waits for it stalls.
    Another master waits for its STOP.
    """

    def __init__(self, name: str, line: I2cLine, clock: VirtualClock, on_activity: Callable[[], None]) -> None:
        super().__init__(name, clock, on_activity, "emulated I2C bus in virtual time")
        self._line = line

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        if self._closed or self.unplugged:
            self._refuse()
        check_address(address, self._name)
        clock, line = self._clock, self._line
        while line.is_busy:
            clock.advance_to(line.busy_until_ns)
        line.is_busy = True
        steps = line.transfer(address, ops, clock.now_ns())
        results: list[TransferResult] = []

        def go_on(_: int) -> None:
            try:
                at_ns = next(steps)
            except StopIteration as done:
                line.is_busy = False
                results.append(done.value)
            else:
                line.busy_until_ns = at_ns
                clock.at(at_ns, go_on)

        go_on(0)
        while not results:
            clock.advance_to(line.busy_until_ns)
        status, data = results[0]
        face = self._line.faces.get(address)
        if face is None or face.next_event_ns() is not None:
            self._on_activity()
        if status is not I2cStatus.OK:
            raise i2c_error(status, address, self._name)
        return data


def i2c_error(status: I2cStatus, address: int, device: str) -> BusError:
    """The hal error for a transfer that failed."""
    match status:
        case I2cStatus.ADDRESS_NACK:
            return I2cNack(f"no answer at address 0x{address:02x}; check wiring, power and strapping", device=device)
        case I2cStatus.DATA_NACK:
            message = f"0x{address:02x} refused a data byte; check that it is the right part"
            return I2cNack(message, kind=ErrorKind.NACK_DATA, device=device)
        case _:
            return BusError("SDA is stuck low; power-cycle the devices on the bus", device=device)


class LockstepCanBus(_Port):
    """Implements ``hal`` CanBus: the host's controller on a ``CanHub``."""

    def __init__(self, name: str, hub: CanHub, clock: VirtualClock, on_activity: Callable[[], None]) -> None:
        super().__init__(name, clock, on_activity, "emulated CAN bus in virtual time")
        self._hub = hub
        self._stats = CanStats()
        self._received: deque[CanFrame] = deque()
        hub.host = self._on_frame

    def _on_frame(self, can_id: int, data: bytes, t_ns: int) -> None:
        self._stats.rx += 1
        extended = bool(can_id & EXTENDED)
        self._received.append(CanFrame(can_id & ~EXTENDED, data, extended, t_ns, TimeSource.SIMULATION))

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        if self._closed or self.unplugged:
            self._refuse()
        if len(frame.data) > 8:
            raise BenchError(
                f"{len(frame.data)} bytes do not fit a classic CAN frame; send at most 8", device=self._name
            )
        can_id = frame.can_id | (EXTENDED if frame.extended else 0)
        self._hub.send_from_host(can_id, frame.data, self._clock.now_ns())
        self._stats.tx += 1
        self._on_activity()

    def recv(self, timeout_s: float) -> CanFrame | None:
        if self._closed or self.unplugged:
            self._refuse()
        if not self._received and timeout_s > 0.0:
            self._wait(timeout_s)
        return self._received.popleft() if self._received else None

    def _wait(self, timeout_s: float) -> None:
        clock = self._clock
        deadline_ns = clock.now_ns() + round(timeout_s * 1e9)
        while not self._received:
            event_ns = clock.next_event_ns()
            if event_ns is None or event_ns > deadline_ns:
                clock.advance_to(deadline_ns)
                return
            clock.advance_to(event_ns)

    def stats(self) -> CanStats:
        return CanStats(self._stats.rx, self._stats.tx, self._stats.dropped, self._stats.error_frames)
