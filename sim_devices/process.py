"""The emulated world as a process of its own, in real time: ``python -m sim_devices.process JOB.json``.

The job file (written by ``sim_devices.process_world``) holds the bench description and where to put things. The
process serves each serial bus on a pty (and, on request, a TCP port), each I2C bus and each CAN bus on a Unix socket
(a CAN bus with ``sim://NAME?via=slcan`` as a serial adapter on a pty, and for programs of others on UDP multicast or an
interface of the kernel) and writes their URIs to ``endpoints.json`` when it is ready. It obeys orders on
``control.sock`` (``sim_devices.control``); on ``END`` or when its parent is gone it writes ``truth.npz`` and ends.
SIGINT and SIGTERM are not for it: who sends them to all processes of a run ends the firmware, which needs its devices
until the outputs are at neutral.

One loop, absolute deadlines: it wakes for bytes, for the next thing a device does, and at least every
millisecond. For a firmware in real time device clocks never stretch: after a stall every scan that was due is made up,
a few at a time so that a host that does read is not blamed for our lateness; ``world.json`` tells the worst lateness.
For programs of others (``micron emulate``) emulated time waits instead, and counts for how long.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np

from hal.clock import MonotonicClock
from hal.errors import HalError
from sim_devices.config import ServeConfig
from sim_devices.control import WorldControl
from sim_devices.faces import ByteFace
from sim_devices.faults import inject
from sim_devices.lateness import Lateness
from sim_devices.linger import END, Linger
from sim_devices.transports.can_carrier import CanCarrier, free_udp_port, on_multicast, on_socketcan
from sim_devices.transports.can_socket import CanSocketServer
from sim_devices.transports.control_socket import ControlSocket
from sim_devices.transports.i2c_socket import I2cSocketServer
from sim_devices.transports.pty_carrier import PtyCarrier
from sim_devices.transports.slcan_adapter import SlcanAdapter
from sim_devices.transports.tcp_line import TcpLine
from sim_devices.world import Plant, World

POLL_NS = 1_000_000
CATCH_UP_NS = 8_000_000
PARENT_CHECK_NS = 100_000_000
COUNT_DOWN_NS = 50_000  # a sleeping process wakes so much too late on a virtual machine, and what is due meanwhile
SOON_NS = 100_000
"""Longest time that taking a request or ending a transfer keeps the process from what is due next."""
PRIORITY = 75
"""Below the loop's, so that the emulation never preempts what it is there to test, and above that of the kernel's
threads for ttys (``firmware_py.machine.workers``): one that this process wakes with a scan would take its processor and
drive it to the one on which the loop is about to wake."""
PR_SET_PDEATHSIG = 1
LONGEST_STEP_S = 60.0
"""Longest step of a paused clock: clients and the next order wait until it is computed."""


class PausableClock(MonotonicClock):
    """The machine's monotonic time less the time during which it was paused."""

    def __init__(self) -> None:
        super().__init__()
        self.behind_ns = 0
        """Time in ns by which this clock is behind the machine's, up to the last pause."""
        self.stretched_ns = 0
        """The part of it that the host was too slow for."""
        self._held_ns: int | None = None

    def now_ns(self) -> int:
        return super().now_ns() - self.behind_ns if self._held_ns is None else self._held_ns

    @property
    def is_paused(self) -> bool:
        """The clock stands still."""
        return self._held_ns is not None

    def pause(self) -> None:
        """Stand still. Idempotent."""
        self._held_ns = self.now_ns()

    def resume(self) -> None:
        """Go on from where the clock stands. Idempotent."""
        if self._held_ns is not None:
            self.behind_ns = super().now_ns() - self._held_ns
            self._held_ns = None

    def fall_behind(self, late_ns: int) -> None:
        """Go back by the time that the host had no processor for the world. Not while paused."""
        self.behind_ns += late_ns
        self.stretched_ns += late_ns

    def advance(self, seconds: float) -> None:
        """Let a clock that is paused go on by ``seconds``. ``ValueError`` when it is not paused."""
        if self._held_ns is None or not 0.0 <= seconds <= LONGEST_STEP_S:
            raise ValueError(f"time goes on by 0 to {LONGEST_STEP_S:.0f} s at a time, after it was paused")
        self._held_ns += round(seconds * 1e9)


