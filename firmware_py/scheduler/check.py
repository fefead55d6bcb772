"""Checks, before anything runs, that the promises of a task table fit every tick.

ArduPilot finds out in flight (AP_Scheduler, pull request 12324); a table of fixed dividers can be checked once,
over the least common multiple of the dividers (the hyperperiod).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_py.scheduler.task import BackgroundSpec, TaskSpec
from hal.errors import BenchError

MAX_HYPERPERIOD_TICKS = 10_000
BUDGET = "a budget ([firmware.budget_us])"


def check_table(tasks: Sequence[TaskSpec], background: Sequence[BackgroundSpec], period_ns: int) -> int:
    """Refuse a table that cannot keep its promises; return the hyperperiod in ticks.

    Tasks that may wait are put off as the scheduler puts them off; they must find a tick within their patience.
    Raises ``BenchError`` with the arithmetic: which tick, which tasks, which sum.
    """
    if not tasks:
        raise BenchError("the task table is empty: nothing to schedule")
    _refuse_duplicates([t.name for t in tasks] + [b.name for b in background])
    hyperperiod = math.lcm(*(t.divider for t in tasks))
    if hyperperiod > MAX_HYPERPERIOD_TICKS:
        dividers = ", ".join(f"{t.name} {t.divider}" for t in tasks)
        raise BenchError(
            f"the dividers repeat only after {hyperperiod} ticks ({dividers}); "
            f"choose dividers with a common multiple of at most {MAX_HYPERPERIOD_TICKS}"
        )
    ordered = [task for task in in_order(tasks) if not task.deferrable]
    load_ns = np.zeros(hyperperiod, dtype=np.int64)
    for task in ordered:
        due = load_ns[task.phase :: task.divider]
        due += task.budget_ns
        worst = task.phase + task.divider * int(np.argmax(due))
        if load_ns[worst] > task.deadline_ns:
            raise BenchError(
                f"task {task.name!r} cannot meet its deadline of {task.deadline_us:g} us in tick {worst} "
                f"of {hyperperiod}: {_sum_text(ordered, worst, upto=task)}. Lower tick_hz or {BUDGET}, or move "
                "a phase or an order"
            )
    worst = int(np.argmax(load_ns))
    if load_ns[worst] > period_ns:
        raise BenchError(
            f"the budgets do not fit tick {worst} of {hyperperiod}: {_sum_text(ordered, worst)} "
            f"> {period_ns / 1000:g} us. Lower tick_hz or {BUDGET}, or move a phase"
        )
    load_ns = _with_waiting(load_ns, [task for task in in_order(tasks) if task.deferrable], period_ns)
    slack_ns = period_ns - int(load_ns.min())
    for item in background:
        if item.worst_step_ns > slack_ns:
            raise BenchError(
                f"background task {item.name!r} would never run: a step takes up to {item.worst_step_us:g} us and "
                f"the emptiest tick leaves {slack_ns / 1000:g} us. Make its steps shorter"
            )
    return hyperperiod


def _with_waiting(load_ns: NDArray[np.int64], tasks: Sequence[TaskSpec], period_ns: int) -> NDArray[np.int64]:
    """Return ``load_ns`` with each task that may wait in the first tick from its own on that has room for it."""
    hyperperiod = len(load_ns)
    full_ns = load_ns.copy()
    waiting: dict[str, tuple[TaskSpec, int]] = {}
    for tick in range(2 * hyperperiod):  # what waits at the end of the first round runs in the second
        index = tick % hyperperiod
        full_ns[index] = load_ns[index]
        due = {task.name: (task, 0) for task in tasks if tick % task.divider == task.phase}
        for name, (task, waited) in {**due, **{n: w for n, w in waiting.items() if n not in due}}.items():
            waiting.pop(name, None)
            if full_ns[index] + task.budget_ns <= period_ns:
                full_ns[index] += task.budget_ns
            elif waited < task.deferrable:
                waiting[name] = task, waited + 1
            else:
                raise BenchError(
                    f"task {name!r} finds no room of {task.budget_us:g} us within {task.deferrable} ticks of the one "
                    f"in which it is due (tick {index} of {hyperperiod} is full with {full_ns[index] / 1000:g} of "
                    f"{period_ns / 1000:g} us). Lower a rate of the bench file, or {BUDGET}"
                )
    return full_ns


def in_order(tasks: Sequence[TaskSpec]) -> list[TaskSpec]:
    """Return the tasks in the order of execution within a tick: by ``order``, then as written."""
    return sorted(tasks, key=lambda t: t.order)


def _sum_text(ordered: Sequence[TaskSpec], tick: int, upto: TaskSpec | None = None) -> str:
    due: list[TaskSpec] = []
    for task in ordered:
        if tick % task.divider == task.phase:
            due.append(task)
        if task is upto:
            break
    terms = " + ".join(f"{t.name} {t.budget_us:g}" for t in due)
    return f"{terms} = {sum(t.budget_ns for t in due) / 1000:g} us"


def _refuse_duplicates(names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise BenchError(f"two tasks are called {name!r}: give each its own name")
