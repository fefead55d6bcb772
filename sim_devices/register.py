"""The emulation provider that bench files name: ``provider = "sim_devices.register:provider"``.

With a virtual clock the world lives in this process and moves in lockstep with whoever waits; without one it is a
process of its own in real time (``sim_devices.process``), reached through the ordinary adapters of ``hal``.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hal.clock import VirtualClock
from hal.contracts import CanBus, I2cBus, SerialPort
from hal.errors import BenchError, DeviceNotFound, Disconnected, HalTimeout
from sim_devices.faults import inject
from sim_devices.plant_factory import emulation_config
from sim_devices.process import load_factory
from sim_devices.transports.lockstep import (
    USB_TRANSFER_NS,
    LockstepCanBus,
    LockstepI2cBus,
    LockstepSerialPort,
)
from sim_devices.world import Truth, World

PLANT = "sim_devices.plant_factory:make_plant"
START_S = 180.0  # the first start of all compiles the plant
STOP_S = 20.0


def provider(
    description: dict[str, Any],
    *,
    clock: VirtualClock | None,
    runtime_dir: Path,
    hand_file: Path | None,
    hand_scale: float | None,
    plant: str = PLANT,
) -> LockstepWorld | ProcessWorld:
    """The emulated side of a bench. ``plant`` names the factory of the physics; only tests need another one.

    Raises ``BenchError`` for a wrong ``[emulation]`` table or a device that cannot be emulated.
    """
    emulation_config(description)
    file = None if hand_file is None else str(Path(hand_file).resolve())
    if clock is not None:
        return LockstepWorld(description, clock, file, hand_scale, plant)
    return ProcessWorld(description, Path(runtime_dir), file, hand_scale, plant)


class LockstepWorld:
    """A world in virtual time. Deterministic: the same description and the same calls give the same bits."""

    def __init__(
        self,
        description: dict[str, Any],
        clock: VirtualClock,
        hand_file: str | None,
        hand_scale: float | None,
        plant: str = PLANT,
    ) -> None:
        self._clock = clock
        physics = load_factory(plant)(description, hand_file, hand_scale)
        self.world = World(description, physics, epoch_ns=clock.now_ns())
        self._bus_of = {n: d["bus"] for n, d in description["device"].items() if d.get("bus")}
        self._ports: dict[str, LockstepSerialPort | LockstepI2cBus | LockstepCanBus] = {}
        self._scheduled_ns = -1
        self._truth: Truth | None = None
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

    def stop(self) -> None:
        """Freeze the truth at the present. Idempotent."""
        if self._truth is None:
            self._truth = self.world.truth(self._clock.now_ns())

    def truth(self) -> Truth:
        """Physical truth; see the provider interface for columns. After ``stop``."""
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


class ProcessWorld:
    """A world in real time, in a process of its own. ``runtime_dir`` holds its sockets, log and truth."""

    def __init__(
        self,
        description: dict[str, Any],
        runtime_dir: Path,
        hand_file: str | None,
        hand_scale: float | None,
        plant: str = PLANT,
    ) -> None:
        runtime_dir.mkdir(parents=True, exist_ok=True)
        self._dir = Path(tempfile.mkdtemp(prefix="world-", dir=runtime_dir))
        # a Unix socket's path has at most 107 characters, however deep the runtime directory is
        self._sockets = Path(tempfile.mkdtemp(prefix="micron-"))
        job = {
            "description": description,
            "runtime_dir": str(self._dir),
            "socket_dir": str(self._sockets),
            "parent": os.getpid(),
            "hand_file": hand_file,
            "hand_scale": hand_scale,
            "plant": plant,
        }
        job_path = self._dir / "job.json"
        job_path.write_text(json.dumps(job), encoding="utf-8")
        self._log = self._dir / "world.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sim_devices.process", str(job_path)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=Path(__file__).resolve().parents[1],
            )
        self._endpoints = self._await_endpoints()

    @property
    def pid(self) -> int:
        """Of the world's process, for tests that kill it."""
        return self._process.pid

    def endpoint(self, bus: str) -> str:
        """URI of ``bus`` for the ordinary adapters."""
        return self._endpoints[bus]

    def alive(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        """End the process; when this returns the truth is on disk. Idempotent."""
        if self.alive():
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._sockets, ignore_errors=True)

    def truth(self) -> Truth:
        """Physical truth. After ``stop``. Raises ``Disconnected`` when the process was killed before it could write."""
        path = self._dir / "truth.npz"
        if not path.exists():
            raise Disconnected(f"the emulated world was killed and left no truth; its log: {self._tail()}")
        with np.load(path) as data:
            return {name: data[name] for name in data.files}

    def statistics(self) -> dict[str, float]:
        """After ``stop``: ``worst_late_us`` (how late the world ran at worst), ``turns`` of its loop, ``cpu_s``."""
        path = self._dir / "world.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def inject(self, fault: str, target: str = "") -> None:
        """Do one of ``sim_devices.faults.FAULTS`` in the running process; ``ValueError`` says why not."""
        with tempfile.TemporaryDirectory(prefix="micron-") as folder:
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            with contextlib.closing(sock):
                sock.bind(str(Path(folder) / "reply.sock"))
                sock.settimeout(5.0)
                try:
                    sock.connect(str(self._sockets / "control.sock"))
                    sock.send(json.dumps({"fault": fault, "target": target}).encode())
                    answer = json.loads(sock.recv(4096))
                except TimeoutError as error:
                    raise HalTimeout("the emulated world does not answer on its control socket") from error
                except OSError as error:
                    raise Disconnected("the emulated world is gone") from error
        if not answer["ok"]:
            raise ValueError(answer["error"])

    def _await_endpoints(self) -> dict[str, str]:
        path = self._dir / "endpoints.json"
        deadline = time.monotonic() + START_S
        while not path.exists():
            if not self.alive():
                shutil.rmtree(self._sockets, ignore_errors=True)
                refusal = self._dir / "error.txt"
                if refusal.exists():
                    raise BenchError(refusal.read_text(encoding="utf-8"))
                raise BenchError(f"the emulated world did not start: {self._tail()}")
            if time.monotonic() > deadline:
                self.stop()
                raise DeviceNotFound(f"the emulated world was not ready in {START_S:.0f} s: {self._tail()}")
            time.sleep(0.01)
        return json.loads(path.read_text(encoding="utf-8"))["endpoints"]

    def _tail(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "(empty log)"
