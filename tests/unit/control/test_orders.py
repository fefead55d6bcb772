"""Orders of the bench page: what they do, and that one that makes no sense does nothing. Incidents on the way."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from typing import Any

import numpy as np
import pytest

from firmware_py.control.manual import ManualDrive
from firmware_py.control.orders import HandOrders
from firmware_py.control.plan import load_plan
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.exit_codes import Exit, exit_code_of
from firmware_py.live.link import MAX_ORDERS, LiveLink
from firmware_py.live.memory import LiveMemory
from firmware_py.run.findings import CauseClass, Finding
from firmware_py.run.orders import PageOrders
from firmware_py.run.safety import State, Trip
from firmware_py.scheduler.histogram import DurationHistogram
from hal.bench import load_bench
from hal.errors import BenchError, DeviceNotFound, HalTimeout, OpenFailed
from tests.conftest import DEFAULT_BENCH
from tests.unit.control.stand import MS, StandRun

HOST_AHEAD_NS = 1_000_000_000_000


@cache
def default_stages() -> StageConfigs:
    """The stages of the default bench."""
    return load_plan(load_bench(DEFAULT_BENCH)).stages


class Desk:
    """A page at the other end of the control socket, and a loop that may move."""

    def __init__(self, *, sensing_only: bool = False) -> None:
        self.memory = LiveMemory.create(2, 64)
        self.page, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link = LiveLink(os.dup(self.memory.fd), ours.detach())
        self.run = StandRun(State.SENSING_ONLY if sensing_only else State.RUNNING, live=self.link)
        self.clock, self.supervisor, self.incidents = self.run.clock, self.run.supervisor, self.run.incidents
        self.recorder, self.counts = self.run.recorder, self.run.counts
        self.manual = ManualDrive(0.0, 100.0, 50.0)
        stages = Stages(default_stages())
        stages.command_V[:] = 40.0, 50.0, 60.0
        self.params = stages.actuation.params
        self.orders = PageOrders(self.run, HandOrders(self.manual, stages, self.run).obey, self.host_ns)

    def host_ns(self) -> int:
        """The page stamps its orders with the host's clock, which is not the bench's in emulated time."""
        return self.clock.now_ns() + HOST_AHEAD_NS

    def close(self) -> None:
        self.page.close()
        self.link.close()
        self.memory.close()

    def say(self, *messages: Any) -> None:
        for message in messages:
            self.page.send(message if isinstance(message, bytes) else json.dumps(message).encode())
        self.orders.handle_orders()


@pytest.fixture
def desk() -> Iterator[Desk]:
    with closing(Desk()) as desk:
        yield desk


@pytest.fixture
def looking() -> Iterator[Desk]:
    """Of a run that arms nothing."""
    with closing(Desk(sensing_only=True)) as desk:
        yield desk


def test_the_safe_button_is_the_operators_end_of_the_run(desk: Desk):
    desk.clock.burn_ns(7 * MS)
    desk.incidents.tick = 7
    desk.say({"order": "safe", "t_ns": HOST_AHEAD_NS + 6_500_000})
    reason = "stopped by the operator (safe button of the bench page)"
    assert desk.supervisor.trip_cause == Trip(Finding.STOPPED_ON_PAGE, reason, 7, 7 * MS, CauseClass.OPERATOR)
    assert desk.run.asked_safe_ns == 6_500_000
    assert desk.recorder.events == [{"t_ns": 7 * MS, "tick": 7, "event": "safe state", "reason": reason}]
    desk.incidents.report(Finding.BUTTON_PRESSED)
    assert desk.supervisor.trip_cause.reason == reason
    assert len(desk.recorder.events) == 1


def test_a_safe_order_without_a_time_was_asked_for_now(desk: Desk):
    desk.clock.burn_ns(3 * MS)
    desk.say({"order": "safe", "t_ns": "soon"})
    assert desk.run.asked_safe_ns == 3 * MS
    assert desk.supervisor.state is State.SAFE_RAMP


def test_jogging_needs_arming_and_ends_with_disarming(desk: Desk):
    desk.say({"order": "jog", "channel": 1, "rate_V_per_s": 100})
    assert not desk.manual.active
    desk.say({"order": "arm"}, {"order": "jog", "channel": 1, "rate_V_per_s": -100.0})
    desk.clock.burn_ns(10 * MS)
    np.testing.assert_allclose(desk.manual.step(desk.clock.now_ns()), [40.0, 49.0, 60.0])
    desk.say({"order": "disarm"})
    assert not desk.manual.armed(desk.clock.now_ns())


def test_nothing_is_armed_that_may_not_move(looking: Desk):
    looking.say({"order": "arm"})
    assert not looking.manual.active


@pytest.mark.parametrize(("asked", "is_then"), [(0.0, 0.0), (1.5, 1.5), (1, 1.0), (1.51, 1.0), (-0.1, 1.0), ("2", 1.0)])
def test_gain_within_its_range(desk: Desk, asked: object, is_then: float):
    desk.say({"order": "gain", "value": asked})
    assert desk.params["gain"] == is_then
    taken = isinstance(asked, (int, float)) and 0.0 <= asked <= 1.5
    assert [e["event"] for e in desk.recorder.events] == (["compensation gain"] if taken else [])


@pytest.mark.parametrize(
    "nonsense", [b"\xff{", b"[]", b"7", {"order": 5}, {"order": "dance"}, {"order": "jog", "channel": "1"}, {"safe": 1}]
)
def test_nonsense_is_dropped(desk: Desk, nonsense: object):
    desk.say(nonsense, {"order": "gain", "value": 0.5})
    assert desk.supervisor.state is State.RUNNING
    assert desk.params["gain"] == 0.5


def test_an_eager_page_costs_a_tick_a_few_orders_and_a_gone_one_none(desk: Desk):
    desk.say(*({"order": "gain", "value": i / 100} for i in range(2 * MAX_ORDERS)))
    assert desk.params["gain"] == (MAX_ORDERS - 1) / 100
    desk.page.close()
    desk.orders.handle_orders()
    assert desk.params["gain"] == (2 * MAX_ORDERS - 1) / 100
    desk.orders.handle_orders()
    assert list(desk.link.orders()) == []


def test_histograms_are_shown_in_turn(desk: Desk):
    first, second = DurationHistogram(), DurationHistogram()
    second.add(5, 0)
    showing = desk.link.show(lambda: {"a": first, "b": second})
    assert [next(showing) for _ in range(3)] == [False] * 3
    assert desk.memory.distribution(0).n == 0
    assert desk.memory.distribution(1).n == 1


def test_a_doubt_holds_a_run_that_moves_and_is_noticed_in_one_that_looks(desk: Desk, looking: Desk):
    words = {"value": 3.0, "low": 4.5, "high": 5.5}
    for each in (desk, looking):
        for t_ms in (0, 20, 40):
            each.incidents.report_after(Finding.SUPPLY_OUTSIDE, True, t_ms * MS, 50.0, **words)
        each.incidents.report_after(Finding.SUPPLY_OUTSIDE, False, 45 * MS, 50.0, **words)
        each.incidents.report_after(Finding.SUPPLY_OUTSIDE, True, 46 * MS, 50.0, **words)
        each.incidents.report_after(Finding.SUPPLY_OUTSIDE, True, 95 * MS, 50.0, **words)
        assert not each.supervisor.holds, "it was good in between"
        assert not each.counts.noticed
        each.incidents.report_after(Finding.SUPPLY_OUTSIDE, True, 96 * MS, 50.0, **words)
    assert [hold.reason for hold in desk.supervisor.holds] == ["supply 3.00 V is outside 4.5..5.5 V"]
    assert desk.supervisor.state is State.HOLD_RAMP
    assert looking.supervisor.trip_cause is None
    assert looking.counts.noticed == {"supply: beyond its limit": 0}


@pytest.mark.parametrize(
    ("error", "reason"),
    [(HalTimeout("no answer", device="daq"), "daq: no answer"), (HalTimeout("no answer"), "daq: no answer")],
)
def test_a_trip_for_a_device_names_it_once(desk: Desk, error: HalTimeout, reason: str):
    desk.incidents.report_error(Finding.DAQ_GONE, "daq", error)
    assert desk.supervisor.trip_cause is not None
    assert desk.supervisor.trip_cause.reason == reason
    assert desk.incidents.error is error


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (BenchError("no such key"), Exit.BAD_INPUT),
        (DeviceNotFound("nobody there"), Exit.DEVICE_MISSING),
        (OpenFailed("no permission"), Exit.DEVICE_MISSING),
        (HalTimeout("late"), Exit.FAILED),
    ],
)
def test_exit_codes_of_errors(error: BenchError, code: Exit):
    assert exit_code_of(error) is code


def test_the_page_ends_a_hold_only_when_its_cause_has_passed(desk: Desk):
    desk.incidents.report(Finding.SCANS_MISSING, device="daq", limit_ms=5.0)
    desk.say({"order": "rearm"})
    events = [event["event"] for event in desk.recorder.events]
    assert events == ["hold begins", "rearm refused"]
    desk.supervisor.state = State.HOLD
    desk.clock.burn_ns(200 * MS)
    assert desk.incidents.holds.may_end(desk.clock.now_ns())
    desk.say({"order": "rearm"})
    assert len(desk.recorder.events) == 2
