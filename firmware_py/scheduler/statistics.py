"""Defines snapshots of the scheduler's counters, whose values no longer change."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from firmware_py.scheduler.histogram import Distribution


def _as_dict(snapshot: Any, key: str) -> dict[str, object]:
    """Return all fields but ``key`` as JSON values; a distribution has its unit in its name."""
    values = {f.name: getattr(snapshot, f.name) for f in fields(snapshot) if f.name != key}
    return {
        f"{name}_us" if isinstance(value, Distribution) else name: (
            value.as_dict() if isinstance(value, Distribution) else value
        )
        for name, value in values.items()
    }


@dataclass(frozen=True, slots=True)
class TaskSnapshot:
    """Holds the statistics of one task since the last ``reset``.

    ``skipped``: releases that never ran; ``put_off``: ticks for which it was deferred; ``overruns``: runs longer than
    the budget; ``slips``: deadline misses, runs that ended after the deadline; ``errors``: runs that raised.
    ``ignored_runs`` belong to announced one-offs and are in none of the figures except ``runs``. ``cpu`` is thread CPU
    time of a sample of the runs.
    """

    name: str
    rate_hz: float
    budget_us: float
    deadline_us: float
    runs: int
    ignored_runs: int
    skipped: int
    put_off: int
    overruns: int
    slips: int
    errors: int
    last_error: str
    duration: Distribution
    lateness: Distribution
    cpu: Distribution

    def as_dict(self) -> dict[str, object]:
        """Return the snapshot in the form of the ``micron run`` JSON."""
        return _as_dict(self, "name")


@dataclass(frozen=True, slots=True)
class BackgroundSnapshot:
    """Holds the statistics of one background task. ``overruns`` are steps longer than the declared worst step."""

    name: str
    worst_step_us: float
    steps: int
    overruns: int
    finished: bool
    last_error: str
    duration: Distribution

    def as_dict(self) -> dict[str, object]:
        return _as_dict(self, "name")


@dataclass(frozen=True, slots=True)
class IgnoredSnapshot:
    """Counts the ticks of an announced one-off (``ignore_next``) apart, but does not hide them: ``caught_up`` and
    ``skipped_ticks`` are in the scheduler's totals, too."""

    reason: str
    ticks: int
    caught_up: int
    skipped_ticks: int
    overruns: int
    slips: int
    worst_tick_us: float
    worst_lateness_us: float

    def as_dict(self) -> dict[str, object]:
        return _as_dict(self, "reason")


@dataclass(frozen=True, slots=True)
class SchedulerSnapshot:
    """Holds the statistics of the whole scheduler since the last ``reset``.

    ``ticks`` ran for all tasks, ``caught_up`` ran late for the ``catch_up`` tasks only, ``skipped_ticks`` never
    ran. ``tick_duration.max_tick`` is the number of the worst tick, ``tick_lateness.max_tick`` of the latest.
    """

    period_us: float
    ticks: int
    caught_up: int
    skipped_ticks: int
    tick_duration: Distribution
    tick_lateness: Distribution
    tasks: tuple[TaskSnapshot, ...]
    background: tuple[BackgroundSnapshot, ...] = ()
    ignored: tuple[IgnoredSnapshot, ...] = field(default=())

    def task(self, name: str) -> TaskSnapshot:
        """Return the task of that name. Raises ``KeyError`` when there is none."""
        for task in self.tasks:
            if task.name == name:
                return task
        raise KeyError(name)

    def as_dict(self) -> dict[str, object]:
        """Return JSON values; ``["tasks"]`` is the ``tasks`` object of the ``micron run`` JSON."""
        return {
            "period_us": self.period_us,
            "ticks": self.ticks,
            "caught_up": self.caught_up,
            "skipped_ticks": self.skipped_ticks,
            "tick_us": {**self.tick_duration.as_dict(), "worst_tick": self.tick_duration.max_tick},
            "tick_lateness_us": {**self.tick_lateness.as_dict(), "worst_tick": self.tick_lateness.max_tick},
            "tasks": {t.name: t.as_dict() for t in self.tasks},
            "background": {b.name: b.as_dict() for b in self.background},
            "ignored": {i.reason: i.as_dict() for i in self.ignored},
        }
