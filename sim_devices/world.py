"""Builds the emulated world: one plant, the devices that sense and move it, and their buses.

Built from a bench description: every bus whose URI is ``sim://`` gets the devices that the description puts on it.
The world itself knows no clock and no transport. Somebody moves it with ``advance_to``; inside, everything
happens in order of time. Plant time starts at zero; ``epoch_ns`` is the bench time of that zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hal.errors import BenchError
from sim_devices.config import DaqConfig, ImuConfig, emulation_config
from sim_devices.faces import ByteFace, TimedFace, VoltageSource, Volts
from sim_devices.plant.body_motion import BodyMotion, Mount, rotation
from sim_devices.registry import REGISTRY, HasOutputs, Surroundings, find_device
from sim_devices.stimuli import Stimuli
from sim_devices.transports.can_hub import CanHub
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.wiring_faults import WiringFaults

SIM_SCHEME = "sim://"
MONITOR_RATIO = 20.0
"""Divider between a stack and the input of an amplifier monitor whose entry names no ``ratio``."""
SPIKE_V, SPIKE_NS = 0.5, 2_000_000
STRAP_SET, STRAP_RESET = 1, 2  # digital outputs 0 and 1 of the DAQ
Truth = dict[str, NDArray[np.float64] | NDArray[np.int64]]


class Plant(Protocol):
    """The part of ``sim_devices.plant.instrument.Instrument`` that the world uses. Times are plant time in ns."""

    @property
    def analog_V(self) -> Volts: ...
    @property
    def magnetometer_V(self) -> Volts: ...
    @property
    def stack_V(self) -> Volts: ...
    def advance_to(self, t_ns: int) -> None: ...
    def set_demand_V(self, channel: int, volts: float, t_ns: int) -> None: ...
    def strap(self, pulse: Literal["set", "reset"]) -> None: ...
    def sag_supply(self, part: float) -> None: ...
    def motion(self) -> BodyMotion: ...
    def truth(self) -> Truth: ...
    def truth_row(self) -> Mapping[str, NDArray[np.float64]]: ...


@dataclass
class EmulatedBuses:
    """The far ends of the ``sim://`` buses, by bus name; serial buses carry one device each."""

    serial: dict[str, ByteFace] = field(default_factory=dict[str, ByteFace])
    i2c: dict[str, I2cLine] = field(default_factory=dict[str, I2cLine])
    can: dict[str, CanHub] = field(default_factory=dict[str, CanHub])


