"""Opens and probes the devices of a bench description. It is the only place that joins drivers to buses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from drivers.adc.ads1115 import Ads1115
from drivers.amplifier_monitor import AmplifierMonitor
from drivers.base import wait_s
from drivers.bus_use import bus_uses
from drivers.can_frames import HostHeartbeat
from drivers.can_telemetry import CanTelemetry
from drivers.dbc import load_database
from drivers.hmc2003 import Hmc2003
from drivers.options import Ads1115Options, Adxl203Options, AmplifierMonitorOptions, DaqOptions, Hmc2003Options
from drivers.output_guard import OutputGuard
from drivers.piezo.dac_output import DacOutput
from drivers.polling import Polling, polling_of
from drivers.registry import Role, find_driver, open_device
from drivers.specs import check_devices
from firmware_py.run.opening import Probes
from hal.bench import BenchDescription, DeviceSpec, OpenBench
from hal.contracts import AnalogInputScan, AnalogOutput, CanBus
from hal.errors import BenchError, HalError, name_device
from hal.middleware.share import SharedCan
from hal.types import ScanConfig, ScanInfo

ACCELEROMETERS = (("acc1", "x"), ("acc1", "z"), ("acc2", "y"), ("acc2", "z"), ("acc3", "x"), ("acc3", "y"))
"""Lists devices and axes in the firmware's sensor order a1x, a1z, a2y, a2z, a3x, a3y (Ang 2004 (2.34))."""


class Daq(AnalogInputScan, Protocol):
    """Describes a scanning DAQ whose digital outputs fire the magnetometer's strap."""

    name: str

    def probe(self) -> str: ...
    def write_digital(self, bits: int) -> None: ...


class ProbedOutput(AnalogOutput, Protocol):
    """Describes an output that can identify itself."""

    def probe(self) -> str: ...


NOT_POLLED = Polling()


@dataclass
class Devices:
    """Holds the instrument's devices, configured and not yet running. ``identities`` is what each probe found.

    ``scan_labels`` names the six accelerometer axes, supply and temperature for people. ``verify_output`` reads the
    amplifier back in less than a tick and says what differs from the last command, where the device can do that.
    ``monitor`` measures what arrives at the stacks, where the bench has wires for it. ``polling``: polling rate of each
    device; ``bus_us``: time that a transaction of each task takes on the wires, us.
    """

    daq: Daq
    scan: ScanInfo
    amplifier: AnalogOutput
    magnetometer: Hmc2003 | None
    telemetry: CanTelemetry | None
    sensing_table: dict[str, Any]
    scan_labels: tuple[str, ...]
    verify_output: Callable[[], str] | None = None
    monitor: AmplifierMonitor | None = None
    identities: dict[str, str] = field(default_factory=dict[str, str])
    polling: Polling = NOT_POLLED
    bus_us: Mapping[str, float] = field(default_factory=dict[str, float])


