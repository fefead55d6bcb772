"""One line of the table, and the clock that a shared machine does not disturb."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Row:
    """``ours`` and ``peer`` in ``unit``, measured in the same run; ``goal`` in words, ``meets`` is computed.

    ``must`` marks the lines of the issue's "What it must reach"; ``why`` is for a line that does not meet its goal.
    """

    name: str
    what: str
    ours: float
    peer: float
    peer_name: str
    unit: str
    ratio: float
    goal: str = "-"
    meets: bool | None = None
    must: bool = False
    why: str = ""


def cpu_us(function: Callable[[], object], per_call: int = 1, repeats: int = 7) -> float:
    """Least thread CPU time of one call over ``per_call``, in us: neighbours can only add to it."""
    times = []
    for _ in range(repeats):
        started_ns = time.thread_time_ns()
        function()
        times.append(time.thread_time_ns() - started_ns)
    return min(times) / per_call * 1e-3


def side_by_side(functions: Sequence[Callable[[], object]], per_call: int = 1, repeats: int = 9) -> NDArray[np.float64]:
    """``cpu_us`` of several, taken in turns so that all see the same machine."""
    times = np.array([[cpu_us(f, per_call, 1) for f in functions] for _ in range(repeats)])
    return times.min(axis=0)


def process_cpu_s(function: Callable[[], object]) -> float:
    """CPU of the whole process for one call, s."""
    started_s = time.process_time()
    function()
    return time.process_time() - started_s


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Fitted growth: cost ~ size^exponent."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
