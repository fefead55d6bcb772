"""What the watch says of impossible readings, of the room, the button, and outputs that are not as they were told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.watch import Watch
from firmware_py.frame import LAYOUT, STATUS, SUPPLY, TEMPERATURE, FrameStatus
from firmware_py.guardian.heart import Heart, Why
from firmware_py.run.findings import CauseClass
from firmware_py.run.incidents import Incidents, LoopCounts
from firmware_py.run.safety import SafetyLimits, State, Supervisor
from firmware_py.scheduler.task import TickInfo
from hal.clock import VirtualClock
from hal.errors import HalTimeout

WIDTH = max(column.start + column.size for column in LAYOUT)


@pytest.mark.parametrize(
    ("taken", "look", "says"),
    [
        (False, "verify_output", "piezo: output 1 holds 50 V and was told 29 V; check its supply and the bus"),
        (True, "verify_output", "piezo: the host stood still: the guardian has the outputs"),
        (False, "monitor_output", "piezo: output 1 is at 50 V"),
        (True, "monitor_output", "piezo: the host stood still: the guardian has the outputs"),
    ],
)
def test_an_output_that_the_guardian_has_moved_is_not_the_amplifiers_fault(taken: bool, look: str, says: str) -> None:
    supervisor = Supervisor(cast(Any, SimpleNamespace()))
    supervisor.state = State.RUNNING
    incidents = Incidents(supervisor, LoopCounts(), VirtualClock(), None)
    heart = Heart()
    if taken:
        heart.take(Why.SILENT, 7)
    devices = SimpleNamespace(
        amplifier=SimpleNamespace(name="piezo"),
        verify_output=lambda: "output 1 holds 50 V and was told 29 V",
        monitor=SimpleNamespace(poll=lambda: "output 1 is at 50 V", forget=lambda: None, name="monitor"),
        guardian=SimpleNamespace(heart=heart),
    )
    config = SimpleNamespace(safety=SimpleNamespace(monitor_ms=100.0))
    watch = Watch(cast(Any, devices), cast(Any, config), cast(Any, None), cast(Any, None), supervisor, incidents)
    getattr(watch, look)(cast(TickInfo, SimpleNamespace(due_ns=0, k=0)))
    if taken:  # the guardian gives them back
        assert supervisor.holds[0].reason.startswith(says)
        assert supervisor.holds[0].cause is CauseClass.HOST
    else:
        assert supervisor.trip_cause is not None
        assert supervisor.trip_cause.reason.startswith(says)


class Watched:
    """A watch over a bench of fakes; ``supervise`` and what was said."""

    def __init__(self, state: State = State.RUNNING, **devices: Any) -> None:
        self.supervisor = Supervisor(cast(Any, SimpleNamespace()))
        self.supervisor.state = state
        self.counts = LoopCounts()
        incidents = Incidents(self.supervisor, self.counts, VirtualClock(), None)
        self.frame = np.zeros(WIDTH)
        self.frame[TEMPERATURE], self.frame[SUPPLY] = 25.0, 5.0
        found = {"telemetry": None, "guardian": None, "monitor": None, "verify_output": None, **devices}
        self.watch = Watch(
            cast(Any, SimpleNamespace(amplifier=SimpleNamespace(name="piezo"), **found)),
            FirmwareConfig(),
            self.frame,
            cast(Any, SimpleNamespace(odd=lambda: "")),
            self.supervisor,
            incidents,
        )

    def supervise(self, at_ms: float = 0.0) -> str:
        """Reason of the hold or trip at the end of it, empty while there is none."""
        self.watch.supervise(cast(TickInfo, SimpleNamespace(due_ns=round(at_ms * 1e6), k=0)))
        return self.tripped

    @property
    def tripped(self) -> str:
        cause = self.supervisor.trip_cause
        if cause is None and self.supervisor.holds:
            return self.supervisor.holds[-1].reason
        return "" if cause is None else cause.reason


def button(pressed: bool = False, silent: bool = False) -> Any:
    return SimpleNamespace(name="telemetry", poll=lambda: pressed, button_silent=lambda: silent)


def test_a_number_that_is_none_ends_the_run_at_once() -> None:
    bench = Watched()
    assert not bench.supervise()
    bench.frame[STATUS] = FrameStatus.INVALID
    assert "not a number" in bench.supervise(1.0)


@pytest.mark.parametrize(
    ("column", "value", "limit_ms", "says"),
    [
        (STATUS, FrameStatus.SATURATED, 50.0, "beyond its range for 50 ms; is the instrument falling?"),
        (TEMPERATURE, 61.0, 100.0, "temperature 61.00 degC is outside 0..60 degC"),
        (SUPPLY, 4.4, 100.0, "supply 4.40 V is outside 4.5..5.5 V"),
    ],
)
def test_what_may_last_a_while_holds_the_outputs_after_its_limit(
    column: int, value: float, limit_ms: float, says: str
) -> None:
    bench = Watched()
    bench.frame[column] = value
    assert not bench.supervise(10.0)
    assert not bench.supervise(10.0 + limit_ms - 0.1)
    good = bench.frame.copy()
    good[STATUS], good[TEMPERATURE], good[SUPPLY] = 0.0, 25.0, 5.0
    bad = bench.frame.copy()
    bench.frame[:] = good  # once good, the time begins anew
    assert not bench.supervise(10.0 + limit_ms)
    bench.frame[:] = bad
    assert not bench.supervise(200.0)
    assert says in bench.supervise(200.0 + limit_ms)


def test_the_stop_button_and_its_silence() -> None:
    assert Watched(telemetry=button(pressed=True)).supervise() == "stop button pressed"
    assert "stop button is not heard" in Watched(telemetry=button(silent=True)).supervise()
    assert not Watched(State.SELF_TEST, telemetry=button(silent=True)).supervise()


def test_a_guardian_that_is_lost_holds_the_outputs_and_where_nothing_is_armed_nobody_looks() -> None:
    lost = SimpleNamespace(look=lambda: "its process has ended")
    assert Watched(guardian=lost).supervise() == (
        "the guardian of the outputs is lost: its process has ended; a new one is started"
    )
    assert not Watched(guardian=SimpleNamespace(look=lambda: "")).supervise()
    assert not Watched(State.SENSING_ONLY, guardian=lost).supervise()


def broken() -> str:
    raise HalTimeout("no answer")


def test_an_amplifier_that_does_not_answer_holds_and_a_deaf_monitor_after_its_limit() -> None:
    bench = Watched(verify_output=broken)
    bench.watch.verify_output(cast(TickInfo, SimpleNamespace(due_ns=0)))
    assert bench.tripped == "piezo: no answer"
    bench = Watched(monitor=SimpleNamespace(poll=broken, forget=lambda: None, name="monitor"))
    limit_ns = round(SafetyLimits().monitor_ms * 1e6)
    for due_ns, trips in ((0, False), (limit_ns - 1, False), (limit_ns, True)):
        bench.watch.monitor_output(cast(TickInfo, SimpleNamespace(due_ns=due_ns)))
        assert bool(bench.tripped) is trips
    assert list(bench.counts.noticed) == ["amplifier monitor does not answer"]


def test_outputs_that_may_not_move_are_not_looked_at() -> None:
    bench = Watched(
        State.SAFE,
        verify_output=broken,
        monitor=SimpleNamespace(poll=broken, forget=lambda: None, name="monitor"),
    )
    bench.watch.verify_output(cast(TickInfo, SimpleNamespace(due_ns=0)))
    bench.watch.monitor_output(cast(TickInfo, SimpleNamespace(due_ns=0)))
    assert not bench.tripped
    assert not bench.counts.noticed


def test_the_self_test_waits_and_then_names_all_that_it_waits_for() -> None:
    bench = Watched(State.SELF_TEST, telemetry=button())
    limits = FirmwareConfig().self_test
    assert not bench.watch.self_test_passed(limits.watch_ms - 1.0, 5000.0, 5000.0)
    assert bench.watch.self_test_passed(limits.watch_ms, 5000.0, 5000.0)
    bench = Watched(State.SELF_TEST, telemetry=button(silent=True))
    bench.frame[STATUS] = FrameStatus.ALIGNING
    assert not bench.watch.self_test_passed(limits.limit_ms, limits.limit_ms, limits.limit_ms)
    assert not bench.tripped
    assert not bench.watch.self_test_passed(limits.limit_ms, limits.limit_ms + 1.0, 1.0)
    assert not bench.tripped
    assert not bench.watch.self_test_passed(limits.limit_ms, limits.limit_ms + 1.0, limits.limit_ms + 1.0)
    assert bench.tripped == (
        f"self-test: attitude is not aligned, the stop button has not been heard after {limits.limit_ms:g} ms"
    )
