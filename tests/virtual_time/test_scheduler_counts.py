"""What the scheduler counts, over two of everything: a counter that is set instead of added to shows at the second."""

from __future__ import annotations

import pytest

from firmware_py.scheduler import BackgroundSpec, ScanTicker, Scheduler, TaskSpec, Ticks
from hal.clock import VirtualClock
from hal.errors import BenchError
from hal.types import TimeSource
from tests.virtual_time.test_scheduler import MS, US, Bench
from tests.virtual_time.test_tickers import scan_ticker


@pytest.fixture
def bench() -> Bench:
    return Bench()


def at(bench: Bench, scheduler: Scheduler, *numbers: int) -> None:
    for k in numbers:
        bench.clock.advance_to(k * MS)
        scheduler.tick(k * MS, k)


def test_gaps_add_up(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("sense", catch_up=True), bench.task("act"))
    at(bench, scheduler, 5, 6, 8, 9, 12)  # the first number is no gap; 1 and 2 missing
    counted = scheduler.snapshot()
    assert (counted.ticks, counted.skipped_ticks) == (5, 3)
    assert [counted.task(name).skipped for name in ("sense", "act")] == [3, 3]
    assert [info.skipped for who, info in bench.journal if who == "act"] == [0, 0, 1, 0, 2]


