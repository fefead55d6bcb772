"""The table of machine settings: what the kernel says, what a 1 kHz loop wants, why, and how it is set.

``lasts`` says who may set it. "run": for the length of a run, because the kernel takes it back by itself when the
process dies. "boot": by ``micron doctor --set``, until the machine is started again. "kernel": on the kernel's command
line, or with another kernel. Sources: Linux, Documentation/admin-guide/kernel-parameters.txt and
kernel-per-CPU-kthreads.rst, Documentation/core-api/irq/irq-affinity.rst, Documentation/scheduler/sched-rt-group.rst,
Documentation/admin-guide/pm, Documentation/ABI/testing/sysfs-bus-usb; FTDI application note AN232B-04 (latency timer).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from firmware_py.machine.processors import format_processors, parse_processors
from firmware_py.machine.tree import DMA_LATENCY, Tree, read_latency_limit_us
from firmware_py.machine.workers import (
    find_workers,
    has_left_workers,
    has_ordinary_workers,
    may_raise,
)

Lasts = Literal["run", "boot", "kernel"]
CPUS = "sys/devices/system/cpu"
RT_RUNTIME, RT_PERIOD = "proc/sys/kernel/sched_rt_runtime_us", "proc/sys/kernel/sched_rt_period_us"


@dataclass(frozen=True)
class Reading:
    """Describes one place of a setting. ``where``: a file below the root; ``what``: its name for people."""

    where: str
    what: str
    value: str
    is_good: bool


@dataclass(frozen=True)
class MachineSetting:
    """Describes one setting. ``read`` returns its readings, none where the machine lacks it; ``explain``: why it
    matters; ``remedy``: how a person sets it for good; ``set``: sets the place of one reading, raises ``OSError`` where
    that is refused; ``absent``: what no readings mean.
    """

    name: str
    wanted: str
    lasts: Lasts
    explain: str
    remedy: str
    read: Callable[[Tree, Sequence[str]], list[Reading]]
    set: Callable[[Tree, Reading], None] | None = None
    absent: str = "not on this machine"


def _latency_limit(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    limit_us = read_latency_limit_us(tree)
    if limit_us is None:
        return []
    value = f"{limit_us} us" if limit_us < 1_000_000_000 else "no limit"
    if is_ours := limit_us > 0 and tree.may_write(DMA_LATENCY):
        value += ", but a run holds it at 0 us"
    return [Reading(DMA_LATENCY, "cpu_dma_latency", value, limit_us == 0 or is_ours)]


def _tty_workers(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    if not find_workers(tree):
        return []
    if has_left_workers(tree):
        return [
            Reading("proc", WORKERS, "real-time priority, which a killed run has left; the next run lowers it", False)
        ]
    if not has_ordinary_workers(tree):
        return [Reading("proc", WORKERS, "real-time priority", True)]
    is_ours = may_raise(tree)
    return [Reading("proc", WORKERS, "ordinary priority" + (", but a run raises it" if is_ours else ""), is_ours)]


WORKERS = "kworker/u*"


def _isolated(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    return _list_of_processors(tree, f"{CPUS}/isolated", "isolated")


def _without_tick(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    return _list_of_processors(tree, f"{CPUS}/nohz_full", "nohz_full")


def _list_of_processors(tree: Tree, where: str, what: str) -> list[Reading]:
    text = tree.read(where)
    if text is None:
        return []
    numbers = parse_processors(text)
    return [Reading(where, what, f"processor {format_processors(numbers)}" if numbers else "none", bool(numbers))]


def isolated_processors(tree: Tree) -> list[int]:
    """Return the processors that the kernel gives no work unless it is told to."""
    return parse_processors(tree.read(f"{CPUS}/isolated"))


def _interrupts(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    """Interrupts that may come on an isolated processor; without one there is nothing to keep them from."""
    isolated = set(isolated_processors(tree))
    readings: list[Reading] = []
    for where in tree.names("proc/irq/*/smp_affinity_list") if isolated else []:
        allowed = parse_processors(tree.read(where))
        number = where.split("/")[2]
        readings.append(Reading(where, f"irq {number}", format_processors(allowed), not isolated.intersection(allowed)))
    return readings


def _set_interrupt(tree: Tree, reading: Reading) -> None:
    isolated = set(isolated_processors(tree))
    every = parse_processors(tree.read(f"{CPUS}/online")) or parse_processors(reading.value)
    tree.write(reading.where, format_processors([n for n in every if n not in isolated]))


def _rt_share(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    runtime, period = tree.read(RT_RUNTIME), tree.read(RT_PERIOD)
    if runtime is None or period is None or not runtime.lstrip("-").isdigit() or not period.isdigit():
        return []
    if int(runtime) < 0:
        return [Reading(RT_RUNTIME, "sched_rt_runtime_us", "no limit", True)]
    share = 100.0 * int(runtime) / max(int(period), 1)
    return [Reading(RT_RUNTIME, "sched_rt_runtime_us", f"{share:g} % of a processor", share >= RT_ENOUGH)]


RT_ENOUGH = 95.0
"""Share of a processor, in %, that leaves a 1 kHz loop in peace even if it spins half of the time; the kernel's own."""


