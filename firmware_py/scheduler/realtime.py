"""Makes the real-time settings of the loop's process: each is tried, reported as data, and undone.

A machine that permits none of them still runs the loop; the report says what it ran with. Effects measured in
design/algorithms.md section F: SCHED_FIFO takes the 99th percentile of lateness from milliseconds to 0.1 ms.
"""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

from firmware_py.machine.attendant import attend_workers
from firmware_py.machine.tree import MACHINE, Tree, hold_latency_limit

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # sys/mman.h, Linux
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30  # linux/prctl.h


@dataclass(frozen=True, slots=True)
class RealtimeConfig:
    """Sets which real-time settings to ask for. ``None`` or False leaves a setting alone.

    ``priority`` is SCHED_FIFO's 1..99 (the policy is not inherited by child processes), ``cpu`` the
    processor to stay on. Child processes and threads started while pinned inherit the pinning: start them before.
    ``idle_exit_us``: the longest time that a processor may take to wake up (/dev/cpu_dma_latency), 0: no idle states.
    ``worker_priority``: SCHED_FIFO priority of the kernel's threads that bring the bytes of ttys.
    """

    priority: int | None = 50
    lock_memory: bool = True
    cpu: int | None = None
    timer_slack_ns: int | None = 1
    freeze_gc: bool = True
    idle_exit_us: int | None = None
    worker_priority: int | None = None


@dataclass(frozen=True, slots=True)
class Setting:
    """Reports one setting: whether it took effect, and if not, why."""

    name: str
    wanted: str
    done: bool
    detail: str = ""


@dataclass(slots=True)
class RealtimeReport:
    """Holds all settings asked for, in order."""

    settings: list[Setting] = field(default_factory=list[Setting])

    def __getitem__(self, name: str) -> Setting:
        return next(s for s in self.settings if s.name == name)

    def as_dict(self) -> dict[str, dict[str, object]]:
        return {s.name: {"wanted": s.wanted, "done": s.done, "detail": s.detail} for s in self.settings}


@contextmanager
def realtime(config: RealtimeConfig, tree: Tree = MACHINE) -> Generator[RealtimeReport]:
    """Apply ``config`` to the calling thread's process for the length of the ``with`` block. Never raises
    because something is not permitted or not there; undoes in reverse order what it did. ``tree``: of /dev."""
    report = RealtimeReport()
    with ExitStack() as undo:

        def attempt(name: str, wanted: str, apply: Callable[[], Callable[[], object]]) -> None:
            try:
                undo.callback(_quietly, apply())
            except (OSError, AttributeError, ValueError) as error:
                report.settings.append(Setting(name, wanted, False, _why(error)))
            else:
                report.settings.append(Setting(name, wanted, True))

        cpu, priority, slack_ns, idle_us = config.cpu, config.priority, config.timer_slack_ns, config.idle_exit_us
        if idle_us is not None:
            wanted = "idle states off" if idle_us == 0 else f"idle states of {idle_us} us"
            attempt("idle_states", wanted, lambda: hold_latency_limit(tree, idle_us))
        if (worker := config.worker_priority) is not None:  # before the pinning, which its process would inherit
            attempt("tty_workers", f"SCHED_FIFO {worker}", lambda: attend_workers(worker))
        if cpu is not None:
            attempt("cpu", f"cpu {cpu}", lambda: _pin(cpu))
        if slack_ns is not None:
            attempt("timer_slack", f"{slack_ns} ns", lambda: _timer_slack(slack_ns))
        if config.lock_memory:
            attempt("lock_memory", "touched memory locked", _lock_memory)
        if config.freeze_gc:
            attempt("gc", "frozen and off", _freeze_gc)
        if priority is not None:  # last: what precedes may take long
            attempt("priority", f"SCHED_FIFO {priority}", lambda: _fifo(priority))
        yield report


def _pin(cpu: int) -> Callable[[], object]:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {cpu})
    return lambda: os.sched_setaffinity(0, before)


def _fifo(priority: int) -> Callable[[], object]:
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    return lambda: os.sched_setscheduler(0, policy, param)


def _lock_memory() -> Callable[[], object]:
    """Lock the pages that the process has touched or will touch. Locking whole mappings would bring in all of every
    library: three times the memory, and longer to free when the process dies."""
    libc = ctypes.CDLL(None, use_errno=True)
    _check(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT))
    return libc.munlockall


def _timer_slack(slack_ns: int) -> Callable[[], object]:
    libc = ctypes.CDLL(None, use_errno=True)
    before = libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    _check(libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0))
    return lambda: libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(before), 0, 0, 0)


def _freeze_gc() -> Callable[[], object]:
    was_enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()

    def thaw() -> None:
        gc.unfreeze()
        if was_enabled:
            gc.enable()

    return thaw


def _check(result: int) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _quietly(undo: Callable[[], object]) -> None:
    """Undo a setting, and ignore a failure: a right that was taken away meanwhile must not cost the run's report."""
    try:
        undo()
    except OSError:
        return


def _why(error: Exception) -> str:
    if isinstance(error, PermissionError):
        return f"{error.strerror}: needs root, CAP_SYS_NICE or CAP_IPC_LOCK, or limits in /etc/security/limits.conf"
    if isinstance(error, AttributeError):
        return "not offered by this operating system"
    return str(error)
