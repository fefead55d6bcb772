"""Tells how long the kernel has kept a thread waiting for a processor."""

from __future__ import annotations

from firmware_py.machine.tree import MACHINE, Tree

SCHEDSTAT = "proc/thread-self/schedstat"


def kept_waiting_ns(tree: Tree = MACHINE) -> int:
    """Return the time in ns for which the calling thread was ready to run and its processor was at something else, 0
    where the kernel does not count it. A thread of the highest priority waits for system calls and interrupts of
    others that the kernel does not break off. Source: Linux, Documentation/scheduler/sched-stats.rst."""
    fields = (tree.read(SCHEDSTAT) or "").split()
    return int(fields[1]) if len(fields) > 1 else 0
