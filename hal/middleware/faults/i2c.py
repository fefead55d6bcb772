"""An I2C bus whose transfers are refused, held up or damaged."""

from __future__ import annotations

from collections.abc import Sequence

from hal.contracts import Clock, I2cBus
from hal.errors import ErrorKind, I2cNack
from hal.middleware.faults.plan import FaultPlan, FaultyPort
from hal.types import I2cOp, I2cWrite


class FaultI2c(FaultyPort):
    """Injects faults into an I2cBus. A silent bus acknowledges nothing; a lost transfer is an address NACK, too.

    ``only`` restricts everything but disconnection to one device address.
    """

    def __init__(self, bus: I2cBus, clock: Clock, plan: FaultPlan, *, only: int | None = None) -> None:
        super().__init__(bus, clock, plan)
        self._bus = bus
        self._only = only

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        faults, plan = self._faults, self._faults.plan
        faults.check_connection()
        if self._only is not None and address != self._only:
            return self._bus.transfer(address, ops)
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
        if faults.happens(plan.write_corruption):
            ops = self._damaged(ops)
        result = bytearray(self._bus.transfer(address, ops))
        if faults.happens(plan.duplication):
            self.counts.duplicated += 1
            self._bus.transfer(address, ops)
        if result and faults.happens(plan.corruption):
            faults.flip_a_bit(memoryview(result), faults.random.randrange(len(result)))
        return bytes(result)

    def _damaged(self, ops: Sequence[I2cOp]) -> list[I2cOp]:
        """Flip one bit of one written data byte. The first byte of a write is a register and stays as it is."""
        damaged = list(ops)
        places = [(i, op) for i, op in enumerate(ops) if isinstance(op, I2cWrite) and len(op.data) > 1]
        if places:
            i, op = self._faults.random.choice(places)
            data = bytearray(op.data)
            self._faults.flip_a_bit(memoryview(data), self._faults.random.randrange(1, len(data)))
            damaged[i] = I2cWrite(bytes(data))
        return damaged

    def arm(self, plan: FaultPlan, *, only: int | None = None) -> None:
        """See ``FaultyPort.arm``."""
        self._only = only
        super().arm(plan)
