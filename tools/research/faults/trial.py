"""Runs a hand and a seed with every fault: a run in virtual time that forks at the instant of the strike.

The way to the strike is the same for all faults, bit for bit, so it is gone once; then a child process per fault
breaks something and goes on to the end of its own run. The first child breaks nothing: it is the reference. Faults that
shift when samples are taken would be compared with other noise; their tip is taken from a pair of runs without noise.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, cast

from drivers.bus_use import bus_uses
from drivers.polling import polling_of
from drivers.registry import find_driver
from drivers.specs import check_devices
from firmware_py.app import run_in_process
from firmware_py.guardian.process import describe
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench, Port, Processes, load_bench
from hal.clock import VirtualClock
from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import HalError
from hal.middleware.faults import FaultCan, FaultI2c, FaultPlan, FaultSerial
from tools.research.faults.carriers import SocketPort
from tools.research.faults.fault import Both, Fault, How, InWorld, Kill, OnBus, OnHost, OutOfMemory
from tools.research.faults.judge import Observation, Seen, judge
from tools.research.faults.phases import SELF_TEST, START, STEADY, Phase, Stop

BEFORE_GUARDIAN = "the firmware died before it had a guardian; its outputs had not been driven"
Sabotaged = FaultSerial | FaultI2c | FaultCan


def _sabotaged(port: Port, clock: Clock) -> Sabotaged:
    if hasattr(port, "transfer"):
        return FaultI2c(cast(I2cBus, port), clock, FaultPlan())
    if hasattr(port, "recv"):
        return FaultCan(cast(CanBus, port), clock, FaultPlan())
    return FaultSerial(cast(SerialPort, port), clock, FaultPlan())


@dataclass
class FarBench:
    """The opened bench from the far side: its clock, world, ports, and every demand at the amplifier."""

    clock: VirtualClock = field(default_factory=VirtualClock)
    world: Any = None
    processes: Processes = field(default_factory=Processes)
    ports: dict[str, tuple[Sabotaged, Sabotaged]] = field(default_factory=dict[str, tuple[Sabotaged, Sabotaged]])
    demands: list[tuple[int, int, float]] = field(default_factory=list[tuple[int, int, float]])
    struck: How | None = None
    compiled: bool = False
    carriers: list[SocketPort] = field(default_factory=list[SocketPort])
    """The socket pairs between a compiled loop and the serial ports, the faults behind them."""

    def attach(self, opened: OpenBench) -> None:
        self.clock, self.world = cast(VirtualClock, opened.clock), cast(Any, opened.world)
        self.processes = opened.processes
        self.world.world.faults.on_demand = lambda channel, volts: self.demands.append(
            (self.clock.now_ns(), channel, volts)
        )

    def wrap(self, bus: str, port: Port, clock: Clock) -> Port:
        """Every port can be sabotaged later, by two faults at once; until then its plans are empty."""
        inner = _sabotaged(port, clock)
        outer = _sabotaged(inner, clock)
        self.ports[bus] = inner, outer
        if self.compiled and isinstance(outer, FaultSerial):
            self.carriers.append(SocketPort(outer))
            return self.carriers[-1]
        return outer

    def strike(self, how: How, seed: int, *, second: bool = False) -> None:
        """Begin the fault. ``second``: one on a bus leaves another there as it is."""
        now_ns = self.clock.now_ns()
        match how:
            case InWorld(name, target, heal, for_s):
                self.world.inject(name, target)
                if heal:
                    self.clock.at(now_ns + round(for_s * 1e9), lambda _: self.world.inject(heal, target))
            case OnBus(bus, plan, only):
                port, full = self.ports[bus][second], FaultPlan(**{**plan, "seed": seed})
                if isinstance(port, FaultI2c):
                    port.arm(full, only=only)
                else:
                    port.arm(full)
            case OnHost(stall_ms):
                self.clock.burn_ns(round(stall_ms * 1e6))
            case Kill(process):
                self.processes.dead.add(process)
            case OutOfMemory(left_MB):
                mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
                most = resource.getrlimit(resource.RLIMIT_AS)[1]
                resource.setrlimit(resource.RLIMIT_AS, (mapped + round(left_MB * 1e6), most))
            case Both(first, later, gap_s):
                self.strike(first, seed)
                self.clock.at(now_ns + round(gap_s * 1e9), lambda _: self.strike(later, seed + 1, second=True))

    def happened(self, how: How) -> bool:
        """Return whether ``how`` has done anything: a fault that strikes at random may not have, before the end."""
        match how:
            case OnBus(bus):
                return any(port.counts.any for port in self.ports[bus])
            case Both(first, second):
                return self.happened(first) or self.happened(second)
            case _:
                return True

    def scans(self) -> int:
        return int(self.world.world.devices["daq"].scans)

    def after_death(self, strike_ns: int, watch_s: float) -> Seen:
        """The firmware is dead: not one more instruction of it, but time, devices and guardian go on for ``watch_s``.
        Its counters died with it; what it had recorded is the recorder's affair."""
        self.clock.burn_ns(round(watch_s * 1e9))
        asked = self.processes.guardian_report
        report = asked() if asked is not None else {}
        reached = bool(report.get("neutral_ns")) or (bool(report) and report["taken_ns"] is None)
        outcome: dict[str, Any] = {
            "armed_ns": 0,
            "safe_ns": report.get("taken_ns") or self.clock.now_ns(),
            "safe_state": {"reason": describe(report) if report else BEFORE_GUARDIAN, "reached": reached},
            "noticed": {},
            "samples": {"received": self.scans(), "lost": 0, "unread": 0},
        }
        truth = self.world.world.truth(self.clock.now_ns())
        return Seen(strike_ns, outcome, truth["t_ns"], truth["tip_m"], self.demands, self.scans())


