"""The bus contracts on the in-process ports of the emulated world, in virtual time."""

from __future__ import annotations

from collections import deque

import pytest

from hal.clock import VirtualClock
from hal.types import CanFrame
from sim_devices.transports.can_hub import EXTENDED, CanHub
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.transports.lockstep import LockstepCanBus, LockstepI2cBus, LockstepSerialPort
from tests.contract.can_contract import CanContract, CanPair
from tests.contract.i2c_contract import MEMORY, REFUSING, I2cContract, RegisterDevice
from tests.contract.serial_contract import SerialContract, SerialLink


class Pipe:
    """A byte face without a mind of its own."""

    unread = 0

    def __init__(self) -> None:
        self.to_host = bytearray()
        self.from_host = bytearray()

    def receive(self, data: bytes, t_ns: int) -> None:
        self.from_host += data

    def take(self, max_bytes: int) -> bytes:
        data = bytes(self.to_host[:max_bytes])
        del self.to_host[:max_bytes]
        return data

    def advance_to(self, t_ns: int) -> None: ...
    def next_event_ns(self) -> int | None: ...


class TestLockstepSerial(SerialContract):
    @pytest.fixture
    def link(self) -> SerialLink:
        pipe, clock = Pipe(), VirtualClock()
        port = LockstepSerialPort("pipe", pipe, clock, lambda: None)

        def receive(n: int) -> bytes:
            data = bytes(pipe.from_host[:n])
            del pipe.from_host[:n]
            return data

        return SerialLink(port, pipe.to_host.extend, receive, port.unplug, clock)


class Face:
    """A ``RegisterDevice``, or one that refuses every byte, as an I2C face."""

    def __init__(self, device: RegisterDevice | None) -> None:
        self.device = device

    def acknowledges(self) -> bool:
        return True

    def write(self, data: bytes, t_ns: int) -> int:
        if self.device is None:
            return 0
        self.device.write(data)
        return len(data)

    def read(self, n: int, t_ns: int) -> bytes:
        return bytes(n) if self.device is None else self.device.read(n)

    def general_call(self, data: bytes, t_ns: int) -> bool:
        return False

    def advance_to(self, t_ns: int) -> None: ...
    def next_event_ns(self) -> int | None: ...


class TestLockstepI2c(I2cContract):
    @pytest.fixture
    def bus(self) -> LockstepI2cBus:
        line = I2cLine(400_000)
        line.attach(MEMORY, Face(RegisterDevice()))
        line.attach(REFUSING, Face(None))
        return LockstepI2cBus("i2c", line, VirtualClock(), lambda: None)


class FarNode:
    """Another node on the hub, and the far end of the contract at once."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.got: deque[CanFrame] = deque()
        self.waiting: list[tuple[int, bytes]] = []
        self.wake = lambda: None

    def receive(self, can_id: int, data: bytes, t_ns: int) -> None:
        self.got.append(CanFrame(can_id & ~EXTENDED, data, bool(can_id & EXTENDED), t_ns))

    def advance_to(self, t_ns: int) -> None: ...

    def next_event_ns(self) -> int | None:
        return self.clock.now_ns() if self.waiting else None

    def take(self) -> list[tuple[int, bytes]]:
        frames, self.waiting = self.waiting, []
        return frames

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        self.waiting.append((frame.can_id | (EXTENDED if frame.extended else 0), frame.data))
        self.wake()

    def recv(self, timeout_s: float) -> CanFrame | None:
        deadline_ns = self.clock.now_ns() + round(timeout_s * 1e9)
        while not self.got and (due := self.clock.next_event_ns()) is not None and due <= deadline_ns:
            self.clock.advance_to(due)
        return self.got.popleft() if self.got else None


class TestLockstepCan(CanContract):
    @pytest.fixture
    def pair(self) -> CanPair:
        clock = VirtualClock()
        hub = CanHub(500_000)
        far = FarNode(clock)
        hub.attach(far)

        def schedule() -> None:
            due_ns = hub.next_event_ns()
            if due_ns is not None:
                clock.at(due_ns, fire)

        def fire(t_ns: int) -> None:
            hub.advance_to(t_ns)
            schedule()

        far.wake = schedule
        bus = LockstepCanBus("can", hub, clock, schedule)
        return CanPair(bus, far, clock)  # type: ignore[arg-type]
