"""Raises the kernel's threads that move a tty's bytes from its driver to its reader.

A driver hands arrived bytes to the workqueue of unbound work, whose threads (``kworker/u...``) have ordinary priority
(Linux, drivers/tty/tty_buffer.c, ``tty_flip_buffer_push``; Documentation/core-api/workqueue.rst). While another program
uses the processor, a scan that has arrived waits for the end of that program's time slice, although the loop that is to
read it has real-time priority.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable

from firmware_py.machine.tree import Tree

PREFIX = "kworker/u"
CAP_SYS_NICE = 23
RT_PRIORITY_AT = 37
"""Place of ``rt_priority`` behind the name in /proc/PID/stat, where it is field 40 (proc_pid_stat(5))."""


def find_workers(tree: Tree) -> list[int]:
    """Return the process ids of the kernel's threads for unbound work."""
    names = [name for name in tree.names("proc/[1-9]*/comm") if (tree.read(name) or "").startswith(PREFIX)]
    return [int(name.split("/")[1]) for name in names]


def has_ordinary_workers(tree: Tree) -> bool:
    """Return True if one of these threads has no real-time policy."""
    stats = [tree.read(f"proc/{pid}/stat") or "" for pid in find_workers(tree)]
    return any(stat.rpartition(")")[2].split()[RT_PRIORITY_AT : RT_PRIORITY_AT + 1] == ["0"] for stat in stats)


def may_raise(tree: Tree) -> bool:
    """Return True if this process has the capability CAP_SYS_NICE."""
    status = (tree.read("proc/self/status") or "").splitlines()
    held = next((line.split()[1] for line in status if line.startswith("CapEff:")), "0")
    return bool(int(held, 16) >> CAP_SYS_NICE & 1)


def raise_workers(tree: Tree, priority: int) -> Callable[[], None]:
    """Give the threads that are there SCHED_FIFO with ``priority``, and return what undoes it.

    A thread that the kernel starts later has ordinary priority. Threads stay raised if this process is killed. Raises
    ``PermissionError`` without the right to do so."""
    raised: list[int] = []
    for pid in find_workers(tree):
        with contextlib.suppress(ProcessLookupError):  # the kernel ends idle ones
            if os.sched_getscheduler(pid) == os.SCHED_OTHER:
                os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(priority))
                raised.append(pid)

    def undo() -> None:
        for pid in set(raised).intersection(find_workers(tree)):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))

    return undo
