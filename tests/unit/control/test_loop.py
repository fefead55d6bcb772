"""The loop with an instrument that is none of ours: arming, holds, the end, and who is told. It has one task."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import pytest

from firmware_py.run.context import Run
from firmware_py.run.findings import Finding
from firmware_py.run.loop import Loop
from firmware_py.run.safety import SafetyLimits, SelfTestLimits, State
from firmware_py.run.tasks import EVERY_TICK, TaskRow, bind_tasks
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.task import TickInfo
from firmware_py.scheduler.ticker import HostTicker, Ticks
from hal.clock import VirtualClock
from hal.errors import BenchError, HalTimeout
from tests.unit.control.stand import MS, Events, StandOutput

LIMITS = SafetyLimits(hold_ms=50.0, hold_limit_ms=200.0)


class Lamp:
    """A lamp that must be warm before it is armed. ``ticks`` are those that ran while it was free to move."""

    def __init__(self, run: Run, *, self_test: SelfTestLimits | None, at: dict[int, Callable[[Lamp], None]]) -> None:
        self.run = run
        self.self_test = self_test
        self.budget_us: dict[str, float] = {}
        self.closed: list[str] = []
        self.closers: Sequence[Callable[[], object]] = (lambda: self.closed.append("lamp"), self._fail)
        self.tasks: Sequence[TaskRow] = (TaskRow("shine", self._shine, EVERY_TICK, 100.0),)
        self.states: list[State] = []
        self.cold = ""
        self._at = at
        self._ticker = HostTicker(run.clock, run.period_ns, 0)

    def _fail(self) -> None:
        raise HalTimeout("the lamp's socket does not answer")

    def _shine(self, info: TickInfo) -> None:
        self.states.append(self.run.supervisor.state)
        if act := self._at.get(info.k):
            act(self)
        if not self.run.supervisor.may_move:
            self.run.step_ramp()

    def prepare(self) -> None: ...
    def running(self) -> AbstractContextManager[object]:
        return contextlib.nullcontext()

    def start(self) -> None:
        self._ticker = HostTicker(self.run.clock, self.run.period_ns, self.run.clock.now_ns())

    def wait(self) -> Ticks | None:
        return self._ticker.wait()

    def poll(self) -> Ticks | None:
        return None

    def inspect_ticks(self, ticks: Ticks) -> None: ...
    def rest(self) -> None: ...
    def repair(self) -> None: ...

    def waiting_for(self) -> list[str]:
        return [self.cold] if self.cold else []

    def numbers(self) -> dict[str, object]:
        return {"lamp": "on"}

    def histograms(self) -> dict[str, DurationHistogram]:
        return {}

    def report(self) -> dict[str, Any]:
        return {}


def lamp(
    *,
    output: bool = True,
    self_test: SelfTestLimits | None = None,
    told: list[dict[str, Any]] | None = None,
    **at: Callable[[Lamp], None],
) -> Lamp:
    """A lamp that runs for half a second; ``tick_N`` is called in tick N."""
    sink = told.append if told is not None else None
    run = Run(VirtualClock(), MS, StandOutput() if output else None, LIMITS, recorder=Events(), on_status=sink)
    made = Lamp(run, self_test=self_test, at={int(name.removeprefix("tick_")): act for name, act in at.items()})
    Loop(run, made).run(0.5)
    return made


def length_s(made: Lamp) -> float:
    trip = made.run.supervisor.trip_cause
    assert trip is not None
    assert made.run.armed_ns is not None
    return (trip.t_ns - made.run.armed_ns) * 1e-9


@pytest.mark.parametrize("output", [True, False])
def test_it_runs_at_once_for_its_time_and_ends_safe_with_and_without_an_output(output: bool) -> None:
    told: list[dict[str, Any]] = []
    made = lamp(output=output, told=told)
    supervisor = made.run.supervisor
    assert supervisor.trip_cause is not None
    assert supervisor.trip_cause.finding is Finding.FINISHED
    assert supervisor.safe_reached
    assert made.run.safe_reached_ns is not None
    assert length_s(made) == pytest.approx(0.5, abs=0.001)
    assert made.states.count(State.RUNNING) == pytest.approx(500, abs=1)
    assert made.closed == ["lamp"]
    assert made.run.incidents.error is None, "an error after the safe state is not the run's"
    assert [status["lamp"] for status in told] == ["on"] * 3


def test_it_is_armed_after_its_self_test() -> None:
    made = lamp(self_test=SelfTestLimits(watch_ms=80.0))
    assert made.states[:80] == [State.SELF_TEST] * 80
    assert made.states[82] is State.RUNNING


def test_a_self_test_names_what_it_waits_for() -> None:
    def cool(made: Lamp) -> None:
        made.cold = "the lamp is cold"

    made = lamp(self_test=SelfTestLimits(watch_ms=80.0, limit_ms=300.0), tick_10=cool)
    trip = made.run.supervisor.trip_cause
    assert trip is not None
    assert trip.reason == "self-test: the lamp is cold after 300 ms"
    assert State.RUNNING not in made.states


@pytest.mark.parametrize("output", [True, False])
def test_a_hold_passes_and_the_run_goes_on(output: bool) -> None:
    def silence(made: Lamp) -> None:
        made.run.incidents.report(Finding.SAMPLES_MISSING, device="lamp", limit_ms=5.0)

    made = lamp(output=output, tick_100=silence)
    (hold,) = made.run.supervisor.holds
    assert hold.resumed
    assert hold.end_ns is not None
    assert (hold.end_ns - hold.t_ns) * 1e-6 == pytest.approx(50.0, abs=2.0)
    assert hold.neutral_ns is not None
    assert made.states[-30] is State.RUNNING
    assert isinstance(made.run.recorder, Events)
    assert [event["event"] for event in made.run.recorder.events] == ["hold begins", "hold ends", "safe state"]


@pytest.mark.parametrize("output", [True, False])
def test_a_hold_whose_cause_stays_ends_the_run(output: bool) -> None:
    def cool(made: Lamp) -> None:
        made.cold = "the lamp is cold"
        made.run.incidents.report(Finding.SAMPLES_MISSING, device="lamp", limit_ms=5.0)

    made = lamp(output=output, tick_100=cool)
    trip = made.run.supervisor.trip_cause
    assert trip is not None
    assert trip.finding is Finding.HOLD_TOO_LONG
    assert "then the lamp is cold" in trip.reason
    assert length_s(made) == pytest.approx(0.3, abs=0.005)


def test_an_error_of_a_device_and_one_of_the_program_end_in_the_safe_state() -> None:
    def break_device(made: Lamp) -> None:
        raise HalTimeout("no answer")

    made = lamp(tick_5=break_device)
    assert made.run.supervisor.state is State.SAFE
    assert isinstance(made.run.incidents.error, HalTimeout)

    kept: list[Lamp] = []

    def break_program(made: Lamp) -> None:
        kept.append(made)
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        lamp(tick_5=break_program)
    trip = kept[0].run.supervisor.trip_cause
    assert trip is not None
    assert trip.finding is Finding.FIRMWARE_FAILED
    assert kept[0].run.supervisor.state is State.SAFE


def test_a_signal_ends_the_run() -> None:
    def interrupt(made: Lamp) -> None:
        made.run.signals.interrupted = "SIGTERM"

    trip = lamp(tick_20=interrupt).run.supervisor.trip_cause
    assert trip is not None
    assert trip.reason == "stopped by the operator (SIGTERM)"


def test_budgets_of_a_table_are_checked_by_name() -> None:
    rows = [TaskRow("shine", print, EVERY_TICK, 100.0), TaskRow("cool", print, None, 50.0)]
    assert [task.name for task in bind_tasks(rows, 1000, {"cool": 20.0})] == ["shine"]
    with pytest.raises(BenchError, match="no such task; tasks are shine, cool"):
        bind_tasks(rows, 1000, {"heat": 20.0})
    with pytest.raises(BenchError, match="outside 1 to"):
        bind_tasks(rows, 1000, {"shine": 0.5})