def observe_start(bench: Path, point: str, fault: Fault, seed: int, *, compiled: bool = False) -> Observation:
    """A fault that is there before the devices are opened. ``compiled``: the ticks run in the compiled thread."""
    far = FarBench(compiled=compiled)

    def open_hook(opened: OpenBench) -> None:
        far.attach(opened)
        far.strike(fault.how, seed)

    try:
        request = RunRequest(bench, 0.2, pace="virtual", seed=seed, compiled=compiled)
        outcome, truth = run_in_process(request, on_open=open_hook, wrap=far.wrap if compiled else None)
    except HalError as error:
        return Observation.refusal(fault.name, point, seed, str(error), START.name)
    assert truth is not None
    seen = Seen(0, outcome, truth["t_ns"], truth["tip_m"], far.demands, far.scans())
    return judge(fault.name, point, seed, seen, truth["tip_m"], phase=START)


@dataclass(frozen=True)
class Refused:
    """The answer of a run that never began."""

    message: str


class _AllStruck(BaseException):
    """The parent has sent out every child; its own run is not needed any more."""


def observe_running(
    bench: Path, point: str, faults: Sequence[Fault], seed: int, phase: Phase = STEADY, *, compiled: bool = False
) -> list[Observation]:
    """Each of ``faults`` strikes the same run at the same instant of ``phase``. ``compiled``: the ticks run in the
    compiled thread, over socket pairs."""
    far = FarBench(compiled=compiled)
    begin_ns, at_ns = phase.instants_ns(seed)
    answers: list[Any] = []
    me = _Child()
    shifting = [fault for fault in faults if fault.redraws] if phase.works else []
    references = [(False, None, max(fault.watch_s for fault in faults))]
    if shifting:
        references.append((True, None, max(fault.watch_s for fault in shifting)))
    runs: list[tuple[bool, Fault | None, float]] = [
        *references,
        *((True, fault, fault.watch_s) for fault in shifting),
        *((False, fault, fault.watch_s) for fault in faults),
    ]

    def at_strike(_: int) -> None:
        for quiet, fault, watch_s in runs:
            if me.fork(answers):
                for carrier in far.carriers:
                    carrier.leave_to_parent()
                if quiet:
                    far.world.world.plant.hush()
                if fault is not None:
                    far.struck = fault.how
                    far.strike(fault.how, seed)
                if "firmware" in far.processes.dead:
                    me.answer(far.after_death(at_ns, watch_s))
                far.clock.at(
                    at_ns + round((watch_s + phase.longer_s) * 1e9), lambda _: signal.raise_signal(signal.SIGINT)
                )
                return
        raise _AllStruck

    def begin(_: int) -> None:
        match phase.prelude:
            case None:
                pass
            case Stop():
                signal.raise_signal(signal.SIGINT)
            case how:
                far.strike(how, seed)

    def open_hook(opened: OpenBench) -> None:
        far.attach(opened)
        far.clock.at(begin_ns, begin)
        far.clock.at(at_ns, at_strike)

    request = RunRequest(bench, 60.0, pace="virtual", seed=seed, compiled=compiled)
    try:
        outcome, truth = run_in_process(request, on_open=open_hook, wrap=far.wrap)
    except _AllStruck:
        pass
    except BaseException as error:
        if me.is_child:
            refuses = phase.name == SELF_TEST.name and isinstance(error, (HalError, MemoryError))
            reason = f"not enough memory: {error}" if isinstance(error, MemoryError) else str(error)
            me.answer(Refused(reason) if refuses else error)
        raise
    else:
        if not me.is_child:
            raise RuntimeError(f"the run ended before the strike: {outcome['safe_state']['reason']}")
        assert truth is not None
        happened = far.struck is None or far.happened(far.struck)
        wire_ns = command_wire_ns(bench)
        me.answer(Seen(at_ns, outcome, truth["t_ns"], truth["tip_m"], far.demands, far.scans(), happened, wire_ns))
    finished = [answer for answer in answers if isinstance(answer, Seen)]
    if any("SIGTERM" in str(seen.outcome["safe_state"]["reason"]) for seen in finished):
        raise SystemExit("the campaign was ended from outside")  # the run heard it, and took it for its operator
    of = {(quiet, fault and fault.name): seen for (quiet, fault, _), seen in zip(runs, answers, strict=True)}

    def judged(fault: Fault) -> Observation:
        seen = of[False, fault.name]
        if isinstance(seen, Refused):
            return Observation.refusal(fault.name, point, seed, seen.message, phase.name)
        quiet = fault in shifting
        tip_m = of[True, fault.name].tip_m if quiet else None
        usual = of[False, None].outcome["noticed"]
        return judge(fault.name, point, seed, seen, of[quiet, None].tip_m, tip_m, phase, usual)

    return [judged(fault) for fault in faults]


