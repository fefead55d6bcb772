"""Injects faults into the incoming bytes of a serial port."""

from __future__ import annotations

from hal.contracts import Clock, SerialPort
from hal.middleware.faults.plan import FaultPlan, FaultyPort


class FaultSerial(FaultyPort):
    """Injects faults into a SerialPort."""

    def __init__(self, port: SerialPort, clock: Clock, plan: FaultPlan) -> None:
        super().__init__(port, clock, plan)
        self._port = port
        self._held = b""  # bytes that were read from the port and are not delivered yet

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        faults = self._faults
        faults.check_connection()
        faults.hold_up()
        if self._held:
            return self._deliver(buf, b"")
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            left_s = max(0.0, (end_ns - self._clock.now_ns()) * 1e-9)
            n = self._port.read_into(buf, left_s)
            if n == 0:
                return 0
            if faults.silent():
                self.counts.silenced += n
            elif kept := self._deliver(buf, self._damaged(bytearray(buf[:n]))):
                return kept
            if left_s == 0.0:
                return 0

    def _deliver(self, buf: memoryview, data: bytes) -> int:
        data = self._held + data
        n = min(len(data), len(buf))
        buf[:n] = data[:n]
        self._held = data[n:]
        return n

    def _damaged(self, data: bytearray) -> bytes:
        faults, plan, counts = self._faults, self._faults.plan, self.counts
        if plan.corruption:
            for i in range(len(data)):
                if faults.happens(plan.corruption):
                    faults.flip_a_bit(memoryview(data), i)
        if plan.loss or plan.duplication:
            kept = bytearray()
            for byte in data:
                if faults.happens(plan.loss):
                    counts.lost += 1
                    continue
                kept.append(byte)
                if faults.happens(plan.duplication):
                    counts.duplicated += 1
                    kept.append(byte)
            data = kept
        if len(data) > 1 and faults.happens(plan.truncation):
            cut = faults.random.randrange(1, len(data))
            counts.truncated += 1
            counts.lost += len(data) - cut
            data = data[:cut]
        if len(data) > 1 and faults.happens(plan.reorder):
            i = faults.random.randrange(len(data) - 1)
            data[i], data[i + 1] = data[i + 1], data[i]
            counts.reordered += 1
        return bytes(data)

    def write(self, data: bytes, timeout_s: float) -> None:
        self._faults.check_connection()
        if self._faults.silent():
            self.counts.silenced += len(data)
            return
        self._faults.wait_for_room(timeout_s)
        self._port.write(data, timeout_s)

    @property
    def is_full(self) -> bool:
        """True while a write finds no room."""
        return self._faults.full()

    def drain_input(self) -> int:
        dropped = len(self._held)
        self._held = b""
        return dropped + self._port.drain_input()
