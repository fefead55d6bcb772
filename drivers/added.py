"""Drivers from other packages: entry points of group ``micron.drivers``, each naming an ``AddedDriver``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from drivers.options import DaqOptions, Options
from hal.bench import DeviceSpec, OpenBench
from hal.errors import BenchError
from hal.plugins import DRIVERS, load, offered
from hal.types import ChannelInfo

Input = Callable[[int], float]
"""Volts at an input of the device's DAQ, the mean of the last scans."""


class Sensor(Protocol):
    """What ``AddedDriver.open`` gives for a sensor. Nothing is on the bus before ``probe``."""

    def probe(self) -> str:
        """Who answers; ``WrongDevice`` for a stranger. An analog sensor says what it is taken for."""
        ...

    def channels(self) -> Sequence[ChannelInfo]: ...

    def read(self) -> Sequence[float]:
        """One value per channel, in its unit."""
        ...


@dataclass(frozen=True)
class Site:
    """Where a device of an opened bench is. ``options`` are its checked keys."""

    name: str
    spec: DeviceSpec
    options: Any
    bench: OpenBench
    volts: Input


@dataclass(frozen=True)
class AddedDriver:
    """What the entry point names.

    ``open(site)`` gives a ``Sensor``; where ``options`` is a ``DaqOptions``, it gives a DAQ: an ``AnalogInputScan``
    with ``name``, ``probe`` and ``write_digital``. ``needs``: the key without which the device hangs nowhere.
    ``inputs(options)``: what it takes of its DAQ. ``bits_per_s(options)``: what it takes of its bus, 9 bits an I2C
    byte, 10 a serial one.
    """

    options: type[Options]
    open: Callable[[Site], Any]
    needs: Literal["bus", "daq"] = "bus"
    inputs: Callable[[Any], tuple[int, ...]] = lambda options: ()
    bits_per_s: Callable[[Any], float] = lambda options: 0.0

    @property
    def scans(self) -> bool:
        """Whether this is a DAQ."""
        return issubclass(self.options, DaqOptions)


def added_driver(name: str) -> AddedDriver | None:
    """``BenchError`` when its package is broken."""
    return load(DRIVERS, name, AddedDriver)


def added_names() -> list[str]:
    return sorted(offered(DRIVERS))


def open_added(bench: OpenBench, name: str, options: Any, volts: Input) -> Any:
    """The driver of device ``name``; ``BenchError`` when nobody offers it."""
    spec = bench.file.description.device[name]
    driver = added_driver(spec.driver)
    if driver is None:
        raise BenchError(f"there is no driver '{spec.driver}'", device=name)
    return driver.open(Site(name, spec, options, bench, volts))
