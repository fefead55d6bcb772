"""Reads a bench file: its buses, its devices, and which of them are emulated.

A URI alone decides whether a bus is real or emulated (``serial:///dev/ttyACM0`` or ``sim://daq0``); no code above this
module knows. The description is checked as a whole before anything is opened: unknown keys, duplicate addresses and
channels, dangling references. ``drivers.specs`` checks the keys of each driver.
"""

from __future__ import annotations

import importlib
import tomllib
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from hal import plugins
from hal.clock import MonotonicClock, Pace, PacedClock, VirtualClock
from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import BenchError, HalError, OpenFailed
from hal.toml_file import parse_toml, read_text
from hal.trust import is_our_package, path_inside, require_package
from hal.validation import StrictTable, validate_table

SIM_SCHEME = "sim://"
Port = SerialPort | I2cBus | CanBus


class ClockSpec(StrictTable):
    """Holds the rate of the firmware's tick. Task rates are whole divisions of it."""

    tick_hz: int = Field(default=1000, ge=10, le=10_000)


class SerialSpec(StrictTable):
    """Describes a serial port. USB CDC devices ignore ``baud``."""

    kind: Literal["serial"]
    uri: str
    baud: int = Field(default=115_200, ge=300, le=4_000_000)


class I2cSpec(StrictTable):
    """Describes an I2C bus. The controller is set to ``speed_hz``, and the bus-load check uses it."""

    kind: Literal["i2c"]
    uri: str
    speed_hz: int = Field(default=400_000, ge=10_000, le=3_400_000)


class CanSpec(StrictTable):
    """Describes a CAN bus with classic frames."""

    kind: Literal["can"]
    uri: str
    bitrate: int = Field(default=500_000, ge=10_000, le=1_000_000)


BusSpec = Annotated[SerialSpec | I2cSpec | CanSpec, Field(discriminator="kind")]


class DeviceSpec(BaseModel):
    """Describes one device: its driver, its bus or the device that it hangs on. Other keys belong to the driver."""

    model_config = ConfigDict(extra="allow", frozen=True)

    driver: str
    bus: str | None = None
    daq: str | None = None
    adc: str | None = None
    address: int | None = Field(default=None, ge=0x08, le=0x77)

    def options(self) -> dict[str, Any]:
        """Return the driver's own keys."""
        return dict(self.__pydantic_extra__ or {})


class BenchDescription(StrictTable):
    """Holds the content of a bench file. The readers of ``emulation`` and ``firmware`` check those tables."""

    format: Literal[1]
    name: str
    clock: ClockSpec = ClockSpec()
    emulation: dict[str, Any] = Field(default_factory=dict)
    bus: dict[str, BusSpec] = Field(default_factory=dict)
    device: dict[str, DeviceSpec] = Field(default_factory=dict)
    firmware: dict[str, Any] = Field(default_factory=dict)

    def emulated_buses(self) -> list[str]:
        return [name for name, spec in self.bus.items() if spec.uri.startswith(SIM_SCHEME)]

    def devices_with(self, *drivers: str) -> dict[str, DeviceSpec]:
        """Return the devices of the named drivers, in the order of the file."""
        return {name: spec for name, spec in self.device.items() if spec.driver in drivers}


@dataclass(frozen=True)
class BenchFile:
    """Holds a checked description with its path and its text, which recordings keep."""

    path: Path
    text: str
    description: BenchDescription

    def resolve(self, relative: str) -> Path:
        """Return the path that the bench file names, relative to the file.

        Raises ``NotTrusted`` when it lies outside the file's folder, ``BenchError`` for a path that no file can have.
        """
        return path_inside(self.path, relative)


def load_bench(path: Path) -> BenchFile:
    """Read and check a bench file. Raises ``BenchError`` with file and key."""
    text = read_text(path, "name an existing bench file")
    try:
        table = parse_toml(text, str(path))
    except tomllib.TOMLDecodeError as error:
        raise BenchError(f"{path}: not valid TOML: {error}") from error
    description = validate_table(BenchDescription, table, str(path))
    _check_references(description, str(path))
    _check_trust(description, path)
    return BenchFile(path.resolve(), text, description)


def named_packages(description: BenchDescription) -> list[str]:
    """Return ``module:object`` of the code that a bench names: its provider, and drivers, estimators and filters."""
    targets = [str(description.emulation["provider"])] if "provider" in description.emulation else []
    drivers = {spec.driver for spec in description.device.values()}
    tables: list[Any] = [description.firmware.get(key) for key in ("tremor", "fusion")]
    methods = {str(cast("dict[str, Any]", table).get("method")) for table in tables if isinstance(table, dict)}
    named = {plugins.DRIVERS: drivers, plugins.DEVICES: drivers, plugins.ESTIMATORS: methods, plugins.FUSION: methods}
    for group, names in named.items():
        entries = (plugins.find_entry(group, name) for name in sorted(names & plugins.offered(group).keys()))
        targets += [entry.value for entry in entries if entry is not None]
    return targets