def open_devices(bench: OpenBench, options: Mapping[str, Any] | None = None) -> Devices:
    """Make and probe every device of the bench. ``options``: the checked keys of a plan, which are not parsed again.

    Raises ``BenchError`` when the description cannot be this instrument, ``OpenFailed`` with every probe that
    did not answer.
    """
    where = str(bench.file.path)
    description = bench.file.description
    options = check_devices(description, where) if options is None else options
    daq_name = _only(description, "daq", "DAQ", where)
    piezo_name = _only(description, "output", "piezo output", where)
    probes = Probes()
    probe = probes.probe
    daq: Daq = open_device(bench, daq_name, options[daq_name])
    probe(daq_name, daq.probe)
    can = _CanBuses(bench)
    amplifier: ProbedOutput = open_device(bench, piezo_name, options[piezo_name], can=can)
    probe(piezo_name, amplifier.probe)
    magnetometer = _open_magnetometer(bench, options, daq, probes)
    monitor = _open_monitor(bench, options, amplifier, probes)
    telemetry = _open_telemetry(bench, can)
    for name, spec in description.device.items():
        if spec.bus is not None and find_driver(spec.driver).role == "sensor":
            probe(name, lambda name=name: open_device(bench, name, options[name]).probe())
    probes.raise_failures()
    daq_options: DaqOptions = options[daq_name]
    scan = daq.configure(
        ScanConfig(daq_options.rate_hz, daq_options.channels, (daq_options.range_V,) * len(daq_options.channels))
    )
    sensing = sensing_table(options, scan.channels, scan.rate_hz, scan.lsb_V[0], where)
    if magnetometer is not None:
        _measure_offset(magnetometer, bench)
        sensing["magnetometer_bias_V"] = magnetometer.offset_V.tolist()
    verify = amplifier.verify if isinstance(amplifier, DacOutput) else None
    polling, bus_us = bus_plan(description, options)
    return Devices(
        daq, scan, amplifier, magnetometer, telemetry, sensing, _scan_labels(options), verify, monitor,
        probes.identities, polling=polling, bus_us=bus_us,
    )  # fmt: skip


def _open_magnetometer(bench: OpenBench, options: Mapping[str, Any], daq: Daq, probes: Probes) -> Hmc2003 | None:
    if (name := _at_most_one(bench, "hmc2003")) is None:
        return None
    own: Hmc2003Options = options[name]
    adc = _probed_adc(bench, name, options, probes)
    return Hmc2003(adc, daq, bench.clock, own.channels, name=name)


def _open_monitor(
    bench: OpenBench, options: Mapping[str, Any], amplifier: AnalogOutput, probes: Probes
) -> AmplifierMonitor | None:
    if (name := _at_most_one(bench, "amplifier_monitor")) is None:
        return None
    own: AmplifierMonitorOptions = options[name]
    adc = _probed_adc(bench, name, options, probes)
    guard = _guard_of(amplifier, str(bench.file.path), name)
    return AmplifierMonitor(
        adc, guard, bench.clock, own.channels, ratio=own.ratio, tolerance_V=own.tolerance_V,
        settle_s=own.settle_ms * 1e-3, change_V=own.change_V, name=name,
    )  # fmt: skip


def _open_telemetry(bench: OpenBench, can: _CanBuses) -> CanTelemetry | None:
    if (name := _at_most_one(bench, "can_telemetry")) is None:
        return None
    bus = _bus(bench.file.description.device[name])
    frames = can.view(bus, CanTelemetry.receives())
    return CanTelemetry(frames, bench.clock, heartbeat=can.heartbeat(bus), name=name)


def _measure_offset(magnetometer: Hmc2003, bench: OpenBench) -> None:
    """Measure the bridge's present offset by set and reset pulses. A DAQ that scans takes no commands: before it."""
    try:
        for _ in magnetometer.measure_offset():
            wait_s(bench.clock, 0.001)
    except HalError as error:
        raise name_device(error, magnetometer.name) from error.__cause__


