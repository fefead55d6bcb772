"""Scheduler logic in virtual time: every figure is exact. Tasks cost time by moving the clock."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from firmware_py.scheduler import HostTicker, Scheduler, TaskSpec, TickInfo, Ticks
from hal.clock import MonotonicClock, VirtualClock
from hal.errors import BenchError
from hal.types import TimeSource

MS = 1_000_000
US = 1_000


class Bench:
    """A virtual clock, tasks with costs, and a journal of what ran."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.journal: list[tuple[str, TickInfo]] = []
        self.cost_ns: dict[str, Callable[[int], int]] = {}

    def task(
        self,
        name: str,
        divider: int = 1,
        phase: int = 0,
        order: int = 0,
        budget_us: float = 100.0,
        deadline_us: float = 1000.0,
        cost_us: float | Callable[[int], float] = 50.0,
        catch_up: bool = False,
        deferrable: int = 0,
    ) -> TaskSpec:
        def fn(info: TickInfo) -> None:
            self.journal.append((name, info))
            self.clock.burn_ns(round((cost_us(info.k) if callable(cost_us) else cost_us) * US))

        return TaskSpec(name, fn, divider, phase, order, budget_us, deadline_us, catch_up, deferrable)

    def scheduler(self, *tasks: TaskSpec, **options: object) -> Scheduler:
        return Scheduler(tasks, self.clock, cpu_time_ns=self.clock.now_ns, **options)  # type: ignore[arg-type]

    def run(self, scheduler: Scheduler, until_ms: float, ticker: HostTicker | None = None) -> None:
        ticker = ticker or HostTicker(self.clock, MS, t0_ns=self.clock.now_ns())
        while True:
            ticks = ticker.wait()
            if ticks.due_ns >= until_ms * MS:
                return
            scheduler.run(ticks)

    def ran(self, name: str) -> list[int]:
        return [info.k for who, info in self.journal if who == name]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_tasks_run_in_order_at_their_dividers_and_phases(bench: Bench) -> None:
    scheduler = bench.scheduler(
        bench.task("act", order=2),
        bench.task("slow", divider=4, phase=3, order=1),
        bench.task("sense", order=0),
        bench.task("also second", order=1, divider=2),
    )
    bench.run(scheduler, until_ms=8)
    names = [[who for who, info in bench.journal if info.k == k] for k in range(8)]
    assert (
        names
        == [
            ["sense", "also second", "act"],
            ["sense", "act"],
            ["sense", "also second", "act"],
            ["sense", "slow", "act"],
        ]
        * 2
    )
    assert [info.due_ns for who, info in bench.journal if who == "sense"] == [k * MS for k in range(8)]


def test_equal_order_runs_as_written(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("b"), bench.task("a"))
    scheduler.tick(0, 0)
    assert [who for who, _ in bench.journal] == ["b", "a"]


def test_a_stall_of_8_ms_gives_one_late_tick_and_7_skipped(bench: Bench) -> None:
    stall = {20: 8000.0}
    scheduler = bench.scheduler(
        bench.task("work", cost_us=lambda k: stall.get(k, 300.0), budget_us=400.0),
        bench.task("tenth", divider=10, phase=5, cost_us=0.0),
        bench.task("even", divider=2, phase=0, cost_us=0.0),
    )
    bench.run(scheduler, until_ms=40)
    work = [info for who, info in bench.journal if who == "work"]
    # the stalled tick began on time; exactly at 28 ms tick 28 is due again
    assert [i.k for i in work] == [*range(21), *range(28, 40)]
    assert [i.skipped for i in work if i.skipped] == [7]
    assert next(i for i in work if i.skipped).k == 28
    snapshot = scheduler.snapshot()
    assert snapshot.skipped_ticks == 7
    assert (snapshot.task("work").runs, snapshot.task("work").skipped) == (33, 7)
    assert snapshot.task("tenth").skipped == 1  # 25
    assert snapshot.task("even").skipped == 3  # 22, 24, 26
    assert bench.ran("tenth") == [5, 15, 35]  # phase kept
    assert bench.ran("even") == [*range(0, 21, 2), *range(28, 40, 2)]
    assert all(i.due_ns == i.k * MS for i in work)


