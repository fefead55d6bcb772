"""One line of the table, and the clock that a shared machine does not disturb."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Row:
    """``ours`` and ``peer`` in ``unit``, measured in the same run; ``goal`` in words, ``meets`` is computed."""

    name: str
    what: str
    ours: float
    peer: float
    peer_name: str
    unit: str
    ratio: float
    goal: str
    meets: bool | None


def cpu_us_per_call(function: Callable[[], object], calls: int, repeats: int = 7) -> float:
    """Median thread CPU time of one call, in us."""
    times = []
    for _ in range(repeats):
        started_ns = time.thread_time_ns()
        for _ in range(calls):
            function()
        times.append((time.thread_time_ns() - started_ns) / calls * 1e-3)
    return float(np.median(times))
