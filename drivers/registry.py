"""Finds drivers by the name that a bench file uses. Each is one record, imported when a bench names it.

A driver is found in one of three places, in this order: ``BUILT_IN``; a folder ``drivers/NAME`` whose module ``driver``
holds ``DRIVER``; an entry point of another package, which declares in its ``pyproject.toml``::

    [project.entry-points."micron.drivers"]
    my_dac = "my_package.my_dac:DRIVER"

The record is the same everywhere, and no file here changes (``docs/adding/i2c-dac.md`` writes one, and its emulator).
``hal.plugins.Registry`` searches the three. A package cannot replace a name of the first two: its entry is ignored. If
two packages offer one name, a bench that uses this name is refused with a message that names both packages.
Drivers, ``firmware_py`` and ``tools`` may import this module; ``hal`` and ``sim_devices`` may not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Protocol

from drivers.options import Options
from drivers.polls import Polling
from hal.bench import DeviceSpec, OpenBench
from hal.contracts import CanBus
from hal.errors import BenchError
from hal.plugins import DRIVERS, Registry
from hal.types import ChannelInfo

BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "di4108": "drivers.daq.di4108:DRIVER",
        "nidaqmx": "drivers.ni:INPUT",
        "adxl203": "drivers.adxl203:DRIVER",
        "analog": "drivers.adxl203:ANALOG",
        "ads1115": "drivers.adc.ads1115:DRIVER",
        "hmc2003": "drivers.hmc2003:DRIVER",
        "amplifier_monitor": "drivers.amplifier_monitor:DRIVER",
        "dac_amplifier": "drivers.piezo.dac_amplifier:DRIVER",
        "e727": "drivers.piezo.e727:DRIVER",
        "nidaqmx_ao": "drivers.ni:OUTPUT",
        "can_amplifier": "drivers.piezo.can_amplifier:DRIVER",
        "can_telemetry": "drivers.can_telemetry:DRIVER",
        "mpu6050": "drivers.imu.bench:MPU6050",
        "lsm6ds3": "drivers.imu.bench:LSM6DS3",
        "bmx055": "drivers.imu.bench:BMX055",
        "motion_card": "drivers.motion_card:DRIVER",
        "ble_motion_card": "drivers.ble_motion_card:DRIVER",
    }
)

Role = Literal["sensor", "daq", "output", "converter", "part", "node", "inertial"]
"""Use of a device in a bench. A "daq" delivers the scans that drive the tick, an "output" moves the stacks, a "sensor"
is read by ``micron read``. The firmware's instruments open the others: a "converter" is the ADC of other devices, a
"part" hangs on a DAQ or ADC, a "node" shares the CAN bus of the firmware, and an "inertial" sensor steers the
endoscope."""
Input = Callable[[int], float]
"""Volts at an input of the device's DAQ, the mean of the last scans."""


class Sensor(Protocol):
    """Defines the object that a driver of role "sensor" opens. It sends nothing on the bus before ``probe``."""

    def probe(self) -> str:
        """Return the identity of the device; raises ``WrongDevice`` if another device answers.

        An analog sensor cannot identify itself, so the text says which sensor it is assumed to be."""
        ...

    def channels(self) -> Sequence[ChannelInfo]: ...

    def read(self) -> Sequence[float]:
        """Read one value per channel, in the unit of that channel."""
        ...


class CanViews(Protocol):
    """Lets several drivers share one CAN bus: each sees its own frames, and the host has one heartbeat."""

    def view(self, bus: str, can_ids: Iterable[int]) -> CanBus: ...
    def heartbeat(self, bus: str) -> Any: ...


def no_inputs(channel: int) -> float:
    """Refuse to read input ``channel``: the device hangs on no DAQ."""
    raise BenchError(f"input {channel} belongs to no DAQ")


