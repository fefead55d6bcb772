"""ADXL-203: two-axis accelerometer with analog outputs, read through a DAQ.

Source: Analog Devices ADXL203 data sheet, specifications at 5 V: 1000 mV/g, 2.5 V at 0 g, both ratiometric to
the supply, range +-1.7 g. The reading is specific force: +g on an axis that points up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drivers.options import Adxl203Options, AnalogOptions
from drivers.registry import Driver
from hal.errors import BenchError
from hal.types import ChannelInfo

STANDARD_GRAVITY = 9.80665  # m/s^2 per g, the data sheet's unit
NOMINAL_SUPPLY_V = 5.0
ZERO_G_V = 2.5
SCALE_V_PER_G = 1.0
RANGE_G = 1.7


class Adxl203:
    """Axes of one part and the DAQ channels they are wired to.

    ``zero_V`` and ``scale_V_per_g`` are at 5 V supply; the nominal values are replaced by a calibration.
    """

    def __init__(
        self,
        daq_channels: Mapping[str, int],
        *,
        name: str = "acc",
        zero_V: float = ZERO_G_V,
        scale_V_per_g: float = SCALE_V_PER_G,
    ) -> None:
        if not daq_channels:
            raise BenchError("no axis is wired to a DAQ channel", device=name)
        self.name = name
        self.axes = tuple(daq_channels)
        self.daq_channels = tuple(daq_channels.values())
        self.zero_V = zero_V
        self.scale_V_per_g = scale_V_per_g

    def specific_force(self, volts: float, supply_V: float = NOMINAL_SUPPLY_V) -> float:
        """Specific force in m/s^2 along the axis, from the output and the measured supply, both in V."""
        ratio = supply_V / NOMINAL_SUPPLY_V
        return (volts - self.zero_V * ratio) / (self.scale_V_per_g * ratio) * STANDARD_GRAVITY

    def saturated(self, volts: float, supply_V: float = NOMINAL_SUPPLY_V) -> bool:
        """True at or beyond the +-1.7 g of the data sheet, where the output no longer follows."""
        return abs(self.specific_force(volts, supply_V)) >= RANGE_G * STANDARD_GRAVITY

    def channels(self) -> Sequence[ChannelInfo]:
        limit = RANGE_G * STANDARD_GRAVITY
        return [ChannelInfo(f"{self.name}.{axis}", "m/s^2", -limit, limit, 0.01) for axis in self.axes]


DRIVER = Driver(Adxl203Options, role="part", needs="daq", inputs=lambda options: tuple(options.channels.values()))
ANALOG = Driver(AnalogOptions, role="part", needs="daq", inputs=lambda options: (options.channel,))
"""A plain analog quantity, such as half the sensors' supply."""
