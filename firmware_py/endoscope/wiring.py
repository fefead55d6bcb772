"""Opens the inertial sensors of a bench description, chips on I2C and the motion card, behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from drivers.ble_motion_card import BleMotionCard
from drivers.imu.base import Imu, ImuSample
from drivers.imu.bench import ImuOptions, open_imu
from drivers.motion_card import MotionCard
from drivers.options import BleMotionCardOptions, MotionCardOptions
from drivers.registry import find_driver
from drivers.specs import check_devices
from firmware_py.run.opening import Probes
from hal.bench import BenchDescription, DeviceSpec, OpenBench
from hal.errors import BenchError, HalError
from hal.types import Status


def is_endoscope(description: BenchDescription) -> bool:
    """Return True if a bench declares inertial sensors or a motion card, and neither a DAQ nor a piezo output."""
    roles = {find_driver(spec.driver).role for spec in description.device.values()}
    return "inertial" in roles and not roles & {"daq", "output"}


def inertial_devices(description: BenchDescription) -> dict[str, DeviceSpec]:
    """Return the inertial sensors and motion cards that a bench declares, by name."""
    return {name: spec for name, spec in description.device.items() if find_driver(spec.driver).role == "inertial"}


class Card(Protocol):
    """Describes a motion card over wire or radio."""

    name: str

    @property
    def card_status(self) -> int: ...
    @property
    def clicks(self) -> int: ...
    @property
    def lost(self) -> int: ...
    @property
    def bad_frames(self) -> int: ...
    @property
    def masked(self) -> int: ...
    def read(self, out: ImuSample) -> Status: ...


@dataclass
class Sensor:
    """Holds one source of inertial samples. ``imu`` is the chip's driver, ``card`` the card's; one of them is set.

    ``drain_hz`` is 0 for a chip that is read sample by sample, else how often its FIFO is emptied."""

    name: str
    rate_hz: float
    imu: Imu | None = None
    card: Card | None = None
    drain_hz: float = 0.0
    sample: ImuSample = field(default_factory=ImuSample)

    def read(self) -> Status:
        source = self.card if self.card is not None else self.imu
        assert source is not None
        return source.read(self.sample)

    @property
    def lost(self) -> int:
        source = self.card if self.card is not None else self.imu
        return source.lost if source is not None else 0

    @property
    def bad_frames(self) -> int:
        return self.card.bad_frames if self.card is not None else 0

    @property
    def masked(self) -> int:
        return self.card.masked if self.card is not None else 0


@dataclass
class Sensors:
    """Holds all sensors of a bench, probed and configured, not yet started. ``identities`` is what each probe found."""

    by_name: dict[str, Sensor]
    identities: dict[str, str]
    closers: list[Callable[[], None]] = field(default_factory=list[Callable[[], None]])

    def kinds(self) -> dict[str, bool]:
        """Return for each sensor, by name, whether it is a card."""
        return {name: sensor.card is not None for name, sensor in self.by_name.items()}

    def start(self) -> None:
        """Begin to measure."""
        for sensor in self.by_name.values():
            if sensor.imu is not None:
                sensor.imu.start("fifo" if sensor.drain_hz else "data ready")

    def close(self) -> None:
        while self.closers:
            self.closers.pop()()


def open_sensors(bench: OpenBench, only: str | None = None, *, may_drain: bool = False) -> Sensors:
    """Make, probe, reset and configure every inertial sensor of the bench, or the one called ``only``.

    ``may_drain``: the caller can empty a FIFO. Raises ``BenchError`` for a bench without such a sensor, ``OpenFailed``
    with every device that did not answer.
    """
    where, description = str(bench.file.path), bench.file.description
    options = check_devices(description, where)
    found = inertial_devices(description)
    if only is not None and only not in found:
        raise BenchError(
            f"{where}: [device] there is no inertial sensor '{only}'; there are {', '.join(found) or 'none'}"
        )
    probes = Probes()
    sensors = Sensors({}, probes.identities)
    for name, spec in found.items():
        if only in (None, name):
            probes.probe(name, partial(_open, bench, name, spec, options[name], sensors, may_drain))
    try:
        probes.raise_failures()
    except HalError:
        sensors.close()
        raise
    if not sensors.by_name:
        raise BenchError(f"{where}: [device] declares no inertial sensor and no motion card")
    return sensors


def _open(bench: OpenBench, name: str, spec: DeviceSpec, option: object, sensors: Sensors, may_drain: bool) -> str:
    """Open and probe one sensor and add it to ``sensors``. Return what it says of itself."""
    match option:
        case ImuOptions():
            drain_hz = option.drain_hz if option.mode == "fifo" else 0.0
            if drain_hz and not may_drain:
                raise BenchError(
                    f"{bench.file.path}: [device.{name}.mode] the loop reads sample by sample, set it to 'data ready';"
                    " 'fifo' is for micron imu"
                )
            imu = open_imu(spec, option, bench.i2c(spec.bus or ""), bench.clock, name)
            identity = imu.probe()
            sensors.by_name[name] = Sensor(name, imu.setup.rate_hz, imu=imu, drain_hz=drain_hz)
            return identity
        case MotionCardOptions():
            card = MotionCard(
                bench.serial(spec.bus or ""),
                bench.clock,
                rate_hz=option.rate_hz,
                fields=option.fields,
                spike_filter=option.spike_filter,
                name=name,
            )
            identity = card.probe()
            sensors.by_name[name] = Sensor(name, option.rate_hz, card=card)
            return identity
        case BleMotionCardOptions():
            from hal.backends.bleak_gatt import BleakGatt  # bleak is optional

            link = BleakGatt(option.peripheral, bench.clock)
            card = BleMotionCard(link, bench.clock, rate_hz=option.rate_hz, spike_filter=option.spike_filter, name=name)
            sensors.closers.append(card.close)
            identity = card.probe()
            sensors.by_name[name] = Sensor(name, option.rate_hz, card=card)
            return identity
        case _:
            raise BenchError(f"{bench.file.path}: [device.{name}] is no inertial sensor")
