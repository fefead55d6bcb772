"""MCP4728, quad 12-bit DAC on I2C, in front of the amplifier. Source: Microchip data sheet DS22187E, figures 5-7 ff.

The LDAC pin is tied low: outputs A, B, C move one after the other, 45 us apart. Internal reference, gain 2 and a rest
near neutral are stored in its EEPROM beforehand, because to change them would move the outputs.
"""

from pydantic import Field

from drivers.options import OutputOptions
from drivers.piezo.dac_output import DacOutput, output_driver
from hal.errors import WrongDevice
from hal.types import I2cOp, I2cRead, I2cWrite
from hal.wire_bits import i2c_bits

MULTI_WRITE_D, SETTING = 0x46, 0x90  # SETTING: internal reference 2.048 V, output on, gain 2


class Mcp4728(DacOutput):
    PART, ADDRESSES, MAX_BUS_HZ = "MCP4728", tuple(range(0x60, 0x68)), 400_000
    SPAN_V, CODES = 4.096, 4096
    TRANSFER_NS, READ_BACK_NS = 157_000, 0  # 7 bytes at 400 kHz
    READ_CODES = (I2cRead(15),)  # register and EEPROM of A and B, register of C
    WIRE_BITS = {"command": i2c_bits([I2cWrite(bytes(6))]), "verify": i2c_bits(READ_CODES)}  # noqa: RUF012

    def identify(self) -> None:
        for pattern in (0xA5A, 0x5A5):  # into the unused D
            self.transfer([I2cWrite(bytes((MULTI_WRITE_D, SETTING | pattern >> 8, pattern & 0xFF)))])
            answer = self.transfer([I2cRead(24)])
            if [status & 0x30 for status in answer[::3]] != [0, 0, 16, 16, 32, 32, 48, 48]:
                raise WrongDevice(f"answers {answer.hex()}: not an MCP4728", device=self.name)
            if int.from_bytes(answer[19:21], "big") & 0xFFF != pattern:
                raise WrongDevice(f"wrote 0x{pattern:03X} to DAC D, read back {answer[19:21].hex()}", device=self.name)
        if any(answer[6 * i + 1] & 0xF0 != SETTING for i in range(3)):
            raise WrongDevice("store internal reference and gain 2 in its EEPROM first", device=self.name)

    def segments(self, a: int, b: int, c: int) -> tuple[I2cOp, ...]:
        return (I2cWrite(bytes((a >> 8, a & 0xFF, b >> 8, b & 0xFF, c >> 8, c & 0xFF))),)  # fast write

    def codes_of(self, answer: bytes) -> list[int]:
        return [int.from_bytes(answer[6 * i + 1 : 6 * i + 3], "big") & 0xFFF for i in range(3)]

    def verify(self) -> str:
        return self.differences(self.read_codes())


class Mcp4728Options(OutputOptions):
    gain: float = Field(ge=0.1, le=100)
    lo_V: float = Field(default=0.0, ge=0)
    hi_V: float = Field(default=100.0, le=150)


DRIVER = output_driver(Mcp4728, Mcp4728Options)
