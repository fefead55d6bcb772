"""A queue that takes nothing holds neither loop up, and the outputs become neutral as each device promises.

Whole runs in virtual time; where the outputs are is the emulated devices' truth.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.recording.recorder import RecorderProcess
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from hal.contracts import Clock
from hal.middleware.faults import FaultCan, FaultI2c, FaultPlan, FaultSerial
from tools.research.faults.carriers import SocketPort

BENCHES = Path(__file__).parents[3] / "benches"
NEUTRAL_V = 50.0
CLOSE_V = 0.02
DAC = 0x0C
FULL_S = 4.0
"""When the queue is full: the estimator has learned by then, and the outputs are away from neutral."""
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def run(bench: str, bus: str, plan: FaultPlan, *, compiled: bool) -> tuple[dict[str, Any], list[tuple[float, float]]]:
    """Return the outcome, and each change of an output: when, in s, and how far from neutral the farthest one is, V."""
    ports: list[FaultCan | FaultI2c | FaultSerial] = []
    outputs_V = [NEUTRAL_V] * 3
    changes: list[tuple[float, float]] = []

    def wrap(name: str, port: Any, clock: Clock) -> Any:
        if name == bus:
            if hasattr(port, "transfer"):
                ports.append(FaultI2c(port, clock, plan, only=DAC))
            else:
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
    assert ports[0].counts.any
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


@pytest.mark.parametrize("compiled", [False, True], ids=["Python", "compiled"])
def test_a_transfer_that_blocks_leaves_the_outputs_to_the_guardian(compiled: bool):
    """The guardian takes the outputs after 40 ms without a command, waits 100 ms at most for the one that is under way,
    and needs 20 ms for its ramp; the command that arrives after all is undone."""
    blocked_s = 0.5
    plan = FaultPlan(delay=1.0, delay_s=blocked_s, from_s=FULL_S, for_s=0.001)
    outcome, changes = run("micron", "i2c0", plan, compiled=compiled)
    assert far_V(changes, FULL_S) > CLOSE_V
    neutral_s, arrives_s = FULL_S + 0.165, FULL_S + blocked_s
    assert max([far_V(changes, neutral_s), *(far for t, far in changes if neutral_s < t < arrives_s)]) < CLOSE_V
    assert far_V(changes, arrives_s + 0.025) < CLOSE_V
    assert [hold["finding"] for hold in outcome["holds"]] == ["host_late"]
    hold = outcome["holds"][0]
    moved_s = max(t for t, _ in changes if t < hold["t_ns"] * 1e-9 + 0.1)
    assert hold["t_ns"] * 1e-9 + hold["neutral_ms"] * 1e-3 >= moved_s > arrives_s
    assert outcome["safe_state"]["normal"]


def test_a_full_ring_of_the_recorder_loses_rows_and_holds_nothing_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The recorder's process stands still; what the instrument does is what it does without a recorder."""
    start, stop = RecorderProcess.start, RecorderProcess.stop
    recorders: list[int] = []

    def start_and_halt(*arguments: Any, **keywords: Any) -> RecorderProcess:
        recorder = start(*arguments, **keywords, capacity_rows=64, lossless=False)
        recorders.append(recorder.pid)
        os.kill(recorders[0], signal.SIGSTOP)
        return recorder

    def wake_and_stop(recorder: RecorderProcess, *arguments: Any) -> Any:
        os.kill(recorders[0], signal.SIGCONT)
        return stop(recorder, *arguments)

    def wrap(_bus: str, port: Any, _clock: Clock) -> Any:
        return SocketPort(port) if hasattr(port, "drain_input") else port

    def go(record: Path | None) -> tuple[dict[str, Any], bytes]:
        request = RunRequest(BENCHES / "micron-e727.toml", 0.6, pace="virtual", compiled=True, record=record)
        outcome, truth = run_in_process(request, wrap=wrap)
        assert truth is not None
        return outcome, b"".join(np.ascontiguousarray(truth[name]).tobytes() for name in sorted(truth))

    without, moved = go(None)
    monkeypatch.setattr(RecorderProcess, "start", start_and_halt)
    monkeypatch.setattr(RecorderProcess, "stop", wake_and_stop)
    outcome, also_moved = go(tmp_path / "run.mcap")
    assert also_moved == moved
    for key in ("commands", "latency", "holds", "safe_state", "samples"):
        assert outcome[key] == without[key], key
    kept, dropped = outcome["recorder"]["ticks"], outcome["recorder"]["dropped"]
    assert dropped > 0
    assert kept + dropped == outcome["samples"]["received"]
