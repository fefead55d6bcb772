"""The emulated world in the firmware's own process and in virtual time: it moves when somebody waits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hal.clock import VirtualClock
from hal.contracts import CanBus, I2cBus, SerialPort
from sim_devices.control import WorldControl
from sim_devices.faults import inject
from sim_devices.process import load_factory
from sim_devices.transports.control_socket import ControlSocket
from sim_devices.transports.lockstep import (
    USB_TRANSFER_NS,
    LockstepCanBus,
    LockstepI2cBus,
    LockstepSerialPort,
)
from sim_devices.world import Truth, World

CONTROL_NS = 20_000_000
MAX_SOCKET_PATH = 107
"""Characters in the path of a Unix socket (``sun_path``, unix(7))."""


class LockstepWorld:
    """A world in virtual time. Deterministic: the same description and the same calls give the same bits."""

    def __init__(
        self,
        description: dict[str, Any],
        clock: VirtualClock,
        hand_file: str | None,
        hand_scale: float | None,
        plant: str,
    ) -> None:
        self._clock = clock
        physics = load_factory(plant)(description, hand_file, hand_scale)
        self.world = World(description, physics, epoch_ns=clock.now_ns())
        self._bus_of = {n: d["bus"] for n, d in description["device"].items() if d.get("bus")}
        self._ports: dict[str, LockstepSerialPort | LockstepI2cBus | LockstepCanBus] = {}
        self._scheduled_ns = -1
        self._truth: Truth | None = None
        self._control: ControlSocket | None = None
        drivers = {d.get("bus"): d["driver"] for d in description["device"].values()}
        for name, face in self.world.buses.serial.items():
            latency_ns = USB_TRANSFER_NS if drivers.get(name) == "di4108" else 0
            self._ports[name] = LockstepSerialPort(name, face, clock, self._reschedule, latency_ns=latency_ns)
        for name, line in self.world.buses.i2c.items():
            self._ports[name] = LockstepI2cBus(name, line, clock, self._reschedule)
        for name, hub in self.world.buses.can.items():
            self._ports[name] = LockstepCanBus(name, hub, clock, self._reschedule)
        self._reschedule()

    def endpoint(self, bus: str) -> SerialPort | I2cBus | CanBus:
        """A port object that implements the bus's contract."""
        return self._ports[bus]

    def alive(self) -> bool:
        return self._truth is None

    def obey(self, folder: Path) -> None:
        """Take orders from ``control.sock`` in ``folder`` every ``CONTROL_NS`` of emulated time.

        They are those of a world in a process of its own. A path that is too long for a socket is left alone."""
        path = folder / "control.sock"
        if len(str(path)) > MAX_SOCKET_PATH:
            return
        control = WorldControl(self.world, self.inject, self._clock.now_ns)
        self._control = ControlSocket(path, control.answer)
        self._clock.at(self._clock.now_ns() + CONTROL_NS, self._obey_orders)

    def _obey_orders(self, t_ns: int) -> None:
        if self._control is not None:
            self._control.pump()
            self._clock.at(t_ns + CONTROL_NS, self._obey_orders)

    def stalled_ms(self, now_ns: int, within_ms: float) -> float:
        """A world in emulated time is never late."""
        return 0.0

    def stalls(self) -> tuple[int, float]:
        """Return no stalls: emulated time has none."""
        return 0, 0.0

    def stop(self) -> None:
        """Freeze the truth at the present. Idempotent."""
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._truth is None:
            self._truth = self.world.truth(self._clock.now_ns())

    def truth(self) -> Truth:
        """Return the physical truth (columns: see the provider interface). Call it after ``stop``."""
        self.stop()
        assert self._truth is not None
        return self._truth

    def inject(self, fault: str, target: str = "") -> None:
        """Do one of ``sim_devices.faults.FAULTS``; raises ``UnknownFault``."""
        unplug: dict[str, Callable[[], None]] = {name: port.unplug for name, port in self._ports.items()}
        inject(self.world, fault, target, unplug, self._bus_of, self._clock.now_ns())
        self._reschedule()

    def _reschedule(self) -> None:
        self._schedule(self.world.next_event_ns())

    def _schedule(self, due_ns: int | None) -> None:
        if due_ns is not None and (self._scheduled_ns < 0 or due_ns < self._scheduled_ns):
            self._scheduled_ns = due_ns
            self._clock.at(due_ns, self._on_due)

    def _on_due(self, t_ns: int) -> None:
        if self._truth is not None:
            return
        if t_ns >= self._scheduled_ns:
            self._scheduled_ns = -1
        self._schedule(self.world.advance_to(t_ns))