def _scan_labels(options: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a name for each used input of a scan, with its DAQ input, for messages."""
    labels = [f"{device}.{axis} (DAQ input {options[device].channels[axis]})" for device, axis in _axes(options)]
    others = [name for name in ("supply", "temperature") if name in options]
    return (*labels, *(f"{name} (DAQ input {options[name].channel})" for name in others))


def bus_plan(description: BenchDescription, options: Mapping[str, Any]) -> tuple[Polling, dict[str, float]]:
    """Return the polling rates of the devices, and the time one transaction of each task takes on the wires, us."""
    polling, _ = polling_of(description, options)
    uses = bus_uses(description, options, polling)
    return polling, {use.task: use.bus_us for use in uses if use.task}


def _only(description: BenchDescription, role: Role, what: str, where: str) -> str:
    found = [name for name, spec in description.device.items() if find_driver(spec.driver).role == role]
    if len(found) != 1:
        raise BenchError(f"{where}: [device] the instrument needs exactly one {what}, this bench has {len(found)}")
    return found[0]


def _at_most_one(bench: OpenBench, driver: str) -> str | None:
    """Return the name of the device with this driver, None without one. Raises ``BenchError`` for several."""
    found = list(bench.file.description.devices_with(driver))
    if len(found) > 1:
        raise BenchError(
            f"{bench.file.path}: [device] the instrument reads one {driver}, this bench has {', '.join(found)}; "
            "remove all but one"
        )
    return found[0] if found else None


def _probed_adc(bench: OpenBench, reader: str, options: Mapping[str, Any], probes: Probes) -> Ads1115:
    """Open and probe the ADC through which the device ``reader`` is read."""
    devices = bench.file.description.device
    name = devices[reader].adc or ""
    own: Ads1115Options = options[name]
    spec = devices[name]
    bus = bench.i2c(_bus(spec))
    adc = Ads1115(bus, bench.clock, spec.address or 0x48, full_scale_V=own.full_scale_V, name=name)
    probes.probe(name, adc.probe)
    return adc


def _guard_of(amplifier: AnalogOutput, where: str, name: str) -> OutputGuard:
    if not isinstance(amplifier, DacOutput):
        raise BenchError(
            f"{where}: [device.{name}] compares commands of a DAC; '{amplifier.name}' measures its outputs "
            "itself or cannot be compared; remove the monitor"
        )
    return amplifier.guard


def _bus(spec: DeviceSpec) -> str:
    assert spec.bus is not None  # checked by drivers.specs
    return spec.bus


class _CanBuses:
    """Lets several drivers share one CAN bus: each sees its own frames, and the host has one heartbeat."""

    def __init__(self, bench: OpenBench) -> None:
        self._bench = bench
        self._shared: dict[str, SharedCan] = {}
        self._heartbeats: dict[str, HostHeartbeat] = {}

    def view(self, bus: str, can_ids: Iterable[int]) -> CanBus:
        if bus not in self._shared:
            self._shared[bus] = SharedCan(self._bench.can(bus))
        return self._shared[bus].view(can_ids)

    def heartbeat(self, bus: str) -> HostHeartbeat:
        if bus not in self._heartbeats:
            self._heartbeats[bus] = HostHeartbeat(self._bench.can(bus), self._bench.clock, load_database())
        return self._heartbeats[bus]


def _axes(options: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return the six axes of the instrument, then those of further accelerometers in the order of their names."""
    first = {device for device, _ in ACCELEROMETERS}
    others = sorted(name for name, o in options.items() if isinstance(o, Adxl203Options) and name not in first)
    return (*ACCELEROMETERS, *((name, axis) for name in others for axis in sorted(options[name].channels)))


def sensing_table(
    options: Mapping[str, Any], channels: Sequence[int], rate_hz: float, lsb_V: float, where: str
) -> dict[str, Any]:
    """Return the part of [firmware.sensing] that the wiring decides: which column of a scan of ``channels`` carries
    which sensor. Raises ``BenchError`` for a missing sensor."""
    position = {channel: column for column, channel in enumerate(channels)}
    try:
        axes = _axes(options)
        accelerometers = [position[options[device].channels[axis]] for device, axis in axes]
        more = len(axes) > len(ACCELEROMETERS)  # then inputs are scarce: supply and temperature may be missing
        supply, temperature = (
            None if more and name not in options else position[options[name].channel]
            for name in ("supply", "temperature")
        )
    except KeyError as error:
        raise BenchError(
            f"{where}: [device] {error} is missing: the instrument needs acc1 (x, z), acc2 (y, z), acc3 (x, y), "
            "supply and temperature"
        ) from error
    return {
        "tick_hz": rate_hz,
        "lsb_V": lsb_V,
        "channels": accelerometers,
        "supply_channel": supply,
        "temperature_channel": temperature,
    }
