"""Builds the instrument's task table: what runs in which tick, in which order, within which budget.

The bench file sets how often a device is polled (``drivers.polling``); this module finds the ticks for it, so
that as few slow transfers as possible share a tick. A budget is the time that the wires take plus an allowance for the
processor; ``[firmware.budget_us]`` overrides it by the task's name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.polling import SUPERVISE, Polling, Polls
from firmware_py.scheduler.check import MAX_HYPERPERIOD_TICKS
from firmware_py.scheduler.task import TaskSpec, TickInfo
from hal.errors import BenchError

ALLOWANCE_US: Mapping[str, float] = {
    "sense": 60.0,
    "estimate": 50.0,
    "actuate": 100.0,
    "publish": 30.0,
    "supervise": 300.0,
    "magnetometer": 100.0,
    "verify": 100.0,
    "monitor": 100.0,
    "telemetry": 300.0,
}
"""Processor time that a task may take beside its time on the wires, us.

100 us for a transfer are 1.4 to 3 times the median of a driver and its emulated device together (35 to 70 us on the
two-core machine of the benchmarks, column ``cpu`` of a run in virtual time)."""
MAY_WAIT_TICKS = 3
"""Ticks for which telemetry, and tasks that share the bus with the outputs, may be deferred: they may be a little
late, the next command may not."""

LONGEST_US = 1e5  # the period of the slowest tick

Work = Callable[[TickInfo], object]


@dataclass(frozen=True)
class Works:
    """Holds the function of each task. ``None`` means that this bench has no device for it."""

    sense: Work
    estimate: Work
    actuate: Work
    publish: Work
    supervise: Work
    magnetometer: Work | None
    verify: Work | None
    monitor: Work | None
    telemetry: Work | None


def budgets_us(bus_us: Mapping[str, float], overrides: Mapping[str, float]) -> dict[str, float]:
    """Return the budget of each task, us: the sum of ``bus_us`` (its time on the wires) and its allowance, or its
    override.

    Raises ``BenchError`` for an override of an unknown task, or one outside 1 to ``LONGEST_US``.
    """
    for name, value in overrides.items():
        if name not in ALLOWANCE_US:
            raise BenchError(f"[firmware.budget_us.{name}] there is no such task; tasks are {', '.join(ALLOWANCE_US)}")
        if not 1.0 <= value <= LONGEST_US:
            raise BenchError(f"[firmware.budget_us.{name}] {value:g} is outside 1 to {LONGEST_US:g} us")
    derived = {name: bus_us.get(name, 0.0) + allowance for name, allowance in ALLOWANCE_US.items()}
    return {**derived, **overrides}


def task_table(
    works: Works,
    tick_hz: int,
    budget_us: Mapping[str, float],
    polling: Polling,
    bus_us: Mapping[str, float],
) -> list[TaskSpec]:
    """Return the tasks: sense, estimate, actuate and publish in every tick, then what is due less often. Tasks that may
    wait come last.

    ``budget_us`` overrides budgets by name, ``bus_us`` is the time that a task's transaction takes on the wires.
    """
    budget = budgets_us(bus_us, budget_us)
    period_us = 1e6 / tick_hz
    table: list[TaskSpec] = []
    periodic = (
        # name, work, polls, first tick that is tried, order, ticks that it may wait
        ("supervise", works.supervise, SUPERVISE, 2, 4, 0),
        ("verify", works.verify, polling.verify, 8, 5, MAY_WAIT_TICKS),
        ("telemetry", works.telemetry, polling.telemetry, 5, 6, MAY_WAIT_TICKS),
        ("monitor", works.monitor, polling.monitor, 0, 5, MAY_WAIT_TICKS),
        ("magnetometer", works.magnetometer, polling.magnetometer, 0, 5, MAY_WAIT_TICKS),
    )
    for order, (name, work) in enumerate(
        (("sense", works.sense), ("estimate", works.estimate), ("actuate", works.actuate), ("publish", works.publish))
    ):
        catch_up = name != "actuate"
        table.append(TaskSpec(name, work, 1, 0, order, budget[name], period_us, catch_up))
    load_us = np.zeros(
        _hyperperiod([polls for _, work, polls, *_ in periodic if work is not None and polls is not None])
    )
    for name, work, polls, start, order, may_wait in periodic:
        if work is None or polls is None:
            continue
        ticks = _emptiest(load_us, polls, start)
        for k, tick in enumerate(ticks):
            load_us[tick :: polls.divider] += budget[name]
            spec_name = name if polls.count == 1 else f"{name}_{k + 1}"
            table.append(
                TaskSpec(spec_name, work, polls.divider, tick, order, budget[name], period_us, False, may_wait)
            )
    return table


def _hyperperiod(all_polls: list[Polls]) -> int:
    ticks = math.lcm(*(polls.divider for polls in all_polls))
    if ticks > MAX_HYPERPERIOD_TICKS:
        dividers = ", ".join(str(polls.divider) for polls in all_polls)
        raise BenchError(
            f"[device] the rates repeat only after {ticks} ticks (every {dividers} ticks); choose rates that divide "
            "one another"
        )
    return ticks


def _emptiest(load_us: NDArray[np.float64], polls: Polls, start: int) -> tuple[int, ...]:
    """Return the ticks for ``polls`` that carry the smallest load; of equal ones the first from ``start`` on."""

    def fullest(first: int) -> float:
        return max(float(load_us[tick :: polls.divider].max()) for tick in polls.ticks(first))

    firsts = [(start + k) % polls.divider for k in range(polls.divider)]
    return polls.ticks(min(firsts, key=fullest))