class World:
    """Holds plant and devices. ``devices`` maps device names to wire faces, for tests and fault injection."""

    def __init__(self, description: Mapping[str, Any], plant: Plant, *, epoch_ns: int = 0) -> None:
        self.plant = plant
        self.epoch_ns = epoch_ns
        self.devices: dict[str, Any] = {}
        self.buses = EmulatedBuses()
        self.stimuli = Stimuli()
        self.faults = WiringFaults(int(description.get("emulation", {}).get("seed", 1)))
        self._timed: list[TimedFace] = []
        self._adc_wiring = np.zeros(4, dtype=np.intp)
        self._adc_volts = np.zeros(4)
        self._added_V: dict[int, Callable[[int], float]] = {}  # analog sensors of other packages, by input
        self._spike_channel: int | None = None
        self._spike_until_ns: int | None = None
        self._build(description)

    # ------------------------------------------------------------------ time

    def next_event_ns(self) -> int | None:
        """Return the time at which a device acts by itself next, or ``None`` if no device will."""
        nearest: int | None = None
        for face in self._timed:
            due = face.next_event_ns()
            if due is not None and (nearest is None or due < nearest):
                nearest = due
        return nearest

    def advance_to(self, t_ns: int) -> int | None:
        """Let everything happen that is due up to ``t_ns``, in order of time; returns ``next_event_ns()``."""
        while True:
            due_ns: int | None = None
            first: TimedFace | None = None
            for face in self._timed:
                face_ns = face.next_event_ns()
                if face_ns is not None and (due_ns is None or face_ns < due_ns):
                    due_ns, first = face_ns, face
            if first is None or due_ns is None or due_ns > t_ns:
                return due_ns
            first.advance_to(due_ns)

    def keep_up(self, t_ns: int) -> None:
        """Bring the plant to ``t_ns`` even if nothing looks at it, so that no later look has to wait for it."""
        self.plant.advance_to(t_ns - self.epoch_ns)

    def timed_faces(self) -> tuple[TimedFace, ...]:
        """Everything that acts by itself."""
        return tuple(self._timed)

    def add_timed(self, face: TimedFace) -> None:
        """A transport that acts in bench time (for example a transfer under way)."""
        self._timed.append(face)

    def truth(self, t_ns: int) -> Truth:
        """Return the physical truth up to ``t_ns``, with a column ``t_ns`` on the bench clock."""
        self.plant.advance_to(t_ns - self.epoch_ns)
        truth = dict(self.plant.truth())
        truth["t_ns"] = np.asarray(truth["t_ns"], dtype=np.int64) + self.epoch_ns
        return truth

    # ------------------------------------------------------------------ wiring between devices and plant

    def analog_V(self, t_ns: int) -> Volts:
        self.plant.advance_to(t_ns - self.epoch_ns)
        volts = self.plant.analog_V
        if self._added_V:
            volts = np.array(volts, dtype=np.float64)
            for channel, source in self._added_V.items():
                volts[channel] = source(t_ns)
        if self._spike_channel is not None:
            volts = self._spiked(volts, t_ns)
        return self.faults.inputs(volts, t_ns)

    def spike(self, channel: int) -> None:
        """The wire of DAQ input ``channel`` picks up a pulse of ``SPIKE_V`` for ``SPIKE_NS``, from the next look on."""
        self._spike_channel, self._spike_until_ns = channel, None

    def _spiked(self, volts: Volts, t_ns: int) -> Volts:
        assert self._spike_channel is not None
        if self._spike_until_ns is None:
            self._spike_until_ns = t_ns + SPIKE_NS
        if t_ns >= self._spike_until_ns:
            self._spike_channel = None
            return volts
        disturbed = np.array(volts, dtype=np.float64)
        disturbed[self._spike_channel] += SPIKE_V
        return disturbed

    def motion(self, t_ns: int) -> BodyMotion:
        self.plant.advance_to(t_ns - self.epoch_ns)
        return self.plant.motion()

    def magnetometer_V(self, t_ns: int) -> Volts:
        self.plant.advance_to(t_ns - self.epoch_ns)
        self._adc_volts[self._adc_wiring[:3]] = self.plant.magnetometer_V
        return self._adc_volts

    def stack_monitor(self, channels: Sequence[int], ratio: float) -> VoltageSource:
        """Return the inputs of an ADC whose ``channels`` hang behind dividers by ``ratio`` on the terminals of the
        three stacks."""
        volts = np.zeros(4)

        def at(t_ns: int) -> Volts:
            self.plant.advance_to(t_ns - self.epoch_ns)
            for channel, stack_V in zip(channels, self.plant.stack_V, strict=True):
                volts[channel] = stack_V / ratio
            return volts

        return at

    def amplify(self, channel: int, volts: float, t_ns: int) -> None:
        if channel < 3:
            self.demand(channel, volts * self.gain, t_ns)

    def demand(self, channel: int, volts: float, t_ns: int) -> None:
        if channel < 3:
            self.plant.set_demand_V(channel, self.faults.demand(channel, volts), t_ns - self.epoch_ns)

    def break_actuator(self, channel: int, kind: str, amount: float | None, t_ns: int) -> None:
        """Begin a fault of one amplifier channel; the stack sees it at once."""
        volts = self.faults.actuator(channel, kind, amount, t_ns)
        self.plant.set_demand_V(channel, volts, t_ns - self.epoch_ns)

    def stroke_um(self, axis: int, t_ns: int) -> float:
        self.plant.advance_to(t_ns - self.epoch_ns)
        return float(self.plant.truth_row()["stroke_m"][axis]) * 1e6

    def switch_strap(self, switches: int, t_ns: int) -> None:
        self.plant.advance_to(t_ns - self.epoch_ns)
        if switches & STRAP_SET:
            self.plant.strap("set")
        elif switches & STRAP_RESET:
            self.plant.strap("reset")

    # ------------------------------------------------------------------ construction

    def _build(self, description: Mapping[str, Any]) -> None:
        emulation = description.get("emulation", {})
        self.gain = emulation_config({"emulation": {}, **description}).amplifier.gain
        self.monitors = {
            device.get("adc"): (device.get("channels", (0, 1, 2)), float(device.get("ratio", MONITOR_RATIO)))
            for device in description["device"].values()
            if device["driver"] == "amplifier_monitor"
        }
        self.daq = DaqConfig.model_validate(emulation.get("daq", {}))
        self.seed, self._imus = int(emulation.get("seed", 1)), emulation.get("imu", {})
        self.presses = (emulation.get("endoscope") or {}).get("presses", ())
        self.baud = {name: bus.get("baud", 115_200) for name, bus in description["bus"].items()}
        for name, bus in description["bus"].items():
            if not str(bus["uri"]).startswith(SIM_SCHEME):
                continue
            if bus["kind"] == "i2c":
                self.buses.i2c[name] = I2cLine(bus.get("speed_hz", 400_000))
            elif bus["kind"] == "can":
                self.buses.can[name] = CanHub(bus.get("bitrate", 500_000))
                self._timed.append(self.buses.can[name])
        for name, device in description["device"].items():
            if device.get("daq") is not None:
                self._add(name, device, "daq")
            bus = description["bus"].get(device.get("bus") or "", {})
            if not str(bus.get("uri", "")).startswith(SIM_SCHEME):
                continue
            if not self._add(name, device, bus["kind"]):
                raise BenchError(
                    f"[device.{name}.driver] there is no emulated '{device['driver']}'; "
                    f"emulated are {', '.join(REGISTRY.targets())}, or give its bus a real URI"
                )
            if device["driver"] == "ads1115":
                self._wire_magnetometer(name, description)
        for name, bus in description["bus"].items():
            if bus["kind"] == "serial" and str(bus["uri"]).startswith(SIM_SCHEME) and name not in self.buses.serial:
                raise BenchError(f"[bus.{name}] is emulated but no device is on it; remove it or add a device")

    def _add(self, name: str, device: Mapping[str, Any], kind: str) -> bool:
        """Add the emulated device ``name``; False if there is none for its driver. A driver on a DAQ then shows the
        plant's volts."""
        device_record = find_device(device["driver"])
        if device_record is None:
            return False
        if device_record.build is not None:
            device_record.build(self, name, device)
            return True
        assert device_record.make is not None
        motion = self.motion if kind == "daq" else self.stimuli.motion(name, self.motion, Mount())
        senses = motion, self.analog_V, self.switch_strap, self.amplify
        made = device_record.make(Surroundings(name, device, self.seed, self.epoch_ns, *senses))
        if kind == "daq":
            self._added_V.update(made)
            return True
        {"serial": self.add_serial, "i2c": self.add_chip, "can": self.add_can}[kind](name, device, made)
        if isinstance(made, HasOutputs):
            self.stimuli.outputs(name, lambda: made.output_V, len(made.output_V))
            self.rest_at([volts * self.gain for volts in made.output_V])
        return True

    def add_serial(self, name: str, device: Mapping[str, Any], face: Any) -> None:
        """Put ``face`` at the far end of its serial line. ``BenchError`` where another device is."""
        bus = device["bus"]
        if bus in self.buses.serial:
            raise BenchError(f"[device.{name}.bus] '{bus}' already has a device; a serial line carries one")
        self.buses.serial[bus] = face
        self.devices[name] = face
        self._timed.append(face)

    def add_chip(self, name: str, device: Mapping[str, Any], face: Any) -> None:
        """Put ``face`` on its I2C bus. ``BenchError`` for a missing or taken address."""
        if device.get("address") is None:
            raise BenchError(f"[device.{name}] has no address; a part on an I2C bus needs one, such as address = 0x0C")
        try:
            self.buses.i2c[device["bus"]].attach(int(device["address"]), face)
        except ValueError as error:
            raise BenchError(f"[device.{name}.address] {error}") from error
        self.devices[name] = face
        self._timed.append(face)

    def add_can(self, name: str, device: Mapping[str, Any], node: Any) -> None:
        """Put ``node`` on its CAN bus."""
        self.buses.can[device["bus"]].attach(node)
        self.devices[name] = node

    def rest_at(self, demand_V: Sequence[float]) -> None:
        """Start the amplifier from ``demand_V``, the output of the device at power-up."""
        for channel in range(3):
            self.plant.set_demand_V(channel, demand_V[channel], 0)

    def specimen(self, name: str) -> dict[str, Any]:
        """Keywords of the IMU that the bench file calls ``name``."""
        wish = ImuConfig.model_validate(self._imus.get(name, {}))
        mount = Mount(np.array(wish.position_mm) * 1e-3, rotation(wish.turn_deg))
        return {"seed": self.seed, "name": name, "mount": mount, "errors": wish.errors, "noise": wish.noise}

    def _wire_magnetometer(self, adc: str, description: Mapping[str, Any]) -> None:
        """Bridge outputs x, y, z go to the inputs that the bench file names."""
        for device in description["device"].values():
            if device["driver"] == "hmc2003" and device.get("adc") == adc:
                self._adc_wiring[:3] = device.get("channels", (0, 1, 2))
