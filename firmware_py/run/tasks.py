"""Binds an instrument's table of tasks to the ticks: one row per task, in the order in which they run.

A row says how often a task runs; this module finds the ticks for it, so that as few slow transfers as possible share a
tick. A row's budget is the time that the wires take plus an allowance for the processor; ``[firmware.budget_us]``
overrides it by the task's name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.polls import Polls
from firmware_py.scheduler.check import MAX_HYPERPERIOD_TICKS
from firmware_py.scheduler.task import TaskSpec, TickInfo
from hal.errors import BenchError

LONGEST_US = 1e5
"""Largest budget: the period of the slowest tick rate, 10 Hz."""
EVERY_TICK = Polls(1)

Work = Callable[[TickInfo], object]


@dataclass(frozen=True)
class TaskRow:
    """Describes a task of an instrument.

    ``rate``: ``Polls(10)`` runs the task in every 10th tick, ``Polls(10, 3)`` three times in 10 ticks; ``None`` means
    that this bench has no device for the task. ``phase``: tick that is tried first. ``budget_us``: longest run that the
    task promises. ``deferrable``: number of ticks in a row for which it may be deferred. ``catch_up``: it runs for
    every scan of a block that arrived late. ``deadline_ticks``: tick periods after which a run counts as late.

    If ``work`` raises, the run ends: the rest of the tick's tasks are skipped and the outputs ramp to neutral
    (``Loop.run``). A task that can go on catches its ``HalError`` and reports a ``Finding``.
    """

    name: str
    work: Work
    rate: Polls | None
    budget_us: float
    phase: int = 0
    deferrable: int = 0
    catch_up: bool = False
    deadline_ticks: float = 1.0

    def with_bus(self, bus_us: float) -> TaskRow:
        """Return the row with ``bus_us``, its time on the wires, added to its budget."""
        return replace(self, budget_us=self.budget_us + bus_us)


def bind_tasks(rows: Sequence[TaskRow], tick_hz: int, budget_us: Mapping[str, float]) -> list[TaskSpec]:
    """Return the scheduler's tasks. ``budget_us`` overrides budgets by the name of a row.

    Raises ``BenchError`` for an override of an unknown task, or one outside 1 to ``LONGEST_US``, and for rates that do
    not repeat within ``MAX_HYPERPERIOD_TICKS``.
    """
    _check_budgets(rows, budget_us)
    period_us = 1e6 / tick_hz
    live = [(order, row, row.rate) for order, row in enumerate(rows)]
    load_us = np.zeros(_hyperperiod([rate for _, _, rate in live if rate is not None]))
    table: list[TaskSpec] = []
    for order, row, rate in live:
        if rate is None:
            continue
        budget = budget_us.get(row.name, row.budget_us)
        for k, tick in enumerate(_find_emptiest_ticks(load_us, rate, row.phase)):
            load_us[tick :: rate.divider] += budget
            name = row.name if rate.count == 1 else f"{row.name}_{k + 1}"
            deadline_us = row.deadline_ticks * period_us
            table.append(
                TaskSpec(name, row.work, rate.divider, tick, order, budget, deadline_us, row.catch_up, row.deferrable)
            )
    return table


def _check_budgets(rows: Sequence[TaskRow], budget_us: Mapping[str, float]) -> None:
    names = [row.name for row in rows]
    for name, value in budget_us.items():
        if name not in names:
            raise BenchError(f"[firmware.budget_us.{name}] there is no such task; tasks are {', '.join(names)}")
        if not 1.0 <= value <= LONGEST_US:
            raise BenchError(f"[firmware.budget_us.{name}] {value:g} is outside 1 to {LONGEST_US:g} us")


def _hyperperiod(rates: list[Polls]) -> int:
    ticks = math.lcm(*(rate.divider for rate in rates))
    if ticks > MAX_HYPERPERIOD_TICKS:
        dividers = ", ".join(str(rate.divider) for rate in rates if rate.divider > 1)
        raise BenchError(
            f"[device] the rates repeat only after {ticks} ticks (every {dividers} ticks); choose rates that divide "
            "one another"
        )
    return ticks


def _find_emptiest_ticks(load_us: NDArray[np.float64], rate: Polls, start: int) -> tuple[int, ...]:
    """Return the ticks for ``rate`` that carry the smallest load; of equal ones the first from ``start`` on."""

    def fullest(first: int) -> float:
        return max(float(load_us[tick :: rate.divider].max()) for tick in rate.ticks(first))

    firsts = [(start + k) % rate.divider for k in range(rate.divider)]
    return rate.ticks(min(firsts, key=fullest))