class WorldProcess:
    """The loop and everything it serves."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._runtime_dir = Path(job["runtime_dir"])
        sockets = Path(job["socket_dir"])
        self._parent = int(job["parent"])
        description = job["description"]
        self._clock = PausableClock()
        serve = ServeConfig.model_validate(description["emulation"].get("serve", {}))
        self.serves_others = "serve" in description["emulation"]
        """The world is there for programs of any kind (``micron emulate``), and takes no processor from them."""
        make_plant = load_factory(job["plant"])
        # a world that nobody sees: the time in which its devices compile is none that the real one must make up
        warm_up(World(description, make_plant(description, job["hand_file"], job["hand_scale"])).plant)
        plant = make_plant(description, job["hand_file"], job["hand_scale"])
        self.world = World(description, plant, epoch_ns=self._clock.now_ns())
        self._bus_of = {n: d["bus"] for n, d in description["device"].items() if d.get("bus")}
        lines = self.world.buses.serial
        self._tcp: dict[str, TcpLine] = {}
        if serve.tcp_port is not None:
            ports = range(serve.tcp_port, serve.tcp_port + len(lines)) if serve.tcp_port else [0] * len(lines)
            self._tcp = {name: TcpLine(face, port) for (name, face), port in zip(lines.items(), ports, strict=True)}
        self._ptys = {name: PtyCarrier(cast(ByteFace, self._tcp.get(name, face))) for name, face in lines.items()}
        self._i2c = {
            name: I2cSocketServer(line, sockets / f"{name}.sock") for name, line in self.world.buses.i2c.items()
        }
        slcan = {n for n, bus in description["bus"].items() if str(bus["uri"]).endswith("?via=slcan")}
        hubs = self.world.buses.can
        self._slcan = {n: PtyCarrier(SlcanAdapter(hub)) for n, hub in hubs.items() if n in slcan}
        open_hubs = {n: hub for n, hub in hubs.items() if n not in slcan}
        interfaces = dict(zip(open_hubs, serve.can, strict=False))
        self._can: dict[str, CanCarrier] = {}
        self._can_sockets: dict[str, CanSocketServer] = {}
        for n, hub in open_hubs.items():
            if n in interfaces:
                self._can[n] = on_socketcan(hub, interfaces[n])
            elif self.serves_others:
                self._can[n] = on_multicast(hub, free_udp_port())
            else:
                self._can_sockets[n] = CanSocketServer(hub, sockets / f"{n}.sock")
        self._all_ptys = [*self._ptys.values(), *self._slcan.values()]
        speaks = [id(face) for face in self.world.buses.serial.values()]
        self._devices = [(face, id(face) in speaks) for face in self.world.timed_faces()]
        for server in self._i2c.values():
            self.world.add_timed(server)
        control = WorldControl(self.world, self._strike, lambda: self._now_ns, self._clock)
        self._control = ControlSocket(sockets / "control.sock", control.answer)
        self._stop = False
        self._linger = Linger()
        self._worst_late_ns = 0
        self._lateness = Lateness(self._runtime_dir)
        self._turns = 0
        self.count_down_ns = 0
        """The end of a transfer, and what a device will say on a serial line, is waited for in a loop from so long
        before: by a process with a real-time policy."""
        self._now_ns = self.world.epoch_ns

    def request_stop(self, *_: object) -> None:
        self._stop = True

    def outlive_parent(self, *_: object) -> None:
        """The firmware is gone; a device does not end with it, and a guardian may still want it."""
        self._linger.begin(self._clock.now_ns())

    def tcp_ports(self) -> dict[str, int]:
        """TCP port of each serial bus that has one."""
        return {name: line.port for name, line in self._tcp.items()}

    def endpoints(self) -> dict[str, str]:
        """Return the URI of each bus for the adapters of hal."""
        uris = {name: f"serial://{pty.path}" for name, pty in self._ptys.items()}
        uris |= {name: f"slcan://{pty.path}" for name, pty in self._slcan.items()}
        uris |= {name: f"unix-i2c://{server.path}" for name, server in self._i2c.items()}
        return uris | {name: can.uri for name, can in (self._can | self._can_sockets).items()}

    def run(self) -> None:
        """Serve until asked to stop, then write what happened."""
        self._turn()  # makes up for what starting took; from here on lateness counts
        self._worst_late_ns = 0
        check_ns = 0
        while not self._stop:
            ready = self._wait()
            for fileno in ready:
                self._take_transfer(fileno)
            self._speak_first()
            self._turn()  # events that were due before the request happen before it
            for fileno in ready:
                self._on_readable(fileno)
            if self._now_ns >= check_ns:
                check_ns = self._now_ns + PARENT_CHECK_NS
                if os.getppid() != self._parent:
                    self.outlive_parent()
                if self._linger.is_over(self._now_ns, any(server.has_clients for server in self._i2c.values())):
                    break
        self._finish()

    def _wait(self) -> list[int]:
        """Filenos with something to read, or none when the next thing is due."""
        now_ns = self._clock.now_ns()
        deadline_ns, early_ns = now_ns + POLL_NS, 0
        for face, count_down in self._devices:
            due_ns = face.next_event_ns()
            if due_ns is not None and due_ns < deadline_ns:
                deadline_ns, early_ns = due_ns, self.count_down_ns if count_down else 0
        for server in self._i2c.values():
            due_ns = server.reply_ns()
            if due_ns is not None and due_ns < deadline_ns:
                deadline_ns, early_ns = due_ns, self.count_down_ns
        watched = [pty.fileno() for pty in self._all_ptys if pty.fileno() >= 0]
        for server in self._i2c.values():
            watched += server.filenos()
        watched += [can.fileno() for can in self._can.values()]
        for can in self._can_sockets.values():
            watched += can.filenos()
        for line in self._tcp.values():
            watched += line.filenos()
        watched += self._control.filenos()
        if self._clock.is_paused:  # nothing becomes due, and a time that is waited for in a loop would never come
            return select.select(watched, (), (), POLL_NS * 1e-9)[0]
        # select, not epoll: its timeout has a resolution of 1 us instead of 1 ms
        if ready := select.select(watched, (), (), max(0, deadline_ns - early_ns - now_ns) * 1e-9)[0]:
            return ready
        if early_ns:
            self._be_there_at(deadline_ns)
        return []

    def _speak_first(self) -> None:
        """Be there for what a device will say on a serial line at once, before the world catches up with the present:
        a scan is not late because a slow device was asked for something just before."""
        if not self.count_down_ns or self._clock.is_paused:
            return
        said_ns = [due_ns for face, speaks in self._devices if speaks and (due_ns := face.next_event_ns()) is not None]
        if said_ns and min(said_ns) < self._clock.now_ns() + SOON_NS:
            self._be_there_at(min(said_ns))

    def _be_there_at(self, deadline_ns: int) -> None:
        """Compute the events of ``deadline_ns`` in advance, wait for that time, then only send their results.

        No request is read in the meantime."""
        for server in self._i2c.values():
            server.hold()
        self.world.advance_to(deadline_ns)
        self.world.keep_up(deadline_ns)
        self._now_ns = deadline_ns
        while self._clock.now_ns() < deadline_ns:
            pass
        for server in self._i2c.values():
            server.release()
        for pty in self._all_ptys:
            pty.send()

    def _turn(self) -> None:
        """Bring world and transports to the present."""
        self._turns += 1
        self._lateness.turn(self._clock.now_ns())
        while True:
            for pty in self._all_ptys:
                pty.refresh()
            due_ns = self.world.next_event_ns()
            now_ns = self._clock.now_ns()
            late_ns = 0 if due_ns is None else max(0, now_ns - due_ns)
            self._worst_late_ns = max(self._worst_late_ns, late_ns)
            self._now_ns = now_ns if due_ns is None else min(now_ns, due_ns + CATCH_UP_NS)
            self.world.advance_to(self._now_ns)
            for pty in self._all_ptys:
                pty.send()
            if late_ns > CATCH_UP_NS and self.serves_others and not self._clock.is_paused:
                # a host that is too slow makes emulated time slow: programs of others must not wait for all of it
                self._clock.fall_behind(late_ns - CATCH_UP_NS)
                late_ns = CATCH_UP_NS
            if late_ns <= CATCH_UP_NS:
                self.world.keep_up(self._now_ns)
                return
            time.sleep(0.0001)  # let the host drain what it was late for through no fault of its own

    def _take_transfer(self, fileno: int) -> None:
        """Handle a request to an I2C bus. It carries the time at which it was made, which may lie ahead of the world's
        time."""
        for server in self._i2c.values():
            if fileno in server.filenos():
                server.on_readable(fileno, self._now_ns, self._clock.now_ns(), self._clock.behind_ns)
                return

    def _on_readable(self, fileno: int) -> None:
        for can in self._can.values():
            if fileno == can.fileno():
                can.pump(self._now_ns)
                return
        for can_socket in self._can_sockets.values():
            if fileno in can_socket.filenos():
                can_socket.pump(fileno, self._now_ns)
                return
        for pty in self._all_ptys:
            if fileno == pty.fileno():
                pty.receive(self._now_ns)
                pty.send()
                return
        for name, line in self._tcp.items():
            if fileno in line.filenos():
                line.on_readable(fileno, self._now_ns)
                self._ptys[name].send()
                return
        if fileno in self._control.filenos():
            self._control.on_readable(fileno)

    def _strike(self, fault: str, target: str) -> None:
        ptys = self._ptys | self._slcan
        unplug: dict[str, Callable[[], None]] = {name: pty.unplug for name, pty in ptys.items()}
        if fault == "unplug" and (line := self._tcp.get(self._bus_of.get(target, target))):
            line.close()
        inject(self.world, fault, target, unplug, self._bus_of, self._now_ns)

    def _finish(self) -> None:
        truth = self.world.truth(max(self._now_ns, self.world.epoch_ns))
        partial = self._runtime_dir / "truth.partial.npz"
        np.savez(partial, **truth)  # type: ignore[arg-type]
        partial.rename(self._runtime_dir / "truth.npz")
        facts = {"worst_late_us": self._worst_late_ns / 1000, "turns": self._turns, "cpu_s": time.process_time()}
        (self._runtime_dir / "world.json").write_text(json.dumps(facts), encoding="utf-8")
        for pty in self._all_ptys:
            pty.unplug()
        for server in (*self._i2c.values(), *self._can.values(), *self._can_sockets.values(), *self._tcp.values()):
            server.close()
        self._control.close()


def load_factory(target: str) -> Callable[[dict[str, Any], str | None, float | None], Plant]:
    """``module:function`` that makes the plant."""
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


def warm_up(plant: Plant) -> None:
    """Use every face of a plant once, so that compiled kernels are loaded before anybody waits for them."""
    for t_ns in range(0, 40_000_000, 333_333):
        plant.advance_to(t_ns)
        plant.set_demand_V(0, 50.0, t_ns)
        _ = plant.analog_V, plant.magnetometer_V
    plant.strap("set")
    plant.truth()


def prefer_real_time() -> bool:
    """Ask for SCHED_FIFO; whether it was granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (PermissionError, OSError):
        return False
    return True


def main(argv: list[str]) -> int:
    job_path = Path(argv[0])
    job = json.loads(job_path.read_text(encoding="utf-8"))
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGHUP)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # they are for the firmware; it ends us when it is done
    try:
        process = WorldProcess(job)
    except HalError as error:
        job_path.with_name("error.txt").write_text(str(error), encoding="utf-8")
        return 2
    signal.signal(END, process.request_stop)
    signal.signal(signal.SIGHUP, process.outlive_parent)
    gc.collect()
    gc.freeze()
    gc.disable()
    policy = "SCHED_OTHER"
    if not process.serves_others and prefer_real_time():
        policy, process.count_down_ns = f"SCHED_FIFO {PRIORITY}", COUNT_DOWN_NS
    ready = {"endpoints": process.endpoints(), "tcp": process.tcp_ports(), "scheduling": policy, "pid": os.getpid()}
    partial = job_path.with_name("endpoints.partial")
    partial.write_text(json.dumps(ready), encoding="utf-8")
    partial.rename(job_path.with_name("endpoints.json"))
    process.run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
