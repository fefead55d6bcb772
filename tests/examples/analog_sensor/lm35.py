"""LM35 thermometer on one input of the DAQ: 10 mV/degC, 0 V at 0 degC, 2 to 150 degC on a single supply.

Source: Texas Instruments LM35 data sheet SNIS159, section 7.5 (electrical characteristics) and 8.1 (basic circuit).
"""

from collections.abc import Callable

from pydantic import Field

from drivers.options import Options
from drivers.registry import Driver, Site
from hal.types import ChannelInfo
from sim_devices.registry import Device, Surroundings

V_PER_C = 0.010


class Lm35Options(Options):
    """``channel``: the DAQ's input."""

    channel: int = Field(ge=0, le=7)


class Lm35:
    def __init__(self, site: Site) -> None:
        self._name, self._channel, self._volts = site.name, site.options.channel, site.volts

    def probe(self) -> str:
        return f"LM35 on input {self._channel} (a voltage has no identity)"

    def channels(self) -> list[ChannelInfo]:
        return [ChannelInfo(f"{self._name}.temperature", "degC", 2.0, 150.0, 0.1)]

    def read(self) -> list[float]:
        return [self._volts(self._channel) / V_PER_C]


def emulated(around: Surroundings) -> dict[int, Callable[[int], float]]:
    """Model limits: no error, no noise, no lag; it stops at the ends of its range."""

    def volts(t_ns: int) -> float:
        return V_PER_C * min(max(around.motion(t_ns).temperature_C, 2.0), 150.0)

    return {around.entry["channel"]: volts}


DRIVER = Driver(Lm35Options, Lm35, needs="daq", inputs=lambda options: (options.channel,))
EMULATED = Device(emulated)
