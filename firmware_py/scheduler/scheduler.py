"""Schedules tasks cooperatively: they run to completion, in a fixed order, at dividers of one tick.

Tick k is due at t0 + k*T; the caller of ``tick`` (DAQ scans or the host clock) owns t0. After a stall whole periods
are skipped, the phase of every task is kept, and skipped runs are counted per task and reported to it (FreeRTOS kernel
issues 1339 and 1349). Each task promises a budget and a deadline as in ArduPilot's AP_Scheduler; distributions are kept
instead of maxima.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence

from firmware_py.scheduler.background import Slack
from firmware_py.scheduler.check import check_table, in_order
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.statistics import IgnoredSnapshot, SchedulerSnapshot, TaskSnapshot
from firmware_py.scheduler.task import BackgroundSpec, TaskSpec, TickInfo
from firmware_py.scheduler.ticker import Ticks
from hal.contracts import Clock

LATEST_END = 1.15
"""Latest allowed end of a tick, as a fraction of the period after its due time. A deferrable task that could end later
is deferred."""


class _LiveTask:
    """Holds a task with its counters."""

    __slots__ = (
        "budget_ns",
        "catch_up",
        "cpu",
        "cpu_in",
        "deadline_ns",
        "deferrable",
        "duration",
        "errors",
        "fn",
        "ignored_runs",
        "last_error",
        "lateness",
        "overruns",
        "put_off",
        "runs",
        "skipped",
        "slips",
        "spec",
        "waited",
    )  # fmt: skip

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.fn = spec.fn
        self.catch_up = spec.catch_up
        self.deferrable = spec.deferrable
        self.waited = 0  # ticks, since it was due
        self.budget_ns = spec.budget_ns
        self.deadline_ns = spec.deadline_ns
        self.duration = DurationHistogram()
        self.lateness = DurationHistogram()
        self.cpu = DurationHistogram()
        self.clear()

    def clear(self) -> None:
        self.runs = self.ignored_runs = self.skipped = self.overruns = self.slips = self.errors = 0
        self.put_off = 0
        self.cpu_in = 0  # runs until the next one whose CPU time is taken
        self.last_error = ""
        for histogram in (self.duration, self.lateness, self.cpu):
            histogram.clear()

    def releases(self, first: int, stop: int) -> int:
        """Return how often the task is due in the ticks first .. stop-1."""
        divider, phase = self.spec.divider, self.spec.phase
        return (stop - 1 - phase) // divider - (first - 1 - phase) // divider


class _Ignored:
    """Holds the counters of one announced one-off."""

    __slots__ = ("caught_up", "overruns", "skipped_ticks", "slips", "ticks", "worst_lateness_ns", "worst_tick_ns")

    def __init__(self) -> None:
        self.ticks = self.caught_up = self.skipped_ticks = self.overruns = self.slips = 0
        self.worst_tick_ns = self.worst_lateness_ns = 0


class Scheduler:
    """Runs a checked task table; the owner of the time base calls ``tick`` and ``catch_up``.

    Raises ``BenchError`` at construction when the budgets or deadlines of any tick of the hyperperiod do not fit.
    Thread CPU time is taken at every ``cpu_every``-th run of a task (a reading costs more than 1 us).
    """

    def __init__(
        self,
        tasks: Sequence[TaskSpec],
        clock: Clock,
        *,
        period_ns: int = 1_000_000,
        background: Sequence[BackgroundSpec] = (),
        cpu_every: int = 16,
        cpu_time_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self._hyperperiod = check_table(tasks, background, period_ns)
        self.period_ns = period_ns
        self._now_ns = clock.now_ns
        self._cpu_ns = cpu_time_ns
        self._cpu_every = cpu_every
        self._tasks = [_LiveTask(spec) for spec in in_order(tasks)]
        self._slack = Slack(background, clock.now_ns)
        self._due = [self._due_at(index, self._tasks) for index in range(self._hyperperiod)]
        late = [task for task in self._tasks if task.catch_up]
        self._due_late = [self._due_at(index, late) for index in range(self._hyperperiod)]
        self._due_beside: dict[tuple[str, ...], list[int]] = {}  # ticks of the hyperperiod, by the tasks left out
        self._released: dict[tuple[int, int, tuple[str, ...]], tuple[tuple[_LiveTask, int], ...]] = {}
        self._waiting: list[_LiveTask] = []  # put off to the next full tick
        self._done_by_ns = round(LATEST_END * period_ns)
        self._last_scan: int | None = None  # newest tick that the catch_up tasks have seen
        self._last_full = -1  # newest tick that all tasks have seen
        self._tick_duration = DurationHistogram()
        self._tick_lateness = DurationHistogram()
        self._ticks = self._caught_up = self._skipped_ticks = 0
        self._ignored: dict[str, _Ignored] = {}
        self._ignoring: list[str] = []  # reasons of the ticks to come, the next one last

    @staticmethod
    def _due_at(index: int, tasks: Sequence[_LiveTask]) -> tuple[_LiveTask, ...]:
        return tuple(task for task in tasks if index % task.spec.divider == task.spec.phase)

    # -- running -----------------------------------------------------------------------------------------

    def tick(self, due_ns: int, k: int) -> TickInfo:
        """Run all tasks due at tick ``k``, which was due at ``due_ns`` (bench clock). ``k`` must grow; a gap is a skip.

        An exception of a task is marked (``errors``, ``last_error``, a note that names task and tick) and
        goes on to the caller; the tasks that were still to run count as skipped. The scheduler stays usable.
        """
        started_ns = self._now_ns()
        lost = self._advance_scan(k)
        last_full, self._last_full = self._last_full, k
        if k - last_full > 1:
            for task in self._tasks:
                if not task.catch_up:
                    task.skipped += task.releases(last_full + 1, k)
        info = TickInfo(k, due_ns, started_ns, k - last_full - 1)
        scan_info = info if info.skipped == lost else TickInfo(k, due_ns, started_ns, lost)
        self._ticks += 1
        due = self._due[k % self._hyperperiod]
        if self._waiting:
            due = self._with_waiting(due)
        self._run(due, info, scan_info)
        return info

    def _with_waiting(self, due: tuple[_LiveTask, ...], others: Collection[str] = ()) -> tuple[_LiveTask, ...]:
        """Return the due tasks followed by the deferred ones, except ``others``, which go on waiting. A deferred task
        that is due again runs once."""
        waiting = [task for task in self._waiting if task.spec.name not in others]
        self._waiting = [task for task in self._waiting if task.spec.name in others]
        for task in waiting:
            if task in due:
                task.skipped += 1
        return (*due, *(task for task in waiting if task not in due))

    def _defer(self, task: _LiveTask, due_ns: int) -> bool:
        """Defer the deferrable ``task`` if it could end too late and has patience left. Return True if deferred."""
        if task.waited >= task.deferrable or self._now_ns() + task.budget_ns <= due_ns + self._done_by_ns:
            task.waited = 0
            return False
        task.waited += 1
        task.put_off += 1
        self._waiting.append(task)
        return True

    def catch_up(self, due_ns: int, k: int) -> TickInfo:
        """Run only the ``catch_up`` tasks for a scan that arrived late and is not the newest."""
        started_ns = self._now_ns()
        info = TickInfo(k, due_ns, started_ns, self._advance_scan(k))
        self._caught_up += 1
        self._run(self._due_late[k % self._hyperperiod], info, info, is_late=True)
        return info

    def run(self, ticks: Ticks) -> TickInfo:
        """Run the ticks that a ``Ticker`` delivered: catch up through the older ones, then run the newest in full."""
        newest = ticks.n - 1
        for i in range(newest):
            self.catch_up(ticks.due_ns + i * ticks.dt_ns, ticks.k0 + i)
        return self.tick(ticks.due_ns + newest * ticks.dt_ns, ticks.k0 + newest)

    def run_slack(self, until_ns: int) -> int:
        """Run background steps that fit before ``until_ns`` (when the next tick is due); return how many ran."""
        return self._slack.run(until_ns, -1 if self._last_scan is None else self._last_scan)

    def run_beside(self, due_ns: int, first: int, k: int, others: Collection[str], *, in_tick: bool) -> None:
        """Run what is due in the ticks ``first`` .. ``k``, except the tasks ``others``, which a compiled loop runs and
        ``adopt`` counts. ``in_tick``: this is the rest of tick ``k``, and tasks of earlier ones are skipped, as in
        ``run``; else each task runs once, and none is deferred."""
        info = TickInfo(k, due_ns, self._now_ns(), 0)
        due: list[_LiveTask] = []
        for task, releases in self._releases_beside(first, k, others):
            if in_tick and k % task.spec.divider != task.spec.phase:
                task.skipped += releases
            else:
                task.skipped += releases - 1
                due.append(task)
        tasks = tuple(due)
        if in_tick and self._waiting:
            tasks = self._with_waiting(tasks, others)
        self._run(tasks, info, info, beside=True, may_defer=in_tick)

    def _releases_beside(self, first: int, k: int, others: Collection[str]) -> tuple[tuple[_LiveTask, int], ...]:
        """Return the tasks except ``others`` that are due in the ticks ``first`` .. ``k``, each with how often. It is
        looked up, because passes beside a compiled loop are short and many."""
        key = first % self._hyperperiod, k - first, tuple(others)
        released = self._released.get(key)
        if released is None:
            each = ((task, task.releases(first, k + 1)) for task in self._tasks if task.spec.name not in others)
            released = tuple((task, releases) for task, releases in each if releases)
            if k - first < self._hyperperiod:
                self._released[key] = released
        return released

    def next_beside(self, k: int, others: Collection[str]) -> int:
        """Return the first tick after ``k`` in which ``run_beside`` has something to run."""
        period, key = self._hyperperiod, tuple(others)
        due = self._due_beside.get(key)
        if due is None:
            is_beside = [any(task.spec.name not in key for task in tasks) for tasks in self._due]
            due = self._due_beside[key] = [index for index, is_due in enumerate(is_beside) if is_due]
        if not due:
            return k + 1 + period
        begin = k + 1 - (k + 1) % period
        at = bisect_left(due, k + 1 - begin)
        return begin + (due[at] if at < len(due) else due[0] + period)

    def adopt(self, k: int, ticks: int, caught_up: int, tasks: Mapping[str, Sequence[int]]) -> None:
        """Count what a compiled loop has run since the last call, up to tick ``k``: ticks, scans that came late, and of
        each task its runs, overruns, slips, deferrals and skips. Durations it has counted in ``task_memory`` itself."""
        self._last_scan = self._last_full = k
        self._ticks += ticks
        self._caught_up += caught_up
        for task in self._tasks:
            if task.spec.name in tasks:
                runs, overruns, slips, put_off, skipped = tasks[task.spec.name]
                task.runs += runs
                task.overruns += overruns
                task.slips += slips
                task.put_off += put_off
                task.skipped += skipped

    def task_memory(self, name: str) -> tuple[DurationHistogram, DurationHistogram, int, int]:
        """Return the histograms of duration and lateness of the task ``name``, its budget and its deadline (ns)."""
        task = next(task for task in self._tasks if task.spec.name == name)
        return task.duration, task.lateness, task.budget_ns, task.deadline_ns

    @property
    def latest_end_ns(self) -> int:
        """Return how long after its tick was due a task may end before it is deferred."""
        return self._done_by_ns

    def find(self, name: str) -> TaskSpec | None:
        """Return the task ``name`` of the table, or ``None``."""
        return next((task.spec for task in self._tasks if task.spec.name == name), None)

    def is_deferred(self, name: str) -> bool:
        """Return True while the task ``name`` waits for a later tick than its own."""
        return any(task.spec.name == name for task in self._waiting)

    def defer(self, name: str, ticks: int) -> None:
        """Let the task ``name`` run in the next tick: a compiled loop has deferred it for ``ticks``."""
        for task in self._tasks:
            if task.spec.name == name and task not in self._waiting:
                task.waited = ticks
                self._waiting.append(task)

    @property
    def tick_memory(self) -> tuple[DurationHistogram, DurationHistogram]:
        """Return the histograms of the duration and the lateness of ticks."""
        return self._tick_duration, self._tick_lateness

    @property
    def is_announced(self) -> bool:
        """Return True if the next tick is an announced one-off (``ignore_next``)."""
        return bool(self._ignoring)

    def _advance_scan(self, k: int) -> int:
        """Note that tick ``k`` is being run; return how many were never run since the last one."""
        if self._last_scan is None:
            self._last_scan = self._last_full = k - 1
        last = self._last_scan
        if k <= last:
            raise ValueError(f"tick {k} after tick {last}: ticks must grow")
        self._last_scan = k
        lost = k - last - 1
        if lost:
            self._skipped_ticks += lost
            for task in self._tasks:
                if task.catch_up:
                    task.skipped += task.releases(last + 1, k)
            if self._ignoring:
                self._ignored[self._ignoring[-1]].skipped_ticks += lost
        return lost

    def _run(
        self,
        due: tuple[_LiveTask, ...],
        info: TickInfo,
        scan_info: TickInfo,
        *,
        beside: bool = False,
        is_late: bool = False,
        may_defer: bool = True,
    ) -> None:
        now_ns = self._now_ns
        ignored = self._ignored[self._ignoring[-1]] if self._ignoring and not beside else None
        if ignored and not is_late:  # what is caught up with before the announced tick belongs to it
            self._ignoring.pop()
        due_ns, k = info.due_ns, info.k
        done = 0
        try:
            for task in due:
                if task.deferrable and may_defer and self._defer(task, due_ns):
                    done += 1
                    continue
                task_info = scan_info if task.catch_up else info
                task.runs += 1
                if task.cpu_in or ignored:
                    started_ns = now_ns()
                    task.fn(task_info)
                    ended_ns = now_ns()
                    if task.cpu_in:
                        task.cpu_in -= 1
                else:
                    cpu_ns = self._cpu_ns()
                    started_ns = now_ns()
                    task.fn(task_info)
                    ended_ns = now_ns()
                    task.cpu.add(self._cpu_ns() - cpu_ns, k)
                    task.cpu_in = self._cpu_every - 1
                duration_ns = ended_ns - started_ns
                counters = task
                if ignored:
                    task.ignored_runs += 1
                    counters = ignored
                else:
                    task.duration.add(duration_ns, k)
                    task.lateness.add(started_ns - due_ns, k)
                if duration_ns > task.budget_ns:
                    counters.overruns += 1
                if ended_ns - due_ns > task.deadline_ns:
                    counters.slips += 1
                done += 1
        except BaseException as error:
            self._mark(due, done, error, k)
            raise
        finally:
            tick_ns = now_ns() - info.started_ns
            lateness_ns = info.started_ns - due_ns
            if ignored:
                ignored.caught_up += is_late
                ignored.ticks += not is_late
                ignored.worst_tick_ns = max(ignored.worst_tick_ns, tick_ns)
                ignored.worst_lateness_ns = max(ignored.worst_lateness_ns, lateness_ns)
            elif not beside:
                self._tick_duration.add(tick_ns, k)
                self._tick_lateness.add(lateness_ns, k)

    @staticmethod
    def _mark(due: tuple[_LiveTask, ...], done: int, error: BaseException, k: int) -> None:
        failed = due[done]
        failed.errors += 1
        failed.last_error = f"tick {k}: {error!r}"
        error.add_note(f"raised by task {failed.spec.name!r} in tick {k}")
        for task in due[done + 1 :]:
            task.skipped += 1
            task.waited = 0

    @property
    def skipped_ticks(self) -> int:
        """Return the number of ticks that never ran since the last ``reset``."""
        return self._skipped_ticks

    @property
    def passed_over(self) -> int:
        """Return the number of ticks that never ran or were only caught up with since the last ``reset``."""
        return self._skipped_ticks + self._caught_up

    @property
    def worst_tick_ns(self) -> int:
        """Return the duration of the longest tick since the last ``reset``."""
        return self._tick_duration.max_ns

    # -- statistics --------------------------------------------------------------------------------------

    def ignore_next(self, reason: str, ticks: int = 1) -> None:
        """Count the next ``ticks`` ticks, and what is caught up with before them, apart, under ``reason``: an announced
        one-off (warm-up, gc)."""
        self._ignored.setdefault(reason, _Ignored())
        self._ignoring = [reason] * ticks + self._ignoring

    def histograms(self) -> dict[str, DurationHistogram]:
        """Return the live histograms by name: ``tick``, ``lateness``, and the duration of each task."""
        durations = {task.spec.name: task.duration for task in self._tasks}
        return {"tick": self._tick_duration, "lateness": self._tick_lateness, **durations}

    def task_counts(self) -> dict[str, list[float]]:
        """Return a list for each task: rate in Hz, budget in us, runs, overruns, slips, skipped."""
        return {
            task.spec.name: [
                1e9 / self.period_ns / task.spec.divider,
                task.spec.budget_us,
                task.runs,
                task.overruns,
                task.slips,
                task.skipped,
            ]
            for task in self._tasks
        }

    def snapshot(self) -> SchedulerSnapshot:
        """Return all counters and percentiles since the last ``reset``, and leave them unchanged."""
        tick_hz = 1e9 / self.period_ns
        return SchedulerSnapshot(
            period_us=self.period_ns / 1000,
            ticks=self._ticks,
            caught_up=self._caught_up,
            skipped_ticks=self._skipped_ticks,
            tick_duration=self._tick_duration.distribution(),
            tick_lateness=self._tick_lateness.distribution(),
            tasks=tuple(
                TaskSnapshot(
                    name=task.spec.name,
                    rate_hz=tick_hz / task.spec.divider,
                    budget_us=task.spec.budget_us,
                    deadline_us=task.spec.deadline_us,
                    runs=task.runs,
                    ignored_runs=task.ignored_runs,
                    skipped=task.skipped,
                    put_off=task.put_off,
                    overruns=task.overruns,
                    slips=task.slips,
                    errors=task.errors,
                    last_error=task.last_error,
                    duration=task.duration.distribution(),
                    lateness=task.lateness.distribution(),
                    cpu=task.cpu.distribution(),
                )
                for task in self._tasks
            ),
            background=self._slack.snapshot(),
            ignored=tuple(
                IgnoredSnapshot(
                    reason=reason,
                    ticks=counted.ticks,
                    caught_up=counted.caught_up,
                    skipped_ticks=counted.skipped_ticks,
                    overruns=counted.overruns,
                    slips=counted.slips,
                    worst_tick_us=counted.worst_tick_ns / 1000,
                    worst_lateness_us=counted.worst_lateness_ns / 1000,
                )
                for reason, counted in self._ignored.items()
            ),
        )

    def reset(self) -> None:
        """Forget all counters and histograms; the tick number, the phases and pending ``ignore_next`` stay."""
        for task in self._tasks:
            task.clear()
        self._slack.reset()
        self._tick_duration.clear()
        self._tick_lateness.clear()
        self._ticks = self._caught_up = self._skipped_ticks = 0
        self._ignored = {reason: _Ignored() for reason in self._ignoring}
