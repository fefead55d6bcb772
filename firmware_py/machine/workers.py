"""Raises the kernel's threads that move a tty's bytes from its driver to its reader.

A driver hands arrived bytes to the workqueue of unbound work, whose threads (``kworker/u...``) have ordinary priority
(Linux, drivers/tty/tty_buffer.c, ``tty_flip_buffer_push``; Documentation/core-api/workqueue.rst). While another program
uses the processor, a scan that has arrived waits for the end of that program's time slice, although the loop that is to
read it has real-time priority.
"""

from __future__ import annotations

import contextlib
import os

from firmware_py.machine.tree import Tree

WORKER_PRIORITY = 70
"""SCHED_FIFO priority of these threads in a run: between the loop and other programs."""
NAME = "micron-workers"
"""Name of the process that keeps them raised (``firmware_py.machine.attendant``)."""
PREFIX = "kworker/u"
CAP_SYS_NICE = 23
RT_PRIORITY_AT = 37
"""Place of ``rt_priority`` behind the name in /proc/PID/stat, where it is field 40 (proc_pid_stat(5))."""


def find_workers(tree: Tree) -> list[int]:
    """Return the process ids of the kernel's threads for unbound work."""
    return _named(tree, PREFIX)


def _named(tree: Tree, prefix: str) -> list[int]:
    names = [name for name in tree.names("proc/[1-9]*/comm") if (tree.read(name) or "").startswith(prefix)]
    return [int(name.split("/")[1]) for name in names]


def _priorities(tree: Tree) -> set[str]:
    stats = [(tree.read(f"proc/{pid}/stat") or "").rpartition(")")[2].split() for pid in find_workers(tree)]
    return {stat[RT_PRIORITY_AT] for stat in stats if len(stat) > RT_PRIORITY_AT}


def has_ordinary_workers(tree: Tree) -> bool:
    """Return True if one of these threads has no real-time policy."""
    return "0" in _priorities(tree)


def has_left_workers(tree: Tree) -> bool:
    """Return True if one of these threads has the priority that a run gives it, and no run is under way: the run and
    its attendant were killed."""
    return str(WORKER_PRIORITY) in _priorities(tree) and not has_attendant(tree)


def has_attendant(tree: Tree, *, besides_us: bool = False) -> bool:
    """Return True if a process keeps the threads raised. ``besides_us``: another one than this process."""
    return any(pid != os.getpid() or not besides_us for pid in _named(tree, NAME))


def may_raise(tree: Tree) -> bool:
    """Return True if this process has the capability CAP_SYS_NICE."""
    status = (tree.read("proc/self/status") or "").splitlines()
    held = next((line.split()[1] for line in status if line.startswith("CapEff:")), "0")
    return bool(int(held, 16) >> CAP_SYS_NICE & 1)


def raise_workers(tree: Tree, priority: int) -> None:
    """Give the threads that are there and have ordinary priority SCHED_FIFO with ``priority``. Raises
    ``PermissionError`` without the right to do so."""
    for pid in find_workers(tree):
        with contextlib.suppress(ProcessLookupError):  # the kernel ends idle ones
            if os.sched_getscheduler(pid) == os.SCHED_OTHER:
                os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(priority))


def lower_workers(tree: Tree, priority: int) -> None:
    """Give the threads that have SCHED_FIFO with ``priority`` ordinary priority, also those that a killed run has
    left."""
    for pid in find_workers(tree):
        with contextlib.suppress(ProcessLookupError):
            if os.sched_getscheduler(pid) == os.SCHED_FIFO and os.sched_getparam(pid).sched_priority == priority:
                os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))
