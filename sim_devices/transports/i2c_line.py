"""An I2C bus as time: who answers, what comes back, and when each segment has gone over the wire.

Bits per segment: START or repeated START 1, address byte 9, every data byte 9; STOP 1 (I2C-bus specification
UM10204, section 3.1). Clock stretching, arbitration and rise times are not modelled; a refused data byte is
charged as the whole segment.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from enum import IntEnum

from hal.types import I2cOp, I2cWrite
from sim_devices.faces import I2cFace


class I2cStatus(IntEnum):
    """Result of a transfer; the numbers are sent over the socket."""

    OK = 0
    ADDRESS_NACK = 1
    DATA_NACK = 2
    BUS_ERROR = 3


TransferResult = tuple[I2cStatus, bytes]
Transfer = Generator[int, None, TransferResult]


class I2cLine:
    """Connects one bus with the devices on it. ``stuck`` is a fault hook: SDA held low, every transfer is a bus
    error."""

    def __init__(self, speed_hz: int) -> None:
        self.faces: dict[int, I2cFace] = {}
        self.stuck = False
        self.transfers = 0
        self.busy_ns = 0
        self.is_busy = False
        self.busy_until_ns = 0
        """Bench time in ns at which the current segment ends; ``is_busy`` is True while a transfer is in progress."""
        self._bit_ns = 1e9 / speed_hz

    def attach(self, address: int, face: I2cFace) -> None:
        if address in self.faces:
            raise ValueError(f"two devices at I2C address 0x{address:02x}; give one of them another address")
        self.faces[address] = face

    def duration_ns(self, ops: Sequence[I2cOp]) -> int:
        """Return the bus time in ns of a transfer that every device acknowledges."""
        bits = 1 + sum(10 + 9 * (len(op.data) if isinstance(op, I2cWrite) else op.n) for op in ops)
        return int(bits * self._bit_ns)

    def transfer(self, address: int, ops: Sequence[I2cOp], t_ns: int) -> Transfer:
        """Steps of one transfer: yields when each segment ends (bench ns), acts then, returns status and data.

        Whoever runs it moves time to the yielded instant before asking for the next step.
        """
        self.transfers += 1
        bits = 0
        data = b""
        bit_ns = self._bit_ns
        face = self.faces.get(address)
        status = I2cStatus.OK
        if self.stuck:
            status = I2cStatus.BUS_ERROR
        elif not (address == 0 if face is None else face.acknowledges()):
            status = I2cStatus.ADDRESS_NACK
        begin, end = getattr(face, "start", None), getattr(face, "stop", None)  # devices that hold data meanwhile
        if begin is not None and status is I2cStatus.OK:
            begin(t_ns, 9 * bit_ns)
        for op in ops:
            bits += 10
            if status is not I2cStatus.OK:
                break
            if isinstance(op, I2cWrite):
                sent = op.data
                bits += 9 * len(sent)
                end_ns = t_ns + int(bits * bit_ns)
                yield end_ns
                if face is None:
                    answers = [f.general_call(sent, end_ns) for f in self.faces.values()]  # all of them hear it
                    if not any(answers):
                        status = I2cStatus.ADDRESS_NACK
                        break
                elif face.write(sent, end_ns) < len(sent):
                    status = I2cStatus.DATA_NACK
                    break
            else:
                bits += 9 * op.n
                end_ns = t_ns + int(bits * bit_ns)
                yield end_ns
                if face is None:
                    status = I2cStatus.ADDRESS_NACK  # nobody answers a read from address 0
                    break
                data += face.read(op.n, end_ns)
        if end is not None:
            end()
        busy_ns = int((bits + 1) * bit_ns)
        self.busy_ns += busy_ns
        yield t_ns + busy_ns
        return status, data if status is I2cStatus.OK else b""
