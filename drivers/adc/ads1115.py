"""Drives an ADS1115: 16-bit I2C converter, single-ended inputs, one conversion at a time.

Source: Texas Instruments ADS1115 data sheet SBAS444, sections "Pointer register", "Conversion register",
"Config register", "Single-shot mode" and the data-rate tolerance of the electrical characteristics.

Split phase: ``start_conversion`` in one tick; in a later one ``exchange`` takes the result and gives the next order, in
one transfer: one request to the adapter instead of two. Nothing here waits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from drivers.options import Ads1115Options
from drivers.registry import Driver, Load, Traffic
from hal.contracts import Clock, I2cBus
from hal.errors import BenchError, WrongDevice
from hal.types import ChannelInfo, I2cOp, I2cRead, I2cWrite
from hal.wire_bits import i2c_bits

POINTER_CONVERSION, POINTER_CONFIG = 0, 1
OS_START = 0x8000  # written: start a conversion; read: no conversion is running
MUX_SINGLE_ENDED = 0x4000  # plus channel << 12
MODE_SINGLE_SHOT = 0x0100
COMPARATOR_OFF = 0x0003
PGA_CODES = {6.144: 0, 4.096: 1, 2.048: 2, 1.024: 3, 0.512: 4, 0.256: 5}
RATE_CODES = {8: 0, 16: 1, 32: 2, 64: 3, 128: 4, 250: 5, 475: 6, 860: 7}
WAKE_UP_NS = 50_000  # 25 us typical from power-down, doubled
RATE_TOLERANCE = 0.10
SAMPLES_PER_S = 860  # the fastest
MAX_BUS_HZ = 400_000
"""Fastest bus without the high-speed master code (data sheet, "High-speed I2C mode"), which no Linux adapter sends."""
_ORDER: tuple[I2cOp, ...] = (I2cWrite(bytes(3)),)
_READ: tuple[I2cOp, ...] = (I2cWrite(bytes(1)), I2cRead(2))
WIRE_BITS = {"order": i2c_bits(_ORDER), "reading": i2c_bits(_READ + _ORDER)}
"""Bits of ``start_conversion`` (once, and again after an error) and of ``exchange``, which the loop repeats."""
ORDER_NS = 90_000
"""Address and three bytes at 400 kHz, the fastest without the high-speed master code: no conversion begins before."""
EXCHANGE_NS = 205_000
"""The same for the order that follows a reading in one transfer: 84 bits, less a bit each."""


class Ads1115:
    """Drives one converter. ``full_scale_V`` belongs to its amplifier, ``rate_sps`` is the conversion rate."""

    def __init__(
        self,
        bus: I2cBus,
        clock: Clock,
        address: int = 0x48,
        *,
        full_scale_V: float = 6.144,
        rate_sps: int = SAMPLES_PER_S,
        name: str = "adc",
    ) -> None:
        if full_scale_V not in PGA_CODES:
            raise BenchError(f"full_scale_V = {full_scale_V} is not one of {sorted(PGA_CODES)}", device=name)
        if rate_sps not in RATE_CODES:
            raise BenchError(f"rate_sps = {rate_sps} is not one of {sorted(RATE_CODES)}", device=name)
        if not 0x48 <= address <= 0x4B:
            raise BenchError(f"address 0x{address:02X} is not one of 0x48..0x4B", device=name)
        self.name = name
        self.lsb_V = full_scale_V / 32768.0
        self.full_scale_V = full_scale_V
        self.pending: int | None = None
        self.conversions = 0
        self._bus = bus
        self._clock = clock
        self._address = address
        self._config = MODE_SINGLE_SHOT | PGA_CODES[full_scale_V] << 9 | RATE_CODES[rate_sps] << 5 | COMPARATOR_OFF
        self.conversion_ns = WAKE_UP_NS + round(1e9 / rate_sps * (1.0 + RATE_TOLERANCE))
        self._ready_ns = 0
        start = OS_START | MUX_SINGLE_ENDED | self._config
        self._start_ops = [
            [I2cWrite(bytes((POINTER_CONFIG, (word := start | c << 12) >> 8, word & 0xFF)))] for c in range(4)
        ]
        read = [I2cWrite(bytes((POINTER_CONVERSION,))), I2cRead(2)]
        self._exchange_ops = [[*read, *order] for order in self._start_ops]

    def probe(self) -> str:
        """Write the configuration (no conversion) and read it back: the part has no identity register.

        Raises ``WrongDevice`` if another value comes back and ``I2cNack`` if no device answers.
        """
        word = MUX_SINGLE_ENDED | self._config
        self._bus.transfer(self._address, [I2cWrite(bytes((POINTER_CONFIG, word >> 8, word & 0xFF)))])
        answer = self._bus.transfer(self._address, [I2cWrite(bytes((POINTER_CONFIG,))), I2cRead(2)])
        read_back = int.from_bytes(answer, "big")
        if read_back & ~OS_START != word:
            raise WrongDevice(
                f"configuration 0x{word:04X} reads back as 0x{read_back:04X}: not an ADS1115", device=self.name
            )
        return f"ADS1115 at 0x{self._address:02X}, +-{self.full_scale_V} V"

    def start_conversion(self, channel: int) -> None:
        """Start to convert input ``channel`` (0..3) against ground. A pending conversion is given up."""
        self.pending = None
        self._bus.transfer(self._address, self._start_ops[channel])
        self.pending = channel
        self._ready_ns = self._clock.now_ns() + self.conversion_ns

    def exchange(self, channel: int) -> float | None:
        """Return the volts of the pending conversion, and start to convert ``channel`` in the same transfer.

        Return ``None`` without a transfer if no conversion is pending or it may still run. The transfer writes the
        pointer, reads two bytes after a repeated START, and writes the configuration after another one. After an error
        nothing is pending, because it is not known whether the converter accepted the configuration.
        """
        if self.pending is None or self._clock.now_ns() < self._ready_ns:
            return None
        self.pending = None
        answer = self._bus.transfer(self._address, self._exchange_ops[channel])
        self.pending = channel
        self._ready_ns = self._clock.now_ns() + self.conversion_ns
        self.conversions += 1
        return int.from_bytes(answer, "big", signed=True) * self.lsb_V

    def channels(self) -> Sequence[ChannelInfo]:
        return [ChannelInfo(f"ain{i}", "V", 0.0, self.full_scale_V, self.lsb_V) for i in range(4)]


def _traffic(load: Load) -> Iterator[Traffic]:
    readers = (
        ("hmc2003", "magnetometer", load.polling.magnetometer),
        ("amplifier_monitor", "monitor", load.polling.monitor),
    )
    for driver, task, polls in readers:
        if driver in load.readers and polls is not None:
            yield Traffic("reading", WIRE_BITS["reading"], polls.per_s(load.tick_hz), task)


DRIVER = Driver(
    Ads1115Options, role="converter", traffic=_traffic, addresses=(0x48, 0x49, 0x4A, 0x4B), max_bus_hz=MAX_BUS_HZ
)