@dataclass(frozen=True)
class Site:
    """Describes one device of an opened bench and its place. ``options`` are its checked keys; ``can`` is for the
    instrument's own outputs."""

    name: str
    spec: DeviceSpec
    options: Any
    bench: OpenBench
    volts: Input = no_inputs
    can: CanViews | None = None


class Load(NamedTuple):
    """Tells a driver what it needs to state its traffic: its options, the tick, which polls the firmware makes, and
    which drivers read this device as their ADC."""

    name: str
    options: Any
    tick_hz: int
    polling: Polling
    readers: frozenset[str]


class Traffic(NamedTuple):
    """Describes a transaction that repeats: ``bits`` on the wire (9 for an I2C byte, 10 for a serial one), ``per_s``
    times a second. ``task`` is the firmware's task that waits for it, empty where none does."""

    what: str
    bits: float
    per_s: float
    task: str = ""


@dataclass(frozen=True)
class Driver:
    """Describes a driver; its module holds it as ``DRIVER``.

    ``open(site)`` returns the device by ``role``: a ``Sensor``; a "daq", an ``AnalogInputScan`` with ``name``,
    ``probe`` and ``write_digital``; an "output", an ``AnalogOutput`` with ``probe``. Other roles are parts of the
    instruments' own loops. ``needs`` is the key that connects the device and is required. ``inputs(options)`` returns
    the inputs of its DAQ or ADC that it uses. ``traffic(load)`` returns what it repeats on its bus; a device whose
    traffic no task waits for may give ``bits_per_s(options)``, in bit/s, instead, with 9 bits for an I2C byte and 10
    for a serial one. ``addresses`` lists the 7-bit I2C addresses that the pins of the part select; empty means that it
    has none. ``max_bus_hz`` is the fastest I2C clock of the part, in Hz. ``leased`` is the class of an output
    (``DacOutput``) that a guardian can drive as well. ``verifies`` is True for an output that can be read back.
    ``has_kernels`` is True for a device that a compiled loop can read or command.
    """

    options: type[Options]
    open: Callable[[Site], Any] | None = None
    role: Role = "sensor"
    needs: Literal["bus", "daq", "adc", ""] = "bus"
    inputs: Callable[[Any], tuple[int, ...]] = lambda options: ()
    bits_per_s: Callable[[Any], float] = lambda options: 0.0
    traffic: Callable[[Load], Iterable[Traffic]] | None = None
    addresses: tuple[int, ...] = ()
    max_bus_hz: int | None = None
    leased: Callable[..., Any] | None = None
    verifies: bool = False
    has_kernels: bool = False

    def repeated(self, load: Load) -> Iterable[Traffic]:
        """Return every transaction that the driver repeats on its bus."""
        if self.traffic is not None:
            return self.traffic(load)
        return (Traffic("in all", self.bits_per_s(load.options), 1.0),)


REGISTRY = Registry(DRIVERS, Driver, BUILT_IN, "drivers:driver:DRIVER")


def driver_names() -> list[str]:
    """Return the names of all drivers, ours first. None of them is imported."""
    return list(REGISTRY.targets())


def find_driver(name: str) -> Driver:
    """Return the driver ``name``. Raises ``BenchError`` if there is none, if two packages offer it, or if its package
    cannot be imported."""
    driver = REGISTRY.find(name)
    if driver is None:
        raise BenchError(f"there is no driver '{name}'; drivers are {', '.join(driver_names())}")
    return driver


def open_device(
    bench: OpenBench, name: str, options: Any, volts: Input = no_inputs, can: CanViews | None = None
) -> Any:
    """Open device ``name`` with its driver; nothing is sent yet. Raises ``BenchError`` for a driver that opens none."""
    spec = bench.file.description.device[name]
    driver = find_driver(spec.driver)
    if driver.open is None:
        raise BenchError(f"'{spec.driver}' cannot be opened by itself", device=name)
    return driver.open(Site(name, spec, options, bench, volts, can))
