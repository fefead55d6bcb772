"""What the watch says of outputs that are not as they were told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from firmware_py.control.incidents import Incidents, LoopCounts
from firmware_py.control.safety import State, Supervisor
from firmware_py.control.watch import Watch
from firmware_py.guardian.heart import Heart, Why
from firmware_py.scheduler.task import TickInfo
from hal.clock import VirtualClock


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
        guardian=heart,
    )
    config = SimpleNamespace(safety=SimpleNamespace(monitor_ms=100.0))
    watch = Watch(cast(Any, devices), cast(Any, config), cast(Any, None), cast(Any, None), supervisor, incidents)
    getattr(watch, look)(cast(TickInfo, SimpleNamespace(due_ns=0, k=0)))
    assert supervisor.trip_cause is not None
    assert supervisor.trip_cause.reason.startswith(says)
