"""What every I2cBus must do. An adapter's test class inherits this and gives ``bus`` with these devices on it:

- 0x50: 256 registers; the first byte written sets the pointer, further bytes are stored, reads return from the
  pointer on; both count up. ``RegisterDevice`` below is that device for servers and emulated buses.
- 0x51: acknowledges its address and refuses every data byte.
- nothing else.
"""

from __future__ import annotations

import pytest

from hal.contracts import I2cBus
from hal.errors import BenchError, Closed, ErrorKind, I2cNack
from hal.types import I2cRead, I2cWrite

MEMORY, REFUSING, NOBODY = 0x50, 0x51, 0x52


class RegisterDevice:
    """The device at 0x50, byte by byte. ``starts`` and ``stops`` count bus conditions."""

    def __init__(self) -> None:
        self.memory = bytearray(range(256))
        self.pointer = 0
        self.starts = 0
        self.stops = 0

    def write(self, data: bytes) -> None:
        self.starts += 1
        if data:
            self.pointer = data[0]
        for byte in data[1:]:
            self.memory[self.pointer] = byte
            self.pointer = (self.pointer + 1) & 0xFF

    def read(self, n: int) -> bytes:
        self.starts += 1
        out = bytes(self.memory[(self.pointer + i) & 0xFF] for i in range(n))
        self.pointer = (self.pointer + n) & 0xFF
        return out

    def stop(self) -> None:
        self.stops += 1


class I2cContract:
    tells_data_nack = True
    """False where the operating system does not say which byte was refused."""

    @pytest.fixture
    def bus(self):
        raise NotImplementedError

    def test_write_then_read_in_one_transfer(self, bus: I2cBus):
        assert bus.transfer(MEMORY, [I2cWrite(b"\x10"), I2cRead(3)]) == b"\x10\x11\x12"

    def test_write_is_kept(self, bus: I2cBus):
        assert bus.transfer(MEMORY, [I2cWrite(b"\x20\xaa\xbb")]) == b""
        assert bus.transfer(MEMORY, [I2cWrite(b"\x20"), I2cRead(3)]) == b"\xaa\xbb\x22"

    def test_reads_of_all_segments_in_order(self, bus: I2cBus):
        ops = [I2cWrite(b"\x00"), I2cRead(2), I2cWrite(b"\x80"), I2cRead(1), I2cRead(1)]
        assert bus.transfer(MEMORY, ops) == b"\x00\x01\x80\x81"

    def test_several_writes_in_one_transfer(self, bus: I2cBus):
        bus.transfer(MEMORY, [I2cWrite(b"\x30\x01"), I2cWrite(b"\x40\x02")])
        assert bus.transfer(MEMORY, [I2cWrite(b"\x30"), I2cRead(1), I2cWrite(b"\x40"), I2cRead(1)]) == b"\x01\x02"

    def test_longer_than_an_smbus_block(self, bus: I2cBus):
        assert bus.transfer(MEMORY, [I2cWrite(b"\x00"), I2cRead(200)]) == bytes(range(200))

    def test_address_nack(self, bus: I2cBus):
        for ops in ([I2cWrite(b"\x00")], [I2cRead(1)]):
            with pytest.raises(I2cNack, match="0x52") as caught:
                bus.transfer(NOBODY, ops)
            assert caught.value.kind is ErrorKind.NACK_ADDRESS

    def test_data_nack(self, bus: I2cBus):
        with pytest.raises(I2cNack, match="0x51") as caught:
            bus.transfer(REFUSING, [I2cWrite(b"\x00")])
        if self.tells_data_nack:
            assert caught.value.kind is ErrorKind.NACK_DATA

    def test_bus_works_after_a_nack(self, bus: I2cBus):
        with pytest.raises(I2cNack):
            bus.transfer(NOBODY, [I2cRead(1)])
        assert bus.transfer(MEMORY, [I2cWrite(b"\x05"), I2cRead(1)]) == b"\x05"

    def test_eight_bit_address_is_refused(self, bus: I2cBus):
        with pytest.raises(BenchError, match="7 bit"):
            bus.transfer(0xA0, [I2cRead(1)])

    def test_info_names_the_bus(self, bus: I2cBus):
        assert "://" in bus.info().uri

    def test_close_twice_then_use(self, bus: I2cBus):
        bus.close()
        bus.close()
        with pytest.raises(Closed):
            bus.transfer(MEMORY, [I2cRead(1)])
