"""Emulated TMP117. Source: Texas Instruments TMP117 data sheet SNOSD82D, sections 7.3 to 7.6.

Model limits: as powered up (8 averages, a cycle a second); other configurations are stored and not obeyed. No noise, no
error, no EEPROM, no alert pin.
"""

from sim_devices.devices.word_map import WordFace
from sim_devices.registry import Device

RESULT, CONFIGURATION, DATA_READY = 0x00, 0x01, 0x2000
POWER_UP = {RESULT: 0x8000, CONFIGURATION: 0x0220, 0x02: 0x6000, 0x03: 0x8000, 0x0F: 0x0117}


class EmulatedTmp117(WordFace):
    power_up, read_only = POWER_UP, (RESULT, 0x0F)

    def was_reset(self, t_ns: int) -> None:
        self.due_ns = t_ns + 125_500_000  # start-up 1.5 ms, then eight conversions of 15.5 ms

    def was_read(self, register: int) -> None:
        if register in (RESULT, CONFIGURATION):
            self.words[CONFIGURATION] &= ~DATA_READY

    def act(self, t_ns: int) -> None:
        self.words[RESULT] = round(self.around.motion(t_ns).temperature_C / 0.0078125) & 0xFFFF
        self.words[CONFIGURATION] |= DATA_READY
        self.due_ns = t_ns + 1_000_000_000


EMULATED = Device(EmulatedTmp117)