def _governors(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    readings: list[Reading] = []
    for where in tree.names(f"{CPUS}/cpu*/cpufreq/scaling_governor"):
        value = tree.read(where)
        if value is not None:
            readings.append(Reading(where, where.split("/")[4], value, value == "performance"))
    return readings


def _ports_of(tree: Tree, ports: Sequence[str]) -> list[str]:
    """Return the names below sys/class/tty of ``ports``, or of every USB serial port if none is named."""
    if not ports:
        return tree.names("sys/class/tty/ttyUSB*") + tree.names("sys/class/tty/ttyACM*")
    names = [(tree.root / port.lstrip("/")).resolve().name for port in ports]
    return [f"sys/class/tty/{name}" for name in names if tree.is_there(f"sys/class/tty/{name}")]


def _autosuspend(tree: Tree, ports: Sequence[str]) -> list[Reading]:
    readings: dict[str, Reading] = {}
    for port in _ports_of(tree, ports):
        device = tree.above(port, "idVendor")  # the USB device itself, not its interface
        where = f"{device}/power/control"
        value = tree.read(where) if device is not None else None
        if value is not None:
            name = port.rpartition("/")[2]
            readings[where] = Reading(where, name, "always on" if value == "on" else value, value == "on")
    return list(readings.values())


def _latency_timers(tree: Tree, ports: Sequence[str]) -> list[Reading]:
    readings: list[Reading] = []
    for port in _ports_of(tree, ports):
        name = port.rpartition("/")[2]
        where = f"sys/bus/usb-serial/devices/{name}/latency_timer"
        value = tree.read(where)
        if value is not None:
            readings.append(Reading(where, name, f"{value} ms", value == "1"))
    return readings


def _preemption(tree: Tree, _ports: Sequence[str]) -> list[Reading]:
    version = tree.read("proc/sys/kernel/version")
    if version is None:
        return []
    is_rt = tree.read("sys/kernel/realtime") == "1" or "PREEMPT_RT" in version
    kind = next((word for word in ("PREEMPT_RT", "PREEMPT_DYNAMIC", "PREEMPT") if word in version), "no preemption")
    return [Reading("proc/sys/kernel/version", "kernel", "PREEMPT_RT" if is_rt else kind, is_rt)]


def _writer(text: str) -> Callable[[Tree, Reading], None]:
    return lambda tree, reading: tree.write(reading.where, text)


SETTINGS = (
    MachineSetting(
        "idle states", "0 us", "run",
        "a processor that sleeps deeply needs up to some 100 us to wake up for a scan",
        "let your user write /dev/cpu_dma_latency (docs/lab-machine.md): `micron run` then holds it at 0 us",
        _latency_limit,
    ),
    MachineSetting(
        "workers of ttys", "real-time priority", "run",
        "bytes of a serial port wait up to 4 ms for a kernel thread while another program uses the processor",
        "run as root or with the capability CAP_SYS_NICE: `micron run --realtime` then raises these threads",
        _tty_workers,
    ),
    MachineSetting(
        "isolated processors", "one", "kernel",
        "other programs are then never run where the loop runs",
        "add 'isolcpus=domain,managed_irq,N nohz_full=N rcu_nocbs=N' to the kernel's command line",
        _isolated,
    ),
    MachineSetting(
        "processors without a tick", "the isolated one", "kernel",
        "the kernel's own tick takes some us of a processor 100 to 1000 times a second",
        "add 'nohz_full=N' to the kernel's command line, with the N of isolcpus",
        _without_tick,
    ),
    MachineSetting(
        "interrupts", "none on an isolated processor", "boot",
        "an interrupt of a disk or a network stops the loop for as long as it takes",
        "add 'irqaffinity=' with the other processors to the kernel's command line, and stop irqbalance",
        _interrupts, _set_interrupt, "no isolated processor to keep them from",
    ),
    MachineSetting(
        "share of real-time tasks", "95 % or no limit", "boot",
        "a task of real-time priority that uses up its share is stopped for the rest of the second",
        "set 'kernel.sched_rt_runtime_us = 950000' in /etc/sysctl.d/micron.conf; -1 is no limit",
        _rt_share, _writer("950000"),
    ),
    MachineSetting(
        "governor", "performance", "boot",
        "a processor that was slowed down while it waited starts each tick slowly",
        "run 'cpupower frequency-set -g performance' at each start of the machine",
        _governors, _writer("performance"),
    ),
    MachineSetting(
        "USB autosuspend", "always on", "boot",
        "a port that was suspended answers its first transfer some 10 ms late",
        "add ATTR{power/control}=\"on\" for the device to a udev rule",
        _autosuspend, _writer("on"), "no USB serial port",
    ),
    MachineSetting(
        "FTDI latency timer", "1 ms", "boot",
        "an FTDI adapter keeps bytes for up to 16 ms; `micron` asks for 1 ms when it opens the port",
        "add ATTR{latency_timer}=\"1\" for the adapter to a udev rule",
        _latency_timers, _writer("1"), "no FTDI adapter",
    ),
    MachineSetting(
        "preemption", "PREEMPT_RT", "kernel",
        "another kernel finishes what it is doing before a task of real-time priority runs",
        "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64), or add 'preempt=full' to the command line of a "
        "PREEMPT_DYNAMIC kernel",
        _preemption,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class MachineState:
    """Holds a setting with what was read."""

    setting: MachineSetting
    readings: tuple[Reading, ...]

    @property
    def is_good(self) -> bool:
        """Return True if nothing is to be done; also where the machine has no such thing."""
        return all(reading.is_good for reading in self.readings)

    def describe(self) -> str:
        """Return the values in words, equal ones together, the ones to be changed first."""
        if not self.readings:
            return self.setting.absent
        names: dict[str, list[str]] = {}
        for reading in sorted(self.readings, key=lambda r: r.is_good):
            names.setdefault(reading.value, []).append(reading.what)
        if len(self.readings) == 1 and len(names) == 1:
            return next(iter(names))
        return "; ".join(f"{value}: {_some(what)}" for value, what in names.items())

    def as_dict(self) -> dict[str, object]:
        """Return the state as JSON values."""
        setting = self.setting
        return {
            "name": setting.name, "value": self.describe(), "wanted": setting.wanted, "good": self.is_good,
            "there": bool(self.readings),
        }  # fmt: skip


def _some(what: list[str], most: int = 4) -> str:
    return ", ".join(what[:most]) + (f" and {len(what) - most} more" if len(what) > most else "")


def read_machine(tree: Tree, ports: Sequence[str] = ()) -> list[MachineState]:
    """Return the state of every setting. ``ports``: paths of serial ports, such as ``/dev/ttyACM0``; without one it is
    every USB serial port of the machine."""
    return [MachineState(setting, tuple(setting.read(tree, ports))) for setting in SETTINGS]


@dataclass(frozen=True)
class Change:
    """Reports one attempt to set something. ``failure``: why it was refused, empty if it was not."""

    name: str
    what: str
    before: str
    wanted: str
    failure: str = ""


def set_machine(tree: Tree, ports: Sequence[str] = ()) -> list[Change]:
    """Set until the next start of the machine what is not as wanted and can be set. Never raises because something is
    refused: the changes say so."""
    changes: list[Change] = []
    for state in read_machine(tree, ports):
        setting = state.setting
        if setting.set is None or setting.lasts != "boot":
            continue
        for reading in state.readings:
            if reading.is_good:
                continue
            failure = ""
            try:
                setting.set(tree, reading)
            except OSError as error:
                failure = error.strerror or str(error)
            changes.append(Change(setting.name, reading.what, reading.value, setting.wanted, failure))
    return changes
