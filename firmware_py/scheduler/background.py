"""Runs background tasks: generators that run in the slack between ticks, one declared step at a time.

In a loop without slack a task that has waited for ``PATIENCE_NS`` runs one step nevertheless, so that the page still
shows the loop; the tick after it comes late.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.statistics import BackgroundSnapshot
from firmware_py.scheduler.task import BackgroundSpec

PATIENCE_NS = 500_000_000
"""Longest time for which a background task waits for slack."""


class _LiveBackground:
    __slots__ = ("duration", "finished", "last_error", "last_ns", "overruns", "spec", "step", "steps", "worst_ns")

    def __init__(self, spec: BackgroundSpec) -> None:
        self.spec = spec
        self.worst_ns = spec.worst_step_ns
        self.step = spec.make().__next__
        self.duration = DurationHistogram()
        self.finished = False
        self.last_error = ""
        self.last_ns: int | None = None  # the time from which it waits
        self.clear()

    def clear(self) -> None:
        self.steps = 0
        self.overruns = 0
        self.duration.clear()


class Slack:
    """Runs background tasks in turn while a declared worst step still fits before the next tick."""

    def __init__(self, specs: Sequence[BackgroundSpec], now_ns: Callable[[], int]) -> None:
        self._live = [_LiveBackground(spec) for spec in specs]
        self._now_ns = now_ns
        self._turn = 0

    def run(self, until_ns: int, tick: int) -> int:
        """Run steps that end before ``until_ns`` if none exceeds its declared length, and one step of each task that
        has waited for ``PATIENCE_NS``. Return the number of steps.

        A task that yields False (nothing to do) is not run again before the next call; one that returns is
        finished; one that raises is marked and finished, and its exception is raised here.
        """
        waiting = [task for task in self._live[self._turn :] + self._live[: self._turn] if not task.finished]
        steps = 0
        while waiting:
            again: list[_LiveBackground] = []
            for task in waiting:
                started_ns = self._now_ns()
                if task.last_ns is None:
                    task.last_ns = started_ns
                if started_ns + task.worst_ns > until_ns and started_ns - task.last_ns < PATIENCE_NS:
                    continue
                task.last_ns = started_ns
                self._turn = (self._live.index(task) + 1) % len(self._live)
                if self._step(task, started_ns, tick):
                    again.append(task)
                steps += 1
            waiting = again
        return steps

    def _step(self, task: _LiveBackground, started_ns: int, tick: int) -> bool:
        more = False
        try:
            more = task.step()
        except StopIteration:
            task.finished = True
        except BaseException as error:
            task.finished = True
            task.last_error = f"tick {tick}: {error!r}"
            error.add_note(f"raised by background task {task.spec.name!r} after tick {tick}")
            raise
        finally:
            duration_ns = self._now_ns() - started_ns
            task.steps += 1
            task.duration.add(duration_ns, tick)
            if duration_ns > task.worst_ns:
                task.overruns += 1
        return more

    def snapshot(self) -> tuple[BackgroundSnapshot, ...]:
        return tuple(
            BackgroundSnapshot(
                name=task.spec.name,
                worst_step_us=task.spec.worst_step_us,
                steps=task.steps,
                overruns=task.overruns,
                finished=task.finished,
                last_error=task.last_error,
                duration=task.duration.distribution(),
            )
            for task in self._live
        )

    def reset(self) -> None:
        for task in self._live:
            task.clear()
