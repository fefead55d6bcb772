"""Defines what a task promises, and what it receives when it runs."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import NamedTuple

from hal.errors import BenchError


class TickInfo(NamedTuple):
    """Tells a task about its tick. ``skipped`` ticks before this one were not run for this kind of task.

    The time that an estimator must bridge is ``(1 + skipped)`` tick periods. ``due_ns`` is when the tick (or
    its scan) was due, ``started_ns`` when the scheduler began with it; both on the bench clock.
    """

    k: int
    due_ns: int
    started_ns: int
    skipped: int


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """Describes a task of the table, which runs at the ticks k with ``k % divider == phase``, in increasing ``order``.

    ``budget_us`` is the longest run it promises, ``deadline_us`` when it must be done, counted from the due
    time of the tick. ``catch_up``: runs for every scan of a block that arrived late, not only for the newest
    (filters must see all data; an actuator must not be moved through the past). ``deferrable``: ticks in a row for
    which the task is deferred where its budget would make the next tick late; slow devices give way to the next command
    (ArduPilot's AP_Scheduler begins a task only where its time is left, too).
    """

    name: str
    fn: Callable[[TickInfo], object]
    divider: int
    phase: int
    order: int
    budget_us: float
    deadline_us: float
    catch_up: bool = False
    deferrable: int = 0

    def __post_init__(self) -> None:
        where = f"task {self.name!r}"
        if self.divider < 1:
            raise BenchError(f"{where}: divider is {self.divider}; it divides the tick rate, use 1 or more")
        if not 0 <= self.phase < self.divider:
            raise BenchError(f"{where}: phase is {self.phase}; with divider {self.divider} use 0..{self.divider - 1}")
        if not self.budget_us > 0.0:
            raise BenchError(f"{where}: budget_us is {self.budget_us}; a run takes time, promise more than 0")
        if self.deferrable < 0 or (self.deferrable and self.catch_up):
            raise BenchError(
                f"{where}: deferrable is {self.deferrable}; 0 or more, and 0 for a task that must see every scan"
            )
        if not self.deadline_us >= self.budget_us:
            raise BenchError(
                f"{where}: deadline_us {self.deadline_us} is shorter than budget_us {self.budget_us}: "
                "shorten the budget or move the deadline"
            )

    @property
    def budget_ns(self) -> int:
        return round(self.budget_us * 1000)

    @property
    def deadline_ns(self) -> int:
        return round(self.deadline_us * 1000)


@dataclass(frozen=True, slots=True)
class BackgroundSpec:
    """Describes work for the slack: ``make()`` returns a generator that does one short step per ``next``.

    It yields True when more work waits and False when it has nothing to do until the next tick.
    ``worst_step_us`` is the longest step it promises; a step is begun only if that fits before the next tick.
    """

    name: str
    make: Callable[[], Generator[bool, None, None]]
    worst_step_us: float

    def __post_init__(self) -> None:
        if not self.worst_step_us > 0.0:
            raise BenchError(
                f"background task {self.name!r}: worst_step_us is {self.worst_step_us}; promise more than 0"
            )

    @property
    def worst_step_ns(self) -> int:
        return round(self.worst_step_us * 1000)
