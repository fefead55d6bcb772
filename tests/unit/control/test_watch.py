"""What the watch says of impossible readings, of the room, the button, and outputs that are not as they were told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

from firmware_py.control.plausibility import PlausibilityLimits, ScanCheck
from firmware_py.control.watch import Watch
from firmware_py.control.wiring import Devices
from firmware_py.frame import LAYOUT, STATUS, SUPPLY, TEMPERATURE, FrameStatus
from firmware_py.guardian.heartbeat import Heartbeat, TakeoverReason
from firmware_py.guardian.lifecycle import GuardianLifecycle
from firmware_py.run.findings import CauseClass
from firmware_py.run.safety import SafetyLimits, State
from firmware_py.scheduler.task import TickInfo
from hal.errors import HalTimeout
from tests.unit.control.stand import StandOutput, StandRun
from tests.unit.guardian.handle import FakeHandle

WIDTH = max(column.start + column.size for column in LAYOUT)


def tick(due_ns: int = 0) -> TickInfo:
    return TickInfo(0, due_ns, due_ns, 0)


class FakeMonitor:
    """An amplifier's monitor whose ``poll`` answers as it is told."""

    name = "monitor"

    def __init__(self, poll: Callable[[], str]) -> None:
        self.poll = poll

    def forget(self) -> None:
        pass


class FakeButton:
    """A stop button on the CAN bus."""

    name = "telemetry"

    def __init__(self, pressed: bool, silent: bool) -> None:
        self._pressed, self._silent = pressed, silent

    def poll(self) -> bool:
        return self._pressed

    def button_silent(self) -> bool:
        return self._silent


CHECK = ScanCheck(PlausibilityLimits(), 5.0 / 32768, range(8), [f"input {i}" for i in range(8)])


def bench_of(**devices: Any) -> Devices:
    """The devices of a bench; those that the watch does not look at are absent."""
    absent = cast(Any, None)
    wired = {"magnetometer": None, "telemetry": None, **devices}
    return Devices(daq=absent, scan=absent, amplifier=StandOutput(), sensing_table={}, scan_labels=(), **wired)


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
    heartbeat = Heartbeat()
    if taken:
        heartbeat.take_outputs(TakeoverReason.SILENT, 7)
    run = StandRun(guardian=GuardianLifecycle(FakeHandle(heartbeat)))
    supervisor = run.supervisor
    devices = bench_of(
        verify_output=lambda: "output 1 holds 50 V and was told 29 V",
        monitor=FakeMonitor(lambda: "output 1 is at 50 V"),
    )
    watch = Watch(devices, np.zeros(WIDTH), CHECK, run)
    getattr(watch, look)(tick())
    if taken:  # the guardian gives them back
        assert supervisor.holds[0].reason.startswith(says)
        assert supervisor.holds[0].cause is CauseClass.HOST
    else:
        assert supervisor.trip_cause is not None
        assert supervisor.trip_cause.reason.startswith(says)


class Watched:
    """A watch over a bench of fakes; ``supervise`` and what was said."""

    def __init__(self, state: State = State.RUNNING, **devices: Any) -> None:
        self.run = StandRun(state, guardian=devices.pop("guardian", None))
        self.counts = self.run.counts
        self.frame = np.zeros(WIDTH)
        self.frame[TEMPERATURE], self.frame[SUPPLY] = 25.0, 5.0
        self.watch = Watch(bench_of(**devices), self.frame, CHECK, self.run)

    def supervise(self, at_ms: float = 0.0) -> str:
        """Reason of the hold or trip at the end of it, empty while there is none."""
        self.watch.supervise(tick(round(at_ms * 1e6)))
        return self.tripped

    @property
    def tripped(self) -> str:
        return self.run.reason


def button(pressed: bool = False, silent: bool = False) -> Any:
    return FakeButton(pressed, silent)


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
    handle = FakeHandle()
    lost = GuardianLifecycle(handle)
    handle.alive = False
    assert Watched(guardian=lost).supervise() == (
        "the guardian of the outputs is lost: its process has ended; a new one is started"
    )
    assert not Watched(guardian=GuardianLifecycle(FakeHandle())).supervise()
    assert not Watched(State.SENSING_ONLY, guardian=lost).supervise()


def broken() -> str:
    raise HalTimeout("no answer")


def test_an_amplifier_that_does_not_answer_holds_and_a_deaf_monitor_after_its_limit() -> None:
    bench = Watched(verify_output=broken)
    bench.watch.verify_output(tick())
    assert bench.tripped == "piezo: no answer"
    bench = Watched(monitor=FakeMonitor(broken))
    limit_ns = round(SafetyLimits().monitor_ms * 1e6)
    for due_ns, trips in ((0, False), (limit_ns - 1, False), (limit_ns, True)):
        bench.watch.monitor_output(tick(due_ns))
        assert bool(bench.tripped) is trips
    assert list(bench.counts.noticed) == ["amplifier monitor does not answer"]


def test_outputs_that_may_not_move_are_not_looked_at() -> None:
    bench = Watched(
        State.SAFE,
        verify_output=broken,
        monitor=FakeMonitor(broken),
    )
    bench.watch.verify_output(tick())
    bench.watch.monitor_output(tick())
    assert not bench.tripped
    assert not bench.counts.noticed


def test_all_that_prevents_arming_is_named() -> None:
    assert Watched(State.SELF_TEST, telemetry=button()).watch.waiting_for() == []
    bench = Watched(State.SELF_TEST, telemetry=button(silent=True))
    bench.frame[STATUS] = FrameStatus.ALIGNING
    assert bench.watch.waiting_for() == ["attitude is not aligned", "the stop button has not been heard"]
