"""A CAN bus with a bad line, a bad node or a controller that gave up."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from hal.contracts import CanBus, Clock
from hal.errors import BusError
from hal.middleware.faults.plan import FaultPlan, FaultyPort
from hal.types import CanFrame, CanStats

BABBLE_ID = 0x001


class FaultCan(FaultyPort):
    """Injects faults into a CanBus. A corrupted frame arrives; only its own checksum can reveal it."""

    def __init__(self, bus: CanBus, clock: Clock, plan: FaultPlan) -> None:
        super().__init__(bus, clock, plan)
        self._bus = bus
        self._waiting: deque[CanFrame] = deque()

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        faults = self._faults
        faults.check_connection()
        faults.hold_up()
        off_s = faults.plan.bus_off_after_s
        if off_s is not None and faults.now_s() >= off_s:
            self.counts.lost += 1
            raise BusError("the controller is bus-off (injected fault): reset it and check the wiring")
        if faults.silent():
            self.counts.silenced += 1
            return
        faults.wait_for_room(timeout_s)
        self._bus.send(frame, timeout_s)

    def recv(self, timeout_s: float) -> CanFrame | None:
        faults, plan, counts = self._faults, self._faults.plan, self.counts
        faults.check_connection()
        counts.error_frames += faults.due(plan.error_frames_hz, counts.error_frames)
        if faults.due(plan.babble_hz, counts.babbled):
            counts.babbled += 1
            return CanFrame(BABBLE_ID, bytes(8), False, self._clock.now_ns())
        if self._waiting:
            return self._waiting.popleft()
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while (
            frame := self._bus.recv(max(0.0, (end_ns - self._clock.now_ns()) * 1e-9))
        ) is not None:  # a polled bus ends here by itself
            if faults.silent():
                counts.silenced += 1
            elif faults.happens(plan.loss):
                counts.lost += 1
            else:
                return self._damaged(frame)
        return None

    def _damaged(self, frame: CanFrame) -> CanFrame:
        faults, plan = self._faults, self._faults.plan
        if frame.data and faults.happens(plan.corruption):
            data = bytearray(frame.data)
            faults.flip_a_bit(memoryview(data), faults.random.randrange(len(data)))
            frame = replace(frame, data=bytes(data))
        if frame.data and faults.happens(plan.truncation):
            self.counts.truncated += 1
            frame = replace(frame, data=frame.data[:-1])
        if faults.happens(plan.duplication):
            self.counts.duplicated += 1
            self._waiting.append(frame)
        if faults.happens(plan.reorder) and (later := self._bus.recv(0.0)) is not None:
            self.counts.reordered += 1
            self._waiting.append(frame)
            return later
        return frame

    def stats(self) -> CanStats:
        below = self._bus.stats()
        errors = below.error_frames + self.counts.error_frames
        return CanStats(below.rx, below.tx, below.dropped + self.counts.lost, errors)