def named_files(description: BenchDescription) -> list[str]:
    """Return the files that a bench names: calibrations, noise, corrected twins."""
    firmware, emulation = description.firmware, description.emulation
    every: list[Any] = []
    for group in (firmware.get("calibration"), firmware.get("noise"), emulation.get("twin")):
        every += cast(list[Any], group) if isinstance(group, list) else [group]
    return [name for name in every if isinstance(name, str)]


def _check_trust(description: BenchDescription, path: Path) -> None:
    for target in named_packages(description):
        require_package(target, path)
    for name in named_files(description):
        path_inside(path, name)


def _check_references(description: BenchDescription, where: str) -> None:
    problems: list[str] = []
    for name, spec in description.device.items():
        if spec.bus is not None and spec.bus not in description.bus:
            problems.append(f"[device.{name}.bus] no bus named '{spec.bus}'; buses are {_names(description.bus)}")
        for key in ("daq", "adc"):
            parent: str | None = getattr(spec, key)
            if parent is not None and parent not in description.device:
                problems.append(
                    f"[device.{name}.{key}] no device named '{parent}'; devices are {_names(description.device)}"
                )
        if spec.address is not None and spec.bus is None:
            problems.append(f"[device.{name}.address] an address needs a bus; add 'bus = ...'")
    problems += _duplicates(
        ((spec.bus, spec.address), name)
        for name, spec in description.device.items()
        if spec.bus is not None and spec.address is not None
    )
    if description.emulated_buses() and "provider" not in description.emulation:
        problems.append(
            f"[emulation.provider] is missing, and {_names(description.emulated_buses())} have sim:// URIs; "
            'add provider = "sim_devices.register:provider"'
        )
    if problems:
        raise BenchError("\n".join(f"{where}: {p}" for p in problems))


def _names(names: Iterable[str]) -> str:
    return ", ".join(names) or "(none)"


def _duplicates(claims: Iterable[tuple[tuple[str | None, int | None], str]]) -> list[str]:
    seen: dict[tuple[str | None, int | None], str] = {}
    problems: list[str] = []
    for claim, name in claims:
        if claim in seen:
            bus, address = claim
            problems.append(
                f"[device.{name}.address] 0x{address or 0:02x} on '{bus}' is already taken by '{seen[claim]}'; "
                "strap one of them to another address or put it on another bus"
            )
        seen.setdefault(claim, name)
    return problems


class EmulatedWorld(Protocol):
    """Defines the object that an emulation provider returns: far ends of ``sim://`` buses and physical truth."""

    def endpoint(self, bus: str) -> str | Port:
        """Return a URI for the ordinary adapters (own process, real time) or a port object (virtual time)."""
        ...

    def alive(self) -> bool: ...
    def stop(self) -> None: ...

    def stalled_ms(self, now_ns: int, within_ms: float) -> float:
        """Return the duration of a stall of the emulation, in ms; 0 if there was none.

        A stall counts that lasts at bench time ``now_ns`` or ended at most ``within_ms`` before it. It is caused by
        the host, so an answer that arrives late because of it is no fault of a device."""
        ...

    def stalls(self) -> tuple[int, float]:
        """Return the number of stalls of the emulation and the duration of the longest one in ms."""
        ...

    def truth(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]: ...


Provider = Callable[..., EmulatedWorld]


@dataclass
class Processes:
    """Holds the state of the simulated processes of a bench in virtual time, where all of them run in one process.

    ``dead`` names those that a fault test has killed: "firmware", "guardian" (until another one is started) and "new
    guardians". ``guardian_report`` returns what the guardian reports."""

    dead: set[str] = field(default_factory=set[str])
    guardian_report: Callable[[], dict[str, Any]] | None = None


@dataclass
class OpenBench:
    """Holds an opened bench: its clock, its ports by bus name and, if buses are emulated, their world."""

    file: BenchFile
    clock: Clock
    ports: dict[str, Port]
    world: EmulatedWorld | None
    runtime_dir: Path
    closers: list[Callable[[], None]] = field(default_factory=list[Callable[[], None]])
    processes: Processes = field(default_factory=Processes)

    def serial(self, bus: str) -> SerialPort:
        return cast(SerialPort, self.ports[bus])

    def i2c(self, bus: str) -> I2cBus:
        return cast(I2cBus, self.ports[bus])

    def can(self, bus: str) -> CanBus:
        return cast(CanBus, self.ports[bus])

    @property
    def virtual(self) -> bool:
        """True where bench time is emulated, paced or not."""
        return isinstance(self.clock, VirtualClock)

    def close(self) -> None:
        """Close every port, then end the emulated world. Idempotent; every port gets its turn."""
        first: Exception | None = None
        while self.closers:
            try:
                self.closers.pop()()
            except Exception as error:
                first = first or error
        if first is not None:
            raise first

    def __enter__(self) -> OpenBench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