def command_wire_ns(bench: Path) -> int:
    """Return how long a command of the output of ``bench`` is under way after the driver has given it to the port: 0
    where the driver waits for the end of the transfer."""
    file = load_bench(bench)
    options = check_devices(file.description, str(bench))
    uses = bus_uses(file.description, options, polling_of(file.description, options)[0])
    devices = file.description.device
    queued = [u for u in uses if find_driver(devices[u.device].driver).role == "output" and not u.task]
    return round(1e3 * max((use.bus_us for use in queued if use.what == "command"), default=0.0))


class _Child:
    """Forks one child at a time and takes its answer through a pipe."""

    def __init__(self) -> None:
        self._pipe = -1

    @property
    def is_child(self) -> bool:
        return self._pipe >= 0

    def fork(self, answers: list[Any]) -> bool:
        """True in the child. The parent waits for the child's answer and appends it; raises what the child raised."""
        reader, writer = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(reader)
            self._pipe = writer
            return True
        os.close(writer)
        with os.fdopen(reader, "rb") as pipe:
            data = pipe.read()
        os.waitpid(pid, 0)
        if not data:
            raise RuntimeError("a run with a fault died without an answer")
        answer = pickle.loads(data)
        if isinstance(answer, BaseException):
            raise answer
        answers.append(answer)
        return False

    def answer(self, value: Any) -> NoReturn:
        """Tell the parent and end this process at once: nothing of the parent's is to be cleaned up here."""
        most = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (most, most))  # what was taken from the firmware is not taken from us
        try:
            with os.fdopen(self._pipe, "wb") as pipe:
                pickle.dump(value, pipe)
        finally:
            os._exit(0)
