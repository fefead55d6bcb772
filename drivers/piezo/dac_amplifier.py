"""Drives a three-channel piezo amplifier behind an AD5696R: 16-bit quad I2C DAC, 2.5 V reference, gain pin high.

Source: Analog Devices AD5696R data sheet rev. B: "Input shift register" (Tables 7 and 8), "Write operation",
"Multiple DAC readback sequence", "Load DAC", "Internal reference setup". V_DAC = 2.5 V * 2 * code / 65536.

One transfer per update: A, B, C into the input registers, then one update command, so that all outputs move at
once. Segments are separated by repeated STARTs, because the data sheet knows one 24-bit word per address byte.
"""

from __future__ import annotations

from drivers.options import DacAmplifierOptions
from drivers.piezo.dac_output import CHANNELS, DacOutput, output_driver
from hal.errors import WrongDevice
from hal.types import I2cOp, I2cRead, I2cWrite
from hal.wire_bits import i2c_bits

WRITE_INPUT, UPDATE, POWER, LDAC_MASK, REFERENCE = 0x10, 0x20, 0x40, 0x50, 0x70
ADDRESS_BITS = (0x1, 0x2, 0x4)  # DAC A, B, C
SPARE = 0x8  # DAC D, not connected
PATTERNS = (0x5AA5, 0x0000, 0xA55A)  # into DAC D; the last one stays there and is neither end nor middle of the scale
MAX_BUS_HZ = 400_000  # data sheet, table 4: SCL frequency
_COMMAND: tuple[I2cOp, ...] = (I2cWrite(bytes(3)),) * (CHANNELS + 1)
_READ_ABC: tuple[I2cOp, ...] = (I2cWrite(bytes((ADDRESS_BITS[0],))), I2cRead(2 * CHANNELS))
_READ_ALL: tuple[I2cOp, ...] = (I2cWrite(bytes((ADDRESS_BITS[0],))), I2cRead(2 * (CHANNELS + 1)))
_UPDATE_ABC = I2cWrite(bytes((UPDATE | 0x7, 0, 0)))
WRITE_A, WRITE_B, WRITE_C = (WRITE_INPUT | bit for bit in ADDRESS_BITS)
WIRE_BITS = {
    "command": i2c_bits(_COMMAND),
    "command with read-back": i2c_bits(_COMMAND + _READ_ABC),
    "verify": i2c_bits(_READ_ALL),
}


class DacAmplifier(DacOutput):
    """Drives an AD5696R. All outputs of a command move at once."""

    PART = "AD5696R"
    ADDRESSES = (0x0C, 0x0D, 0x0E, 0x0F)
    MAX_BUS_HZ = MAX_BUS_HZ
    SPAN_V = 5.0
    CODES = 65536
    TRANSFER_NS = 365_000  # 4 segments of 4 bytes at 400 kHz, the fastest that the part allows, less a bit each
    READ_BACK_NS = 200_000  # pointer and six bytes at 400 kHz: the update has been in force for at least so long
    READ_CODES = _READ_ABC
    VERIFY = _READ_ALL
    CODE_AT = ((0, 1), (1, 1), (2, 1))
    FIXED_WORDS = (PATTERNS[-1],)
    WIRE_BITS = WIRE_BITS

    def identify(self) -> None:
        """Send patterns through the input register of the unused DAC D: nothing moves, all 16 bits must hold.

        Also switches the internal reference on, all outputs to normal operation, and lets only the update
        command move them."""
        for command in (
            (REFERENCE, 0, 0),  # 0: internal reference on
            (LDAC_MASK, 0, 0x0F),  # 1: the LDAC pin is ignored
            (POWER, 0, 0),  # 00 per channel: normal operation
        ):
            self.transfer([I2cWrite(bytes(command))])
        for pattern in PATTERNS:
            self.transfer([I2cWrite(bytes((WRITE_INPUT | SPARE, pattern >> 8, pattern & 0xFF)))])
            read_back = int.from_bytes(self.transfer([I2cWrite(bytes((SPARE,))), I2cRead(2)]), "big")
            if read_back != pattern:
                raise WrongDevice(
                    f"wrote 0x{pattern:04X} to DAC D, read back 0x{read_back:04X}: not an AD5696R", device=self.name
                )

    def segments(self, a: int, b: int, c: int) -> tuple[I2cOp, ...]:
        return (
            I2cWrite(bytes((WRITE_A, a >> 8, a & 0xFF))),
            I2cWrite(bytes((WRITE_B, b >> 8, b & 0xFF))),
            I2cWrite(bytes((WRITE_C, c >> 8, c & 0xFF))),
            _UPDATE_ABC,
        )

    def codes_of(self, answer: bytes) -> list[int]:
        """Return the contents of the input registers, which equal the outputs after each update command."""
        return [int.from_bytes(answer[2 * i : 2 * i + 2], "big") for i in range(CHANNELS)]

    def verify(self) -> str:
        """Read all four input registers back, 0.26 ms at 400 kHz. Return an empty text, or what differs from the last
        command. DAC D holds a pattern since the probe; a part that has restarted has lost it.
        """
        answer = self.answer_to_verify()
        spare = int.from_bytes(answer[2 * CHANNELS :], "big")
        if spare != PATTERNS[-1]:
            return f"the DAC has restarted (register D holds 0x{spare:04X} instead of 0x{PATTERNS[-1]:04X})"
        return self.differences(self.codes_of(answer))


DRIVER = output_driver(DacAmplifier, DacAmplifierOptions)
