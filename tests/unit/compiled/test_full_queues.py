"""A queue that takes nothing holds neither loop up, and the outputs become neutral as each device promises.

Whole runs in virtual time; where the outputs are is the emulated devices' truth.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from hal.contracts import Clock
from hal.middleware.faults import FaultCan, FaultPlan, FaultSerial
from tools.research.faults.carriers import SocketPort

BENCHES = Path(__file__).parents[3] / "benches"
NEUTRAL_V = 50.0
CLOSE_V = 0.02
FULL_S = 4.0
"""When the queue is full: the estimator has learned by then, and the outputs are away from neutral."""
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def run(bench: str, bus: str, plan: FaultPlan, *, compiled: bool) -> tuple[dict[str, Any], list[tuple[float, float]]]:
    """Return the outcome, and each change of an output: when, in s, and how far from neutral the farthest one is, V."""
    ports: list[FaultCan | FaultSerial] = []
    outputs_V = [NEUTRAL_V] * 3
    changes: list[tuple[float, float]] = []

    def wrap(name: str, port: Any, clock: Clock) -> Any:
        if name == bus:
            ports.append((FaultCan if hasattr(port, "recv") else FaultSerial)(port, clock, plan))
            port = ports[0]
        return SocketPort(port) if hasattr(port, "drain_input") else port

    def on_open(opened: OpenBench) -> None:
        def note(channel: int, volts: float) -> None:
            outputs_V[channel] = volts
            changes.append((opened.clock.now_ns() * 1e-9, max(abs(v - NEUTRAL_V) for v in outputs_V)))

        world: Any = opened.world
        world.world.faults.on_demand = note

    request = RunRequest(BENCHES / f"{bench}.toml", FULL_S + 0.8, pace="virtual", compiled=compiled)
    outcome, _ = run_in_process(request, on_open=on_open, wrap=wrap)
    assert ports[0].counts.refused > 0
    return outcome, changes


def far_V(changes: list[tuple[float, float]], at_s: float) -> float:
    """Return how far from neutral the outputs were at ``at_s``."""
    return [far for t, far in changes if t <= at_s][-1]


@pytest.mark.parametrize("compiled", [False, True], ids=["Python", "compiled"])
def test_a_full_can_queue_leaves_the_outputs_to_the_nodes_watchdog(compiled: bool):
    """The node waits 10 ms for a set point and needs 10 ms at most for its ramp."""
    outcome, changes = run("micron-can", "can0", FaultPlan(full_after_s=FULL_S), compiled=compiled)
    assert far_V(changes, FULL_S) > CLOSE_V
    assert far_V(changes, FULL_S + 0.021) < CLOSE_V
    assert changes[-1][0] < FULL_S + 0.021, "nothing moves afterwards"
    assert "queue is full" in outcome["safe_state"]["reason"]


@pytest.mark.parametrize("compiled", [False, True], ids=["Python", "compiled"])
def test_a_full_serial_line_is_found_and_neutral_as_soon_as_it_takes_bytes(compiled: bool):
    """An E-727 holds its outputs while it hears nothing: nothing can be promised before there is room."""
    room_s = FULL_S + 0.7
    plan = FaultPlan(full_after_s=FULL_S, full_for_s=room_s - FULL_S)
    outcome, changes = run("micron-e727", "e7270", plan, compiled=compiled)
    assert far_V(changes, room_s) > CLOSE_V
    assert [hold["finding"] for hold in outcome["holds"]] or not outcome["safe_state"]["normal"]
    assert far_V(changes, room_s + 0.05) < CLOSE_V


@pytest.mark.parametrize("compiled", [False, True], ids=["Python", "compiled"])
def test_a_short_jam_of_the_line_loses_values_and_ends_nothing(compiled: bool):
    plan = FaultPlan(full_after_s=FULL_S, full_for_s=0.1)
    outcome, changes = run("micron-e727", "e7270", plan, compiled=compiled)
    assert not [t for t, _ in changes if FULL_S + 0.005 < t < FULL_S + 0.1]
    assert [t for t, _ in changes if FULL_S + 0.1 < t < FULL_S + 0.2]
    assert outcome["safe_state"]["normal"]
