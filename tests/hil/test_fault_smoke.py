"""A fault that stays ends in the safe state, with a message that names the cause. Emulated bench, virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from hal.clock import VirtualClock
from sim_devices.lockstep_world import LockstepWorld
from tests.conftest import DEFAULT_BENCH

FAULT_AFTER_NS = 1_500_000_000  # the run proper has begun by then
NEUTRAL_V = 50.0


@pytest.fixture(autouse=True)
def _emulated_only(request: pytest.FixtureRequest) -> None:
    if request.config.getoption("--bench") is not None:
        pytest.skip("faults are injected into the emulated world; on a real bench use the fault middleware")


def run_with(fault: str, target: str) -> tuple[dict[str, Any], dict[str, np.ndarray], int]:
    """Outcome, truth and the instant of the fault (bench ns)."""
    when: list[int] = []

    def schedule(bench: OpenBench) -> None:
        clock, world = cast(VirtualClock, bench.clock), cast(LockstepWorld, bench.world)

        def strike(t_ns: int) -> None:
            when.append(t_ns)
            world.inject(fault, target)

        clock.at(clock.now_ns() + FAULT_AFTER_NS, strike)

    outcome, truth = run_in_process(RunRequest(DEFAULT_BENCH, 3.0, pace="virtual"), on_open=schedule)
    assert truth is not None
    assert when, "the run ended before the fault"
    return outcome, truth, when[0]


def neutral_after_ms(truth: dict[str, np.ndarray], since_ns: int) -> float:
    """From ``since_ns`` until the amplifier outputs stay within 0.5 V of neutral."""
    away = np.any(np.abs(truth["amplifier_V"] - NEUTRAL_V) > 0.5, axis=1)
    later = truth["t_ns"] >= since_ns
    last_away = np.flatnonzero(away & later)
    return float(truth["t_ns"][last_away[-1]] - since_ns) * 1e-6 if last_away.size else 0.0


@pytest.mark.parametrize(
    ("fault", "target", "names_cause"),
    [
        ("unplug", "daq", lambda r: "daq" in r),
        ("freeze", "daq", lambda r: "daq" in r and "no new scan for 5 ms" in r),
        ("press", "", lambda r: "stop button pressed" in r),
        ("silence", "can0", lambda r: "stop button" in r and "CAN" in r),
    ],
)
def test_ends_at_neutral_and_names_the_cause(fault: str, target: str, names_cause: Callable[[str], bool]):
    outcome, truth, struck_ns = run_with(fault, target)
    safe = outcome["safe_state"]
    assert names_cause(safe["reason"]), safe["reason"]
    assert safe["reached"]
    assert not safe["normal"]
    np.testing.assert_allclose(truth["amplifier_V"][-1], NEUTRAL_V, atol=0.5)
    # detection (5 ms stale limit, 10 ms supervisor period, 1.5 s of button heartbeat) plus a ramp of 20 ms
    limit_ms = 1600.0 if target == "can0" else 40.0
    assert neutral_after_ms(truth, struck_ns) <= limit_ms


def test_a_deaf_amplifier_is_reported_as_not_neutral():
    """Nobody can move a DAC that does not acknowledge: the report must say so, not hide it."""
    outcome, _, _ = run_with("nack", "piezo")
    safe = outcome["safe_state"]
    assert safe["reason"].startswith("piezo: ")
    assert "0x0c" in safe["reason"].lower()
    assert "NOT confirmed" in safe["reason"]
    assert not safe["reached"]


def test_a_dead_magnetometer_holds_and_then_ends_the_run():
    outcome, _, _ = run_with("nack", "mag_adc")
    safe = outcome["safe_state"]
    assert "0x48" in safe["reason"]
    assert "has not passed within 3000 ms" in safe["reason"]
    assert [hold["finding"] for hold in outcome["holds"]] == ["magnetometer_silent"]
    assert not outcome["holds"][0]["resumed"]
    assert safe["reached"]
    assert outcome["magnetometer_errors"] > 0