def test_a_stall_between_ticks_makes_one_tick_late(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("work", cost_us=300.0, budget_us=400.0))
    ticker = HostTicker(bench.clock, MS, t0_ns=0)
    bench.run(scheduler, until_ms=10, ticker=ticker)  # leaves at 10.0 ms with tick 10 delivered, not run
    bench.clock.burn_ns(8 * MS + 250 * US)
    bench.run(scheduler, until_ms=30, ticker=ticker)
    work = [info for _, info in bench.journal]
    late = [(i.k, i.started_ns - i.due_ns, i.skipped) for i in work if i.started_ns > i.due_ns]
    assert late == [(18, 250 * US, 8)]  # tick 10 was taken from the ticker above, 11..17 by the stall
    assert scheduler.snapshot().tick_lateness.max_us == 250.0
    assert scheduler.snapshot().tick_lateness.max_tick == 18


def test_overruns_and_slips_are_counted_apart(bench: Bench) -> None:
    costs = {3: 101.0, 5: 100.0, 7: 350.0}
    scheduler = bench.scheduler(
        bench.task("first", cost_us=lambda k: costs.get(k, 10.0), budget_us=100.0, deadline_us=400.0),
        bench.task("second", order=1, cost_us=60.0, budget_us=100.0, deadline_us=400.0),
    )
    bench.run(scheduler, until_ms=10)
    first, second = scheduler.snapshot().task("first"), scheduler.snapshot().task("second")
    assert (first.overruns, first.slips) == (2, 0)  # 101 and 350; exactly 100 keeps the promise
    assert (second.overruns, second.slips) == (0, 1)  # pushed past its deadline by the first: 350 + 60
    assert (first.duration.max_us, first.duration.max_tick) == (350.0, 7)
    assert scheduler.snapshot().tick_duration.max_us == 410.0
    assert scheduler.snapshot().tick_duration.max_tick == 7


def test_lateness_of_a_later_task_counts_from_the_tick(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("first", cost_us=70.0), bench.task("second", order=1))
    scheduler.tick(0, 0)
    assert scheduler.snapshot().task("first").lateness.max_us == 0.0
    assert scheduler.snapshot().task("second").lateness.max_us == 70.0


