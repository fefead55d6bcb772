"""TMP117 thermometer on I2C. Source: Texas Instruments TMP117 data sheet SNOSD82D, section 7.6 (register map)."""

from drivers.base import wait_s
from drivers.options import Options
from drivers.registry import Driver, Site
from hal.errors import HalTimeout, WrongDevice
from hal.types import ChannelInfo, I2cRead, I2cWrite

RESULT, CONFIGURATION, DEVICE_ID = 0x00, 0x01, 0x0F
DATA_READY = 0x2000  # cleared by reading the result or the configuration
C_PER_COUNT = 0.0078125


class Tmp117:
    def __init__(self, site: Site) -> None:
        self.name, self._clock = site.name, site.bench.clock
        self._bus, self._address = site.bench.i2c(site.spec.bus or ""), site.spec.address or 0x48

    def _word(self, register: int, *, signed: bool = False) -> int:
        answer = self._bus.transfer(self._address, [I2cWrite(bytes((register,))), I2cRead(2)])
        return int.from_bytes(answer, "big", signed=signed)

    def probe(self) -> str:
        found = self._word(DEVICE_ID)
        if found & 0x0FFF != 0x117:
            raise WrongDevice(f"device id 0x{found:04X} is not that of a TMP117 (0x117)", device=self.name)
        return f"TMP117 revision {found >> 12} at 0x{self._address:02X}"

    def channels(self) -> list[ChannelInfo]:
        return [ChannelInfo(f"{self.name}.temperature", "degC", -55.0, 150.0, C_PER_COUNT)]

    def read(self) -> list[float]:
        """Waits for a fresh conversion, which comes once a second after power-up, at most for 1.2 s."""
        for _ in range(25):
            if self._word(CONFIGURATION) & DATA_READY:
                return [self._word(RESULT, signed=True) * C_PER_COUNT]
            wait_s(self._clock, 0.05)
        raise HalTimeout("no conversion within 1.2 s", device=self.name)


# at most 21 words a second: 5 bytes of 9 bits, START twice, STOP
DRIVER = Driver(Options, Tmp117, bits_per_s=lambda options: 21 * (9 * 5 + 3))
