"""Text that says, before a run starts, what runs its ticks: the compiled thread, or Python and why."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

from firmware_py.compiled.eligible import reasons_against_bench
from hal.bench import BenchFile
from hal.clock import Pace

WIDTH = 80
"""Number of columns of the narrowest terminal that the lines are written for."""


def loop_lines(
    bench: BenchFile, pace: Pace, *, compiled: bool, orders: Sequence[str] = (), label: str = "loop: "
) -> list[str]:
    """Return what runs the ticks on ``bench`` and, where that must be Python, which device is why. ``orders``: why what
    was asked for keeps the ticks in Python. ``label`` begins the first line. Empty in emulated time, which always
    passes in Python."""
    if pace != "realtime":
        return []
    if compiled:
        return [f"{label} one compiled thread, Python beside it"]
    reasons = [*reasons_against_bench(bench, pace), *orders]
    if not reasons:
        return [f"{label} Python; --compiled runs it without the interpreter"]
    lines = [f"{label} Python, because this run cannot be compiled:"]
    for why in reasons:
        lines += wrap(why, WIDTH, initial_indent=" " * 7, subsequent_indent=" " * 9)
    return lines
