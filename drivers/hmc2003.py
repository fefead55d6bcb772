"""Drives an HMC-2003: three-axis magnetometer with analog outputs and a set/reset strap, read through an ADS1115.

Source: Honeywell HMC2003 data sheet (1 V/gauss, 2.5 V at zero field, +-2 gauss) and application note AN-201
(set/reset pulses): a reset pulse reverses the sign of the sensitivity but not of the offset, so
offset = (V_set + V_reset) / 2, and scale is left alone.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np

from drivers.adc.ads1115 import Ads1115
from drivers.base import DigitalOutput
from drivers.options import Hmc2003Options
from drivers.registry import Driver
from hal.arrays import Array
from hal.contracts import Clock
from hal.errors import HalTimeout
from hal.types import ChannelInfo

ZERO_FIELD_V = 2.5
SCALE_V_PER_T = 1.0e4  # 1 V/gauss
RANGE_T = 2.0e-4
STRAP_SET, STRAP_RESET = 1, 2  # bits of the digital output
PULSE_NS = 1_000_000  # the pulse circuit fires on the rising edge and needs less
SETTLE_NS = 10_000_000  # strap capacitor and output filter


class Hmc2003:
    """Reads x, y, z one after the other, one split-phase step per ``poll``."""

    def __init__(
        self,
        adc: Ads1115,
        strap: DigitalOutput,
        clock: Clock,
        adc_channels: Sequence[int] = (0, 1, 2),
        *,
        name: str = "mag",
    ) -> None:
        self.name = name
        self.offset_V = np.full(3, ZERO_FIELD_V)
        self.volts: Array = np.full(3, np.nan)
        self.field_T: Array = np.full(3, np.nan)
        self.t_ns = 0
        self.triples = 0
        self._adc = adc
        self._strap = strap
        self._clock = clock
        self._adc_channels = tuple(adc_channels)
        self._axis = 0
        self._fresh = np.full(3, np.nan)

    def poll(self) -> bool:
        """Collect a finished conversion and start the next axis. Return True when all three axes are new.

        The call makes one short I2C transfer and never waits. The triple is in ``volts``, ``field_T`` and ``t_ns``.
        """
        if self._adc.pending is None:
            self._adc.start_conversion(self._adc_channels[self._axis])
            return False
        following = (self._axis + 1) % 3
        value_V = self._adc.exchange(self._adc_channels[following])
        if value_V is None:
            return False
        self._fresh[self._axis] = value_V
        self._axis = following
        if following != 0 or np.isnan(self._fresh[2]):
            return False
        self.volts[:] = self._fresh
        self._fresh[:] = np.nan
        np.subtract(self.volts, self.offset_V, out=self.field_T)
        self.field_T /= SCALE_V_PER_T
        self.t_ns = self._clock.now_ns()
        self.triples += 1
        return True

    def measure_offset(self, triples: int = 4, timeout_s: float = 1.0) -> Generator[None, None, Array]:
        """Set, read, reset, read, set again: takes over and returns ``offset_V`` (3,).

        A background task: yields instead of waiting. The instrument must be at rest meanwhile. Raises
        ``HalTimeout`` when the converter does not deliver.
        """
        after_reset = yield from self._after_pulse(STRAP_RESET, triples, timeout_s)
        after_set = yield from self._after_pulse(STRAP_SET, triples, timeout_s)
        self.offset_V[:] = 0.5 * (after_set + after_reset)
        return self.offset_V.copy()

    def _after_pulse(self, bit: int, triples: int, timeout_s: float) -> Generator[None, None, Array]:
        limit_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._strap.write_digital(bit)
        yield from self._until(self._clock.now_ns() + PULSE_NS)
        self._strap.write_digital(0)
        yield from self._until(self._clock.now_ns() + SETTLE_NS)
        mean = np.zeros(3)
        # the first triple may hold a conversion from before the pulse
        self._axis = 0
        self._adc.pending = None
        self._fresh[:] = np.nan
        for _ in range(triples):
            while not self.poll():
                if self._clock.now_ns() > limit_ns:
                    raise HalTimeout(f"no reading within {timeout_s} s after a strap pulse", device=self.name)
                yield
            mean += self.volts / triples
        return mean

    def _until(self, t_ns: int) -> Generator[None, None, None]:
        while self._clock.now_ns() < t_ns:
            yield

    def channels(self) -> Sequence[ChannelInfo]:
        epsilon = self._adc.lsb_V / SCALE_V_PER_T
        return [ChannelInfo(f"{self.name}.{axis}", "T", -RANGE_T, RANGE_T, epsilon) for axis in "xyz"]


DRIVER = Driver(Hmc2003Options, role="part", needs="adc", inputs=lambda options: options.channels)
