"""An I2C bus as time: who answers, what comes back, and when each segment has gone over the wire.

Bits per segment: START or repeated START 1, address byte 9, every data byte 9; STOP 1 (I2C-bus specification
UM10204, section 3.1). Clock stretching, arbitration and rise times are not modelled; a refused data byte is
charged as the whole segment.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from enum import IntEnum

from hal.types import I2cOp, I2cRead, I2cWrite
from sim_devices.devices.faces import I2cFace


class I2cStatus(IntEnum):
    """How a transfer ended; the numbers go over the socket."""

    OK = 0
    ADDRESS_NACK = 1
    DATA_NACK = 2
    BUS_ERROR = 3


TransferResult = tuple[I2cStatus, bytes]
Transfer = Generator[int, None, TransferResult]


class I2cLine:
    """One bus with the devices on it. ``stuck`` is a fault hook: SDA held low, every transfer is a bus error."""

    def __init__(self, speed_hz: int) -> None:
        self.faces: dict[int, I2cFace] = {}
        self.stuck = False
        self.transfers = 0
        self.busy_ns = 0
        self._bit_ns = 1e9 / speed_hz

    def attach(self, address: int, face: I2cFace) -> None:
        if address in self.faces:
            raise ValueError(f"two devices at I2C address 0x{address:02x}; give one of them another address")
        self.faces[address] = face

    def transfer(self, address: int, ops: Sequence[I2cOp], t_ns: int) -> Transfer:
        """Steps of one transfer: yields when each segment ends (bench ns), acts then, returns status and data.

        Whoever runs it moves time to the yielded instant before asking for the next step.
        """
        self.transfers += 1
        bits = 0
        data = b""
        status = I2cStatus.BUS_ERROR if self.stuck else I2cStatus.OK
        face = self.faces.get(address)
        for op in ops:
            bits += 10
            if status is I2cStatus.OK and not (address == 0 or (face is not None and face.acknowledges())):
                status = I2cStatus.ADDRESS_NACK
            if status is not I2cStatus.OK:
                break
            count = op.n if isinstance(op, I2cRead) else len(op.data)
            bits += 9 * count
            end_ns = t_ns + round(bits * self._bit_ns)
            yield end_ns
            if isinstance(op, I2cWrite):
                status = self._write(face, op.data, end_ns)
            elif face is None:
                status = I2cStatus.ADDRESS_NACK  # nobody answers a read from address 0
            else:
                data += face.read(count, end_ns)
        end_ns = t_ns + round((bits + 1) * self._bit_ns)
        self.busy_ns += end_ns - t_ns
        yield end_ns
        return status, data if status is I2cStatus.OK else b""

    def _write(self, face: I2cFace | None, data: bytes, t_ns: int) -> I2cStatus:
        if face is None:
            answers = [listener.general_call(data, t_ns) for listener in self.faces.values()]
            return I2cStatus.OK if any(answers) else I2cStatus.ADDRESS_NACK
        return I2cStatus.OK if face.write(data, t_ns) >= len(data) else I2cStatus.DATA_NACK
