"""Emulated MCP4728. Source: Microchip data sheet DS22187E, section 5.6 (figures 5-7, 5-8, 5-15).

Model limits: fast write, multi-write and read; other commands are acknowledged and do nothing. LDAC pin low, VDD 5 V.
The EEPROM holds internal reference, gain 2 and half scale. No settling, no general call.
"""

from sim_devices.devices.acting import ActingFace
from sim_devices.registry import Device, Surroundings


class EmulatedMcp4728(ActingFace):
    def __init__(self, around: Surroundings) -> None:
        self.around, self.pins = around, around.entry["address"] & 7
        self.eeprom, self.registers, self.output_V = [0x9800] * 4, [0x9800] * 4, [2.048] * 4
        self.nack_address = self.nack_data = False

    def acknowledges(self) -> bool:
        return not self.nack_address

    def write(self, data: bytes, t_ns: int) -> int:
        if self.nack_data:
            return 0
        if data[:1] and data[0] >> 6 == 0:
            for channel in range(len(data) // 2):
                word = int.from_bytes(data[2 * channel : 2 * channel + 2], "big")
                kept = self.registers[channel % 4] & 0x9000  # a fast write has no bits for reference and gain
                self._put(channel % 4, kept | (word & 0x3000) << 1 | word & 0xFFF, t_ns)
        elif data[:1] and data[0] >> 3 == 0b01000:
            for at in range(0, len(data) - 2, 3):
                self._put(data[at] >> 1 & 3, int.from_bytes(data[at + 1 : at + 3], "big"), t_ns)
        return len(data)

    def _put(self, channel: int, word: int, t_ns: int) -> None:
        if not self.frozen:
            self.registers[channel] = word
            full_V = 2.048 * (1 + (word >> 12 & 1)) if word & 0x8000 else 5.0
            self.output_V[channel] = 0.0 if word & 0x6000 else full_V * (word & 0xFFF) / 4096
            self.around.amplify(channel, self.output_V[channel], t_ns)

    def read(self, n: int, t_ns: int) -> bytes:
        words = [word for pair in zip(self.registers, self.eeprom, strict=True) for word in pair]
        status = [0xC0 | i // 2 << 4 | self.pins for i in range(8)]  # ready, powered, channel, address pins
        return b"".join(bytes((s, w >> 8, w & 0xFF)) for s, w in zip(status, words, strict=True))[:n]

    def general_call(self, data: bytes, t_ns: int) -> bool:
        return False


DEVICE = Device(EmulatedMcp4728)
