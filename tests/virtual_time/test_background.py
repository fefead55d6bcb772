"""Background generators run only where their declared worst step fits before the next tick."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from firmware_py.scheduler import BackgroundSpec, Scheduler, TaskSpec
from hal.clock import VirtualClock
from hal.errors import BenchError

MS = 1_000_000
US = 1_000


class Worker:
    def __init__(self, clock: VirtualClock, cost_us: float, items: int, idle_after: int = 10**9) -> None:
        self.clock = clock
        self.cost_us = cost_us
        self.items = items
        self.idle_after = idle_after
        self.done_at_ns: list[int] = []

    def steps(self) -> Generator[bool, None, None]:
        for i in range(self.items):
            self.clock.burn_ns(round(self.cost_us * US))
            self.done_at_ns.append(self.clock.now_ns())
            yield (i + 1) % self.idle_after != 0


def make(clock: VirtualClock, *background: BackgroundSpec, tick_cost_us: float = 400.0) -> Scheduler:
    task = TaskSpec("t", lambda info: clock.burn_ns(round(tick_cost_us * US)), 1, 0, 0, tick_cost_us, 1000.0)
    return Scheduler([task], clock, background=background, cpu_time_ns=clock.now_ns)


def run_ticks(scheduler: Scheduler, clock: VirtualClock, n: int) -> None:
    for k in range(n):
        clock.advance_to(k * MS)
        assert clock.now_ns() == k * MS, "the slack ran into the tick"
        scheduler.tick(k * MS, k)
        scheduler.run_slack((k + 1) * MS)


def test_steps_fill_the_slack_and_never_delay_a_tick() -> None:
    clock = VirtualClock()
    worker = Worker(clock, cost_us=100.0, items=1000)
    scheduler = make(clock, BackgroundSpec("bg", worker.steps, worst_step_us=150.0))
    run_ticks(scheduler, clock, 10)
    # 600 us of slack: begun at 400, 500, 600, 700, 800 (ends at 950 at worst), not at 900
    (bg,) = scheduler.snapshot().background
    assert (bg.steps, bg.overruns, bg.finished) == (50, 0, False)
    assert worker.done_at_ns[:6] == [500 * US, 600 * US, 700 * US, 800 * US, 900 * US, MS + 500 * US]
    assert scheduler.snapshot().tick_lateness.max_us == 0.0


def test_an_idle_generator_waits_for_the_next_slack() -> None:
    clock = VirtualClock()
    worker = Worker(clock, cost_us=10.0, items=1000, idle_after=2)
    scheduler = make(clock, BackgroundSpec("bg", worker.steps, worst_step_us=20.0))
    run_ticks(scheduler, clock, 5)
    assert scheduler.snapshot().background[0].steps == 10


def test_two_share_by_turns_and_a_long_one_does_not_block_a_short_one() -> None:
    clock = VirtualClock()
    long, short = Worker(clock, 500.0, 100), Worker(clock, 50.0, 10_000)
    scheduler = make(clock, BackgroundSpec("long", long.steps, 500.0), BackgroundSpec("short", short.steps, 50.0))
    run_ticks(scheduler, clock, 20)
    counts = {b.name: b.steps for b in scheduler.snapshot().background}
    # each slack of 600 us: one long step, then two short ones; whoever did not run last begins the next slack
    assert counts == {"long": 20, "short": 40}


def test_a_finished_generator_is_left_alone() -> None:
    clock = VirtualClock()
    worker = Worker(clock, 100.0, items=3)
    scheduler = make(clock, BackgroundSpec("bg", worker.steps, 100.0))
    run_ticks(scheduler, clock, 4)
    (bg,) = scheduler.snapshot().background
    assert bg.finished
    assert len(worker.done_at_ns) == 3


def test_a_broken_promise_is_counted() -> None:
    clock = VirtualClock()
    worker = Worker(clock, 300.0, items=100)
    scheduler = make(clock, BackgroundSpec("bg", worker.steps, 200.0))
    scheduler.tick(0, 0)
    scheduler.run_slack(MS)
    (bg,) = scheduler.snapshot().background
    assert (bg.steps, bg.overruns, bg.duration.max_us) == (2, 2, 300.0)


def test_an_exception_is_marked_and_reaches_the_owner() -> None:
    clock = VirtualClock()

    def fails() -> Generator[bool, None, None]:
        yield True
        raise OSError("no space")

    scheduler = make(clock, BackgroundSpec("bg", fails, 100.0))
    scheduler.tick(0, 0)
    with pytest.raises(OSError, match="no space") as caught:
        scheduler.run_slack(MS)
    assert caught.value.__notes__ == ["raised by background task 'bg' after tick 0"]
    (bg,) = scheduler.snapshot().background
    assert bg.finished
    assert bg.last_error == "tick 0: OSError('no space')"
    assert scheduler.run_slack(MS) == 0


def test_a_loop_without_slack_still_runs_a_step_each_half_second() -> None:
    clock = VirtualClock()
    worker = Worker(clock, cost_us=100.0, items=1000)
    scheduler = make(clock, BackgroundSpec("bg", worker.steps, worst_step_us=150.0))
    for k in range(1300):
        clock.advance_to(k * MS)
        scheduler.tick(k * MS, k)
        clock.burn_ns(500 * US)  # the machine stands still: 900 us of each tick are gone
        scheduler.run_slack((k + 1) * MS)
    assert worker.done_at_ns == [501 * MS, 1001 * MS]
    assert clock.now_ns() == 1299 * MS + 900 * US


def test_a_step_that_never_fits_is_refused_at_start() -> None:
    clock = VirtualClock()
    worker = Worker(clock, 100.0, 1)
    with pytest.raises(
        BenchError, match="'bg' would never run: a step takes up to 700 us and the emptiest tick leaves 600 us"
    ):
        make(clock, BackgroundSpec("bg", worker.steps, 700.0))