def test_cpu_time_is_taken_at_every_nth_run(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t", cost_us=lambda k: 10.0 * k), cpu_every=4)
    for k in range(10):
        scheduler.tick(k * MS, k)
    cpu = scheduler.snapshot().task("t").cpu
    assert cpu.n == 3  # runs 0, 4, 8
    assert (cpu.min_us, cpu.max_us) == (0.0, 80.0)
    assert cpu.mean_us == pytest.approx(40.0)


@pytest.mark.parametrize("start", [2**31 - 5, 2**32 - 5, 2**53 - 5])
def test_counters_pass_the_integer_widths(bench: Bench, start: int) -> None:
    scheduler = bench.scheduler(bench.task("t", cost_us=0.0), bench.task("third", divider=3, phase=1, cost_us=0.0))
    for k in range(start, start + 10):
        scheduler.tick(k * MS, k)
    assert bench.ran("t") == list(range(start, start + 10))
    assert bench.ran("third") == [k for k in range(start, start + 10) if k % 3 == 1]
    assert scheduler.snapshot().skipped_ticks == 0
    scheduler.tick((start + 20) * MS, start + 20)
    assert scheduler.snapshot().skipped_ticks == 10
    expected = sum(k % 3 == 1 for k in range(start + 10, start + 20))
    assert scheduler.snapshot().task("third").skipped == expected


def test_ticks_must_grow(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t"))
    scheduler.tick(0, 4)
    with pytest.raises(ValueError, match="tick 4 after tick 4"):
        scheduler.tick(0, 4)


def test_a_late_block_is_caught_up_by_sense_and_run_once_by_the_rest(bench: Bench) -> None:
    scheduler = bench.scheduler(
        bench.task("sense", catch_up=True, cost_us=0.0),
        bench.task("act", order=1, cost_us=0.0),
        bench.task("half", order=2, divider=2, phase=1, cost_us=0.0),
    )
    scheduler.tick(0, 0)
    for k in range(2, 5):  # scan 1 was lost, 2..4 arrive late, 5 is the newest
        scheduler.catch_up(k * MS, k)
    scheduler.tick(5 * MS, 5)
    scheduler.tick(6 * MS, 6)
    assert bench.ran("sense") == [0, 2, 3, 4, 5, 6]
    assert bench.ran("act") == [0, 5, 6]
    assert bench.ran("half") == [5]
    skipped = {(who, i.k): i.skipped for who, i in bench.journal if i.skipped}
    assert skipped == {("sense", 2): 1, ("act", 5): 4, ("half", 5): 4}
    snapshot = scheduler.snapshot()
    assert (snapshot.ticks, snapshot.caught_up, snapshot.skipped_ticks) == (3, 3, 1)
    assert snapshot.task("sense").skipped == 1
    assert snapshot.task("act").skipped == 4
    assert snapshot.task("half").skipped == 2  # 1 and 3


def test_a_block_of_scans_from_a_ticker_is_run_by_that_policy(bench: Bench) -> None:
    scheduler = bench.scheduler(
        bench.task("sense", catch_up=True, cost_us=0.0),
        bench.task("act", order=1, cost_us=0.0),
    )
    newest = scheduler.run(Ticks(7, 3, 70 * MS, 2 * MS, TimeSource.DEVICE_CLOCK))
    assert (newest.k, newest.due_ns, newest.skipped) == (9, 74 * MS, 2)
    assert (scheduler.snapshot().task("act").skipped, scheduler.snapshot().skipped_ticks) == (2, 0)
    assert [(who, i.k, i.due_ns // MS) for who, i in bench.journal] == [
        ("sense", 7, 70),
        ("sense", 8, 72),
        ("sense", 9, 74),
        ("act", 9, 74),
    ]


def test_an_exception_is_marked_and_reaches_the_owner(bench: Bench) -> None:
    def fail(info: TickInfo) -> None:
        if info.k == 3:
            raise RuntimeError("sensor gone")

    scheduler = bench.scheduler(
        TaskSpec("fails", fail, 1, 0, 0, 100.0, 500.0), bench.task("after", order=1, cost_us=0.0)
    )
    for k in range(3):
        scheduler.tick(k * MS, k)
    with pytest.raises(RuntimeError, match="sensor gone") as caught:
        scheduler.tick(3 * MS, 3)
    assert caught.value.__notes__ == ["raised by task 'fails' in tick 3"]
    fails, after = scheduler.snapshot().task("fails"), scheduler.snapshot().task("after")
    assert (fails.errors, fails.runs) == (1, 4)
    assert fails.last_error == "tick 3: RuntimeError('sensor gone')"
    assert (after.runs, after.skipped) == (3, 1)
    scheduler.tick(4 * MS, 4)  # the owner may go on, for instance to ramp down
    assert bench.ran("after") == [0, 1, 2, 4]
    assert scheduler.snapshot().skipped_ticks == 0


def test_snapshot_changes_nothing_and_reset_is_explicit(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t", divider=3, phase=2, cost_us=200.0))
    bench.run(scheduler, until_ms=12)
    assert scheduler.snapshot() == scheduler.snapshot()
    assert scheduler.snapshot().task("t").overruns == 4
    scheduler.reset()
    cleared = scheduler.snapshot()
    assert (cleared.ticks, cleared.task("t").runs, cleared.task("t").overruns) == (0, 0, 0)
    assert cleared.task("t").duration.n == 0
    scheduler.tick(12 * MS, 12)
    scheduler.tick(14 * MS, 14)
    assert bench.ran("t") == [2, 5, 8, 11, 14]  # phase and tick number survive the reset
    assert scheduler.snapshot().skipped_ticks == 1


def test_announced_one_offs_are_counted_apart_and_shown(bench: Bench) -> None:
    costs = {2: 900.0, 3: 700.0}
    scheduler = bench.scheduler(
        bench.task("t", cost_us=lambda k: costs.get(k, 20.0), budget_us=100.0, deadline_us=800.0)
    )
    scheduler.tick(0, 0)
    scheduler.tick(1 * MS, 1)
    scheduler.ignore_next("gc", ticks=2)
    for k in (2, 3, 4):
        bench.clock.advance_to(k * MS)
        scheduler.tick(k * MS, k)
    snapshot = scheduler.snapshot()
    task = snapshot.task("t")
    assert (task.runs, task.ignored_runs, task.overruns, task.slips) == (5, 2, 0, 0)
    assert (task.duration.n, task.duration.max_us) == (3, 20.0)
    assert snapshot.tick_duration.max_us == 20.0
    (gc,) = snapshot.ignored
    assert (gc.reason, gc.ticks, gc.overruns, gc.slips, gc.worst_tick_us) == ("gc", 2, 2, 1, 900.0)


def test_skips_in_an_ignored_tick_still_count(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t"))
    scheduler.tick(0, 0)
    scheduler.ignore_next("gc")
    scheduler.tick(4 * MS, 4)
    snapshot = scheduler.snapshot()
    assert snapshot.skipped_ticks == snapshot.task("t").skipped == snapshot.ignored[0].skipped_ticks == 3


def test_json_form_has_the_keys_of_the_run_report(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t", divider=2))
    scheduler.tick(0, 0)
    task = scheduler.snapshot().as_dict()["tasks"]["t"]  # type: ignore[index]
    assert task["rate_hz"] == 500.0
    assert {"rate_hz", "runs", "budget_us", "duration_us", "cpu_us", "lateness_us", "overruns", "skipped"} <= set(task)
    assert {"p50", "p99", "p99_9", "max"} <= set(task["duration_us"])


class TestStaticCheck:
    def test_budgets_must_fit_every_tick(self, bench: Bench) -> None:
        with pytest.raises(BenchError) as caught:
            bench.scheduler(
                bench.task("sense", budget_us=500.0),
                bench.task("report", divider=4, phase=2, budget_us=300.0, order=2, deadline_us=4000.0),
                bench.task("supervise", divider=6, phase=0, budget_us=300.0, order=1, deadline_us=4000.0),
            )
        # k % 4 == 2 and k % 6 == 0 first meet at 6
        assert "do not fit tick 6 of 12: sense 500 + supervise 300 + report 300 = 1100 us > 1000 us" in str(
            caught.value
        )

    def test_a_phase_apart_makes_it_fit(self, bench: Bench) -> None:
        bench.scheduler(
            bench.task("sense", budget_us=500.0),
            bench.task("report", divider=4, phase=2, budget_us=300.0),
            bench.task("supervise", divider=6, phase=1, budget_us=300.0),
        )

    def test_deadlines_follow_from_the_budgets_before(self, bench: Bench) -> None:
        with pytest.raises(
            BenchError,
            match=r"'act' cannot meet its deadline of 250 us in tick 4 of 5: "
            r"sense 100 \+ slow 100 \+ act 100 = 300 us",
        ):
            bench.scheduler(
                bench.task("sense"),
                bench.task("act", order=2, deadline_us=250.0),
                bench.task("slow", divider=5, phase=4, order=1),
                bench.task("last", order=3),
            )

    def test_exactly_full_is_accepted(self, bench: Bench) -> None:
        bench.scheduler(bench.task("a", budget_us=600.0), bench.task("b", budget_us=400.0))

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"divider": 0}, "divider is 0"),
            ({"divider": 4, "phase": 4}, "phase is 4; with divider 4 use 0..3"),
            ({"phase": -1}, "phase is -1"),
            ({"budget_us": 0.0}, "budget_us is 0.0"),
            ({"budget_us": float("nan")}, "budget_us is nan"),
            ({"deadline_us": 50.0}, "deadline_us 50.0 is shorter than budget_us 100.0"),
        ],
    )
    def test_a_wrong_row_is_named(self, bench: Bench, change: dict[str, float], says: str) -> None:
        with pytest.raises(BenchError, match=says):
            bench.task("t", **change)  # type: ignore[arg-type]

    def test_names_are_unique(self, bench: Bench) -> None:
        with pytest.raises(BenchError, match="two tasks are called 't'"):
            bench.scheduler(bench.task("t"), bench.task("t"))

    def test_an_endless_hyperperiod_is_refused(self, bench: Bench) -> None:
        with pytest.raises(BenchError, match="only after 1022117 ticks"):
            bench.scheduler(bench.task("a", divider=1009), bench.task("b", divider=1013))

    def test_an_empty_table_is_refused(self, bench: Bench) -> None:
        with pytest.raises(BenchError, match="empty"):
            bench.scheduler()


@pytest.mark.realtime
def test_bookkeeping_runs_on_the_real_clock() -> None:
    """The same scheduler on the monotonic clock: counts, never times."""
    seen: list[int] = []
    scheduler = Scheduler([TaskSpec("t", lambda info: seen.append(info.k), 1, 0, 0, 500.0, 900.0)], MonotonicClock())
    ticker = HostTicker(MonotonicClock(), MS, t0_ns=time.monotonic_ns())
    while len(seen) < 20:
        scheduler.run(ticker.wait())
    snapshot = scheduler.snapshot()
    assert snapshot.ticks == 20
    assert seen == sorted(set(seen))
    assert snapshot.skipped_ticks == seen[-1] - seen[0] + 1 - 20


# -- what may wait ----------------------------------------------------------------------------------------