def test_a_scan_that_was_caught_up_is_no_gap_for_who_saw_it(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("sense", catch_up=True), bench.task("act"))
    at(bench, scheduler, 0)
    for k in (2, 5):
        bench.clock.advance_to((k + 1) * MS)
        scheduler.run(Ticks(k, 2, k * MS, MS, TimeSource.DEVICE_CLOCK))
    seen = {name: [info for who, info in bench.journal if who == name] for name in ("sense", "act")}
    assert [(i.k, i.skipped, i.started_ns // MS) for i in seen["sense"]] == [
        (0, 0, 0), (2, 1, 3), (3, 0, 3), (5, 1, 6), (6, 0, 6),
    ]  # fmt: skip
    assert [(i.k, i.skipped) for i in seen["act"]] == [(0, 0), (3, 2), (6, 2)]
    counted = scheduler.snapshot()
    assert (counted.caught_up, counted.skipped_ticks, counted.task("sense").skipped) == (2, 2, 2)
    assert counted.task("act").skipped == 4


def test_deadlines_are_met_at_their_last_moment_and_slips_add_up(bench: Bench) -> None:
    cost_us = {0: 400.0, 1: 401.0, 2: 700.0}
    scheduler = bench.scheduler(
        bench.task("t", budget_us=300.0, deadline_us=400.0, cost_us=lambda k: cost_us.get(k, 1.0))
    )
    at(bench, scheduler, 0, 1, 2, 3)
    counted = scheduler.snapshot().task("t")
    assert (counted.slips, counted.overruns) == (2, 3)
    assert (counted.budget_us, counted.deadline_us) == (300.0, 400.0)
    assert scheduler.task_counts() == {"t": [1000.0, 300.0, 4, 3, 2, 0]}
    assert scheduler.snapshot().period_us == 1000.0


def test_task_counts_know_the_divider(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("slow", divider=4), period_ns=500_000)
    assert scheduler.task_counts()["slow"][0] == 500.0


def test_after_an_error_only_those_behind_it_are_skipped_and_it_adds_up(bench: Bench) -> None:
    def fail(info: object) -> None:
        raise ZeroDivisionError

    scheduler = bench.scheduler(
        bench.task("first"), bench.task("second"), TaskSpec("bad", fail, 1, 0, 1, 100.0, 1000.0),
        bench.task("last", order=2), bench.task("very last", order=2),
    )  # fmt: skip
    for k in (0, 1):
        with pytest.raises(ZeroDivisionError):
            at(bench, scheduler, k)
    counted = scheduler.snapshot()
    assert {t.name: (t.runs, t.skipped, t.errors) for t in counted.tasks} == {
        "first": (2, 0, 0), "second": (2, 0, 0), "bad": (2, 0, 2), "last": (0, 2, 0), "very last": (0, 2, 0),
    }  # fmt: skip
    assert scheduler.snapshot().task("first").last_error == ""


def test_an_error_behind_a_task_that_was_put_off_is_laid_at_the_right_door(bench: Bench) -> None:
    """One task waits, the next fails: the failure is its own, and who comes behind is skipped."""

    def fail(info: object) -> None:
        raise ZeroDivisionError

    scheduler = bench.scheduler(
        bench.task("late", cost_us=2000.0, budget_us=500.0),
        bench.task("patient", order=1, budget_us=200.0, cost_us=10.0, deferrable=1),
        TaskSpec("bad", fail, 1, 0, 2, 10.0, 1000.0),
        bench.task("behind", order=3, budget_us=10.0, cost_us=1.0),
    )
    with pytest.raises(ZeroDivisionError):
        at(bench, scheduler, 0)
    counted = scheduler.snapshot()
    assert [counted.task(n).errors for n in ("late", "patient", "bad", "behind")] == [0, 0, 1, 0]
    assert [counted.task(n).skipped for n in ("late", "patient", "bad", "behind")] == [0, 0, 0, 1]
    assert counted.task("patient").put_off == 1


def test_who_waited_once_may_wait_again_after_it_ran(bench: Bench) -> None:
    scheduler = bench.scheduler(
        bench.task("late", cost_us=2000.0, budget_us=500.0),
        bench.task("patient", divider=2, order=1, budget_us=200.0, cost_us=10.0, deferrable=1),
    )
    for k in range(0, 40, 4):  # every fourth tick, late each time; due at each
        bench.clock.advance_to(10 * k * MS)
        scheduler.tick(10 * k * MS, k)
    counted = scheduler.snapshot().task("patient")
    # put off, due again and run, put off, ...: once skipped for each time it was put off
    assert (counted.put_off, counted.runs) == (5, 5)
    assert counted.skipped == 5 + 9  # and one release in each of nine gaps


def test_a_skip_by_an_error_is_no_waiting(bench: Bench) -> None:
    failing = {"now": False}

    def may_fail(info: object) -> None:
        if failing["now"]:
            raise ZeroDivisionError

    scheduler = bench.scheduler(
        bench.task("late", cost_us=2000.0, budget_us=500.0),
        TaskSpec("bad", may_fail, 1, 0, 1, 10.0, 1000.0),
        bench.task("patient", order=2, budget_us=200.0, cost_us=10.0, deferrable=1),
    )
    at(bench, scheduler, 0)
    bench.clock.advance_to(10 * MS)
    failing["now"] = True
    with pytest.raises(ZeroDivisionError):
        scheduler.tick(10 * MS, 1)
    failing["now"] = False
    bench.clock.advance_to(20 * MS)
    scheduler.tick(20 * MS, 2)
    counted = scheduler.snapshot().task("patient")
    assert (counted.put_off, counted.runs) == (2, 0)  # it waits anew


def test_announced_one_offs_are_one_tick_and_their_gaps_add_up(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t", cost_us=lambda k: 20.0 + k))
    at(bench, scheduler, 0)
    scheduler.ignore_next("warm-up")
    at(bench, scheduler, 3)
    scheduler.ignore_next("warm-up")
    bench.clock.advance_to(5 * MS + 7 * US)
    scheduler.tick(5 * MS, 5)
    at(bench, scheduler, 6)
    (warm_up,) = scheduler.snapshot().ignored
    assert (warm_up.ticks, warm_up.skipped_ticks) == (2, 3)
    assert (warm_up.worst_tick_us, warm_up.worst_lateness_us) == (25.0, 7.0)
    scheduler.ignore_next("on time")
    at(bench, scheduler, 7)
    assert scheduler.snapshot().ignored[1].worst_lateness_us == 0.0
    assert (scheduler.snapshot().task("t").runs, scheduler.snapshot().task("t").ignored_runs) == (5, 3)


def test_what_is_caught_up_with_before_an_announced_tick_belongs_to_it(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("sense", catch_up=True), bench.task("act"))
    at(bench, scheduler, 0)
    scheduler.ignore_next("arming")
    bench.clock.advance_to(40 * MS)
    scheduler.run(Ticks(3, 38, 3 * MS, MS, TimeSource.DEVICE_CLOCK))
    at(bench, scheduler, 41)
    snapshot = scheduler.snapshot()
    (arming,) = snapshot.ignored
    assert (arming.ticks, arming.caught_up, arming.skipped_ticks) == (1, 37, 2)
    assert (snapshot.ticks, snapshot.caught_up, snapshot.skipped_ticks) == (3, 37, 2), "they are in the totals, too"
    assert arming.worst_lateness_us == 37_000.0
    assert snapshot.tick_lateness.n == 2, "ticks 0 and 41"
    assert [(snapshot.task(name).runs, snapshot.task(name).ignored_runs) for name in ("sense", "act")] == [
        (40, 38), (3, 1),
    ]  # fmt: skip


def test_histograms_by_name_say_when_the_worst_was(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("t", cost_us=lambda k: 90.0 if k == 3 else 20.0), cpu_every=1)
    at(bench, scheduler, 0, 1, 2, 3, 4)
    assert set(scheduler.histograms()) == {"tick", "lateness", "t"}
    counted = scheduler.snapshot().task("t")
    assert (counted.duration.max_us, counted.duration.max_tick) == (90.0, 3)
    assert (counted.cpu.max_us, counted.cpu.max_tick) == (90.0, 3)


def test_lateness_of_a_task_is_when_it_began(bench: Bench) -> None:
    scheduler = bench.scheduler(bench.task("a", cost_us=30.0), bench.task("b", order=1))
    at(bench, scheduler, 0, 1, 2)
    lateness = scheduler.snapshot().task("b").lateness
    assert (lateness.max_us, lateness.max_tick) == (30.0, 0)


# -- background ------------------------------------------------------------------------------------------


def test_three_generators_take_turns() -> None:
    clock, turns = VirtualClock(), []

    def steps(name: str):
        while True:
            clock.burn_ns(100 * US)
            turns.append(name)
            yield True

    background = [BackgroundSpec(n, lambda n=n: steps(n), worst_step_us=100.0) for n in "abc"]
    task = TaskSpec("t", lambda info: None, 1, 0, 0, 100.0, 1000.0)
    scheduler = Scheduler([task], clock, background=background, cpu_time_ns=clock.now_ns)
    scheduler.tick(0, 0)
    assert scheduler.run_slack(750 * US) == 7
    assert "".join(turns) == "abcabca"
    assert scheduler.run_slack(950 * US) == 2
    assert "".join(turns[7:]) == "bc"  # who had the last turn is not the first next time
    assert [b.overruns for b in scheduler.snapshot().background] == [0, 0, 0]  # exactly what was promised
    assert [b.worst_step_us for b in scheduler.snapshot().background] == [100.0] * 3
    assert [b.last_error for b in scheduler.snapshot().background] == [""] * 3


def test_a_generator_that_fails_names_the_tick_and_its_step_is_timed() -> None:
    clock = VirtualClock()

    def steps():
        clock.burn_ns(20 * US)
        yield True
        raise ZeroDivisionError

    task = TaskSpec("t", lambda info: None, 1, 0, 0, 100.0, 1000.0)
    spec = BackgroundSpec("bg", steps, worst_step_us=50.0)
    scheduler = Scheduler([task], clock, background=[spec], cpu_time_ns=clock.now_ns)
    scheduler.tick(0, 41)
    with pytest.raises(ZeroDivisionError):
        scheduler.run_slack(MS)
    (bg,) = scheduler.snapshot().background
    assert (bg.last_error[:8], bg.finished, bg.duration.max_tick) == ("tick 41:", True, 41)


@pytest.mark.parametrize("worst_us", [0.0, -1.0])
def test_a_step_must_promise_something(worst_us: float) -> None:
    with pytest.raises(BenchError, match="'bg': worst_step_us"):
        BackgroundSpec("bg", lambda: iter(()), worst_step_us=worst_us)
    assert BackgroundSpec("bg", lambda: iter(()), worst_step_us=0.5).worst_step_us == 0.5


def test_small_budgets_and_a_deadline_that_is_the_budget_are_allowed(bench: Bench) -> None:
    assert bench.task("t", budget_us=0.5, deadline_us=0.5).budget_us == 0.5
    with pytest.raises(BenchError, match="task 'named'"):
        bench.task("named", budget_us=0.0)


def test_the_edges_of_the_check_are_allowed(bench: Bench) -> None:
    step = BackgroundSpec("bg", lambda: iter(()), worst_step_us=900.0)
    bench.scheduler(bench.task("t", budget_us=100.0), background=[step])
    bench.scheduler(bench.task("slow", divider=10_000))
    with pytest.raises(BenchError, match=r"30000 ticks \(slow 10000, odd 3\)"):
        bench.scheduler(bench.task("slow", divider=10_000), bench.task("odd", divider=3))


def test_background_before_the_first_tick_has_none() -> None:
    def steps():
        raise ZeroDivisionError
        yield True

    task = TaskSpec("t", lambda info: None, 1, 0, 0, 100.0, 1000.0)
    scheduler = Scheduler([task], VirtualClock(), background=[BackgroundSpec("bg", steps, worst_step_us=50.0)])
    with pytest.raises(ZeroDivisionError):
        scheduler.run_slack(MS)
    assert scheduler.snapshot().background[0].last_error[:8] == "tick -1:"


# -- time bases ------------------------------------------------------------------------------------------


def restarting(clock: VirtualClock) -> ScanTicker:
    """A device that begins to count anew, twice; scan 5 of its second count is lost."""
    return scan_ticker(clock, (10.0, 1, 10), (11.0, 1, 11), (12.0, 2, 3), (14.0, 1, 6), (15.0, 1, 2))


def test_numbers_go_on_when_the_device_counts_anew() -> None:
    clock = VirtualClock(start_ns=9 * MS)
    ticker = restarting(clock)
    assert [(t.k0, t.n) for t in (ticker.wait() for _ in range(5))] == [(0, 1), (1, 1), (2, 2), (5, 1), (6, 1)]
    assert ticker.rebased == 2


def test_silence_counts_from_the_newest_scan_of_a_block() -> None:
    clock = VirtualClock(start_ns=2 * MS)
    ticker = scan_ticker(clock, (4.0, 4, 1))
    assert ticker.wait() == Ticks(0, 4, MS, MS, TimeSource.DEVICE_CLOCK)
    assert ticker.wait() == Ticks(6, 1, 7 * MS, MS, TimeSource.HOST)  # the newest was due at 4 ms, silent 3 ms
    assert clock.now_ns() == 7 * MS


def test_scans_after_host_ticks_that_began_the_run_are_numbered_on() -> None:
    clock = VirtualClock(start_ns=10 * MS)
    ticker = scan_ticker(clock, (15.5, 1, 15), (16.5, 1, 16))
    first = [ticker.wait() for _ in range(5)]
    assert [t.k0 for t in first] == [2, 3, 4, 5, 6]
    assert [t.source for t in first] == [TimeSource.HOST] * 3 + [TimeSource.DEVICE_CLOCK] * 2
    assert ticker.rebased == 0


def test_the_next_tick_beside_is_the_first_in_which_a_task_that_is_not_left_out_is_due(bench: Bench) -> None:
    scheduler = bench.scheduler(
        bench.task("sense"), bench.task("slow", divider=10, phase=3), bench.task("rare", divider=4, phase=1)
    )
    for k in range(-1, 45):
        due = [t for t in range(k + 1, k + 40) if t % 10 == 3 or t % 4 == 1]
        assert scheduler.next_beside(k, ("sense",)) == due[0]
        assert scheduler.next_beside(k, ("sense", "rare")) == next(t for t in due if t % 10 == 3)
        assert scheduler.next_beside(k, ("sense", "slow", "rare")) == k + 21, "none is due in the whole hyperperiod"