EMULATED_CLOCKS: Mapping[Pace, Callable[[int], VirtualClock]] = {"paced": PacedClock, "virtual": VirtualClock}


def is_emulated(description: BenchDescription) -> bool:
    """Return True if every bus is emulated, so that no real output can move."""
    return len(description.emulated_buses()) == len(description.bus)


def default_pace(description: BenchDescription) -> Pace:
    """Return ``paced`` if every bus is emulated, else ``realtime``."""
    return "paced" if is_emulated(description) else "realtime"


def check_pace(bench: BenchFile, pace: Pace | None) -> Pace:
    """Return ``pace``, or the default of this bench. Raises ``BenchError`` for emulated time with a real bus."""
    default = default_pace(bench.description)
    if pace in ("paced", "virtual") and default == "realtime":
        emulated = bench.description.emulated_buses()
        real = [name for name in bench.description.bus if name not in emulated]
        raise BenchError(f"{bench.path}: virtual time needs every bus emulated, but {_names(real)} are real")
    return pace or default


@contextmanager
def open_bench(
    bench: BenchFile,
    *,
    pace: Pace | None,
    runtime_dir: Path,
    hand_file: Path | None = None,
    hand_scale: float | None = None,
    seed: int | None = None,
    truth_s: float | None = None,
    start_ns: int = 0,
    wrap: Callable[[str, Port, Clock], Port] | None = None,
) -> Generator[OpenBench, None, None]:
    """Open all buses of ``bench``; emulated ones by their provider, all others by ``hal.backends``.

    ``pace`` None is ``default_pace``.

    ``hand_file`` and ``hand_scale`` go to the emulated world, ``truth_s`` bounds the truth that it keeps;
    ``start_ns`` is where a virtual clock begins;
    ``wrap(bus, port, clock)`` may put middleware (trace, faults) around a port. Raises ``OpenFailed`` with every cause.
    """
    description = bench.description
    emulated = description.emulated_buses()
    pace = check_pace(bench, pace)
    if hand_file is not None and not emulated:
        raise BenchError(f"{bench.path}: --hand moves an emulated instrument, but this bench is all real")
    clock = EMULATED_CLOCKS[pace](start_ns) if pace != "realtime" else MonotonicClock()
    opened = OpenBench(bench, clock, {}, None, runtime_dir)
    try:
        if emulated:
            table = description.model_dump()
            table["folder"] = str(bench.path.parent)  # paths in [emulation] are relative to the bench file
            if seed is not None:
                table["emulation"]["seed"] = seed
            if truth_s is not None:
                table["emulation"]["truth_s"] = truth_s
            provider, target = _provider(bench), str(description.emulation["provider"])
            try:
                world = provider(
                    table,
                    clock=clock if isinstance(clock, VirtualClock) else None,
                    runtime_dir=runtime_dir,
                    hand_file=hand_file,
                    hand_scale=hand_scale,
                )
            except HalError:
                raise
            except Exception as error:
                if is_our_package(target):
                    raise
                raise BenchError(f"{bench.path}: [emulation.provider] '{target}' failed: {error!r}") from error
            opened.world = world
            opened.closers.append(world.stop)
        failures: list[HalError] = []
        for name, spec in description.bus.items():
            try:
                port = _open_port(name, spec, opened)
                opened.ports[name] = port if wrap is None else wrap(name, port, clock)
                opened.closers.append(opened.ports[name].close)
            except HalError as error:
                failures.append(error)
        if failures:
            raise failures[0] if len(failures) == 1 else OpenFailed(failures)
        yield opened
    finally:
        opened.close()


def _open_port(name: str, spec: SerialSpec | I2cSpec | CanSpec, bench: OpenBench) -> Port:
    from hal.backends import open_can, open_i2c, open_serial

    target: str | Port = spec.uri
    if spec.uri.startswith(SIM_SCHEME):
        assert bench.world is not None
        target = bench.world.endpoint(name)
    if not isinstance(target, str):
        return target
    match spec:
        case SerialSpec():
            return open_serial(target, baud=spec.baud)
        case I2cSpec():
            return open_i2c(target, speed_hz=spec.speed_hz)
        case CanSpec():
            return open_can(target, bitrate=spec.bitrate)


def _provider(bench: BenchFile) -> Provider:
    target = str(bench.description.emulation["provider"])
    module_name, _, attribute = target.partition(":")
    try:
        return cast(Provider, getattr(importlib.import_module(module_name), attribute))
    except (ImportError, AttributeError) as error:
        raise BenchError(f"{bench.path}: [emulation.provider] '{target}' cannot be loaded: {error}") from error
