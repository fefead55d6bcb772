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
    """The sensor that ``AddedDriver.open`` returns. It sends nothing on the bus before ``probe``."""

    def probe(self) -> str:
        """Return the identity of the device; raises ``WrongDevice`` if another device answers.

        An analog sensor cannot identify itself, so the text says which sensor it is assumed to be."""
        ...

    def channels(self) -> Sequence[ChannelInfo]: ...

    def read(self) -> Sequence[float]:
        """Read one value per channel, in the unit of that channel."""
        ...


@dataclass(frozen=True)
class Site:
    """Describes one device of an opened bench and its place. ``options`` are its checked keys."""

    name: str
    spec: DeviceSpec
    options: Any
    bench: OpenBench
    volts: Input


@dataclass(frozen=True)
class AddedDriver:
    """Describes a driver of another package; the package's entry point names an object of this type.

    ``open(site)`` returns a ``Sensor``; where ``options`` is a ``DaqOptions``, it returns a DAQ: an
    ``AnalogInputScan`` with ``name``, ``probe`` and ``write_digital``. ``needs`` is the key that connects the device
    and is required. ``inputs(options)`` returns the DAQ inputs that the device uses. ``bits_per_s(options)`` returns
    the load on its bus in bit/s, with 9 bits for an I2C byte and 10 for a serial one.
    """

    options: type[Options]
    open: Callable[[Site], Any]
    needs: Literal["bus", "daq"] = "bus"
    inputs: Callable[[Any], tuple[int, ...]] = lambda options: ()
    bits_per_s: Callable[[Any], float] = lambda options: 0.0

    @property
    def scans(self) -> bool:
        """Return True if the device is a DAQ."""
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
