"""Faults on purpose: wrap any port, real or emulated, and count what was done to it.

Deterministic: same seed, same plan, same traffic, same faults. What is received suffers loss and corruption;
silence takes both directions; a delay holds up the caller, as a slow link does.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, replace

from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import Disconnected, ErrorKind, I2cNack
from hal.types import CanFrame, CanStats, I2cOp, PortInfo


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """Probabilities are per byte (serial), per transfer (I2C) or per frame (CAN); times from wrapping the port."""

    seed: int = 0
    loss: float = 0.0
    corruption: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.0
    nack: float = 0.0
    silent_after_s: float | None = None
    silent_for_s: float = float("inf")
    disconnect_after_s: float | None = None


@dataclass(slots=True)
class FaultCounts:
    """What was really done. ``silenced`` counts bytes, transfers or frames that silence swallowed."""

    lost: int = 0
    corrupted: int = 0
    delayed: int = 0
    nacked: int = 0
    silenced: int = 0
    disconnected: bool = False


class _Injector:
    def __init__(self, plan: FaultPlan, clock: Clock, uri: str) -> None:
        self.plan = plan
        self.counts = FaultCounts()
        self.random = random.Random(plan.seed)
        self._clock = clock
        self._uri = uri
        self._start_ns = clock.now_ns()

    def now_s(self) -> float:
        return (self._clock.now_ns() - self._start_ns) * 1e-9

    def happens(self, probability: float) -> bool:
        return probability > 0.0 and self.random.random() < probability

    def check_connection(self) -> None:
        after_s = self.plan.disconnect_after_s
        if after_s is not None and self.now_s() >= after_s:
            self.counts.disconnected = True
            raise Disconnected("unplugged (injected fault)", device=self._uri)

    def silent(self) -> bool:
        after_s = self.plan.silent_after_s
        return after_s is not None and after_s <= self.now_s() < after_s + self.plan.silent_for_s

    def hold_up(self) -> None:
        if self.happens(self.plan.delay):
            self.counts.delayed += 1
            self.wait(self.plan.delay_s)

    def wait(self, seconds: float) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + round(seconds * 1e9))

    def flip_a_bit(self, data: memoryview, index: int) -> None:
        data[index] ^= 1 << self.random.randrange(8)
        self.counts.corrupted += 1


class FaultSerial:
    """SerialPort with faults; ``counts`` says what happened."""

    def __init__(self, port: SerialPort, clock: Clock, plan: FaultPlan) -> None:
        self._port = port
        self._clock = clock
        self._faults = _Injector(plan, clock, port.info().uri)
        self.counts = self._faults.counts

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        faults = self._faults
        faults.check_connection()
        faults.hold_up()
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            left_s = max(0.0, (end_ns - self._clock.now_ns()) * 1e-9)
            n = self._port.read_into(buf, left_s)
            if n == 0:
                return 0
            if faults.silent():
                self.counts.silenced += n
            elif kept := self._damage(buf, n):
                return kept
            if left_s == 0.0:
                return 0

    def _damage(self, buf: memoryview, n: int) -> int:
        faults, plan = self._faults, self._faults.plan
        if plan.corruption:
            for i in range(n):
                if faults.happens(plan.corruption):
                    faults.flip_a_bit(buf, i)
        if not plan.loss:
            return n
        kept = bytes(buf[i] for i in range(n) if not faults.happens(plan.loss))
        self.counts.lost += n - len(kept)
        buf[: len(kept)] = kept
        return len(kept)

    def write(self, data: bytes, timeout_s: float) -> None:
        self._faults.check_connection()
        if self._faults.silent():
            self.counts.silenced += len(data)
            return
        self._port.write(data, timeout_s)

    def drain_input(self) -> int:
        return self._port.drain_input()

    def info(self) -> PortInfo:
        return _marked(self._port.info())

    def close(self) -> None:
        self._port.close()


class FaultI2c:
    """I2cBus with faults. A silent bus acknowledges nothing; a lost transfer is an address NACK too."""

    def __init__(self, bus: I2cBus, clock: Clock, plan: FaultPlan) -> None:
        self._bus = bus
        self._faults = _Injector(plan, clock, bus.info().uri)
        self.counts = self._faults.counts

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        faults, plan = self._faults, self._faults.plan
        faults.check_connection()
        faults.hold_up()
        if faults.silent():
            self.counts.silenced += 1
            raise I2cNack(f"nobody answers at address 0x{address:02X} (injected silence)")
        if faults.happens(plan.loss):
            self.counts.lost += 1
            raise I2cNack(f"nobody answers at address 0x{address:02X} (injected loss)")
        if faults.happens(plan.nack):
            self.counts.nacked += 1
            raise I2cNack(f"device 0x{address:02X} refused a data byte (injected fault)", kind=ErrorKind.NACK_DATA)
        result = bytearray(self._bus.transfer(address, ops))
        if result and faults.happens(plan.corruption):
            faults.flip_a_bit(memoryview(result), faults.random.randrange(len(result)))
        return bytes(result)

    def info(self) -> PortInfo:
        return _marked(self._bus.info())

    def close(self) -> None:
        self._bus.close()


class FaultCan:
    """CanBus with faults. A corrupted frame arrives: its checksum, if it has one, has to find it."""

    def __init__(self, bus: CanBus, clock: Clock, plan: FaultPlan) -> None:
        self._bus = bus
        self._clock = clock
        self._faults = _Injector(plan, clock, bus.info().uri)
        self.counts = self._faults.counts

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        self._faults.check_connection()
        self._faults.hold_up()
        if self._faults.silent():
            self.counts.silenced += 1
            return
        self._bus.send(frame, timeout_s)

    def recv(self, timeout_s: float) -> CanFrame | None:
        faults, plan = self._faults, self._faults.plan
        faults.check_connection()
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while (
            frame := self._bus.recv(max(0.0, (end_ns - self._clock.now_ns()) * 1e-9))
        ) is not None:  # a polled bus ends here by itself
            if faults.silent():
                self.counts.silenced += 1
            elif faults.happens(plan.loss):
                self.counts.lost += 1
            else:
                if frame.data and faults.happens(plan.corruption):
                    data = bytearray(frame.data)
                    faults.flip_a_bit(memoryview(data), faults.random.randrange(len(data)))
                    frame = replace(frame, data=bytes(data))
                return frame
        return None

    def stats(self) -> CanStats:
        below = self._bus.stats()
        return CanStats(below.rx, below.tx, below.dropped + self.counts.lost, below.error_frames)

    def info(self) -> PortInfo:
        return _marked(self._bus.info())

    def close(self) -> None:
        self._bus.close()


def _marked(info: PortInfo) -> PortInfo:
    """Reports must say that a port is being sabotaged."""
    return replace(info, description=f"{info.description}, with injected faults")
