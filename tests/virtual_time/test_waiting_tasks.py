"""Tasks that may wait (``deferrable``): put off where the next command would be late, counted, never for long."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_py.scheduler import HostTicker, Scheduler
from hal.errors import BenchError
from tests.virtual_time.test_scheduler import MS, US, Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


def waiting_pair(bench: Bench, busy_us: Callable[[int], float], deferrable: int = 3) -> Scheduler:
    """A command that takes ``busy_us(k)`` in tick k, and a slow device of 300 us in ticks 0, 5, 10, ..."""
    return bench.scheduler(
        bench.task("command", budget_us=500.0, cost_us=busy_us),
        bench.task("slow", 5, 0, order=1, budget_us=400.0, cost_us=300.0, deferrable=deferrable),
    )


def test_a_task_that_may_wait_is_begun_only_where_its_budget_ends_in_time(bench: Bench):
    """Done by 1.15 ms after the tick was due: 0.75 ms is the last moment for a budget of 0.4 ms."""
    scheduler = waiting_pair(bench, lambda k: {0: 750.0, 5: 751.0}.get(k, 100.0))
    bench.run(scheduler, 12)
    assert bench.ran("slow") == [0, 6, 10]
    assert bench.ran("command") == list(range(12))
    slow = scheduler.snapshot().task("slow")
    assert (slow.runs, slow.put_off, slow.skipped) == (3, 1, 0)
    assert slow.as_dict()["put_off"] == 1


def test_it_waits_so_many_ticks_and_no_more(bench: Bench):
    scheduler = waiting_pair(bench, lambda k: 800.0 if k < 4 else 100.0)
    bench.run(scheduler, 5)
    assert bench.ran("slow") == [3]  # put off in 0, 1 and 2
    assert scheduler.snapshot().task("slow").put_off == 3


def test_what_is_due_again_while_it_waits_runs_once(bench: Bench):
    scheduler = bench.scheduler(
        bench.task("command", budget_us=500.0, cost_us=lambda k: 800.0 if k < 3 else 100.0),
        bench.task("slow", 2, 0, order=1, budget_us=400.0, cost_us=300.0, deferrable=9),
    )
    bench.run(scheduler, 6)
    assert bench.ran("slow") == [3, 4]
    slow = scheduler.snapshot().task("slow")
    assert (slow.put_off, slow.skipped) == (3, 1)


def test_a_late_tick_sheds_its_slow_device_instead_of_passing_its_lateness_on(bench: Bench):
    """A stall of 0.9 ms at tick 3; the next command is in time again although a slow device was due in tick 5."""
    scheduler = waiting_pair(bench, lambda k: 1900.0 if k == 3 else 500.0)
    ticker = HostTicker(bench.clock, MS, t0_ns=0)
    bench.run(scheduler, 9, ticker)
    late_us = {info.k: (info.started_ns - info.due_ns) / US for who, info in bench.journal if who == "command"}
    assert late_us[4] == 900.0
    assert late_us[5] == 400.0
    assert late_us[6] == 0.0
    assert bench.ran("slow") == [0, 6]


def test_who_must_see_every_scan_may_not_wait(bench: Bench):
    with pytest.raises(BenchError, match="deferrable is 1"):
        bench.task("filter", catch_up=True, deferrable=1)
    with pytest.raises(BenchError, match="deferrable is -1"):
        bench.task("slow", deferrable=-1)


def test_a_reset_counts_anew_what_was_put_off(bench: Bench):
    scheduler = waiting_pair(bench, lambda k: 800.0 if k < 1 else 100.0)
    bench.run(scheduler, 1)
    scheduler.reset()
    bench.run(scheduler, 3, HostTicker(bench.clock, MS, t0_ns=0, k0=1))
    assert scheduler.snapshot().task("slow").put_off == 0
    assert bench.ran("slow") == [1]


def test_what_a_compiled_loop_has_put_off_in_a_tick_waits_for_the_next_one(bench: Bench):
    """The rest of the tick must not ask again: its patience would be used up twice as fast, or it would run at once."""
    scheduler = waiting_pair(bench, lambda k: 100.0, deferrable=2)
    scheduler.defer("slow", 1)
    scheduler.run_beside(0, 0, 0, ("command", "slow"), in_tick=True)
    assert bench.ran("slow") == []
    assert scheduler.is_deferred("slow")
    scheduler.run_beside(MS, 1, 1, ("command",), in_tick=True)
    assert bench.ran("slow") == [1]
