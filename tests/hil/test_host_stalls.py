"""A loop in real time on a host that stands still, with an emulated clock: it holds, resumes, and names the host.

``OnHost`` stops the firmware while devices go on. A world that stands still is a DAQ that is silent for as long and
then sends what it had; it tells of its stall as its process does in real time.
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from sim_devices.lateness import ALLOWED_NS, STALL_NS, Lateness, LatenessView
from sim_devices.lockstep_world import LockstepWorld
from tests.conftest import DEFAULT_BENCH
from tools.research.faults.fault import OnBus, OnHost
from tools.research.faults.points import POINTS, write_bench
from tools.research.faults.trial import FarBench

MS = 1_000_000
STRIKE_S = 1.5


def run_with_stall(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *, firmware_ms: float = 0.0, world_ms: float = 0.0
) -> dict[str, Any]:
    """Outcome of a run in which the firmware, the emulated world or both stand still once, at a random phase."""
    bench = write_bench(DEFAULT_BENCH, POINTS[1], folder)
    far = FarBench()
    phase_ns = random.Random(f"{firmware_ms} {world_ms}").randrange(MS)
    stalled: list[tuple[int, int]] = []

    def strike(t_ns: int) -> None:
        if world_ms:
            stalled.append((t_ns, t_ns + round(world_ms * MS)))
            far.strike(OnBus("daq0", {"silent_after_s": 0.0, "silent_for_s": world_ms * 1e-3}), seed=5)
        if firmware_ms:
            far.strike(OnHost(firmware_ms), seed=5)

    def world_stalled_ms(_: LockstepWorld, now_ns: int, within_ms: float) -> float:
        for began_ns, ended_ns in stalled:
            if began_ns + STALL_NS <= now_ns <= ended_ns + within_ms * MS:
                return (min(now_ns, ended_ns) - began_ns) * 1e-6
        return 0.0

    def prepare(opened: OpenBench) -> None:
        far.attach(opened)
        opened.clock.at(round(STRIKE_S * 1e9) + phase_ns, strike)  # type: ignore[attr-defined]

    monkeypatch.setattr(LockstepWorld, "stalled_ms", world_stalled_ms)
    seconds = 3.0 + 1e-3 * max(firmware_ms, world_ms)
    request = RunRequest(bench, seconds, pace="virtual", seed=5)
    return run_in_process(request, on_open=prepare, wrap=far.wrap)[0]


@pytest.mark.parametrize("ms", [1, 5, 16, 100, 1000, 5000])
@pytest.mark.parametrize("who", ["firmware", "world", "both"])
def test_a_stall_is_the_hosts_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, who: str, ms: int
) -> None:
    stalls = {f"{name}_ms": float(ms) for name in ("firmware", "world") if who in (name, "both")}
    outcome = run_with_stall(tmp_path, monkeypatch, **stalls)
    assert outcome["safe_state"]["reason"] == "run finished"
    assert outcome["safe_state"]["normal"]
    holds = outcome["holds"]
    assert {hold["class"] for hold in holds} <= {"host"}
    assert all(hold["resumed"] for hold in holds)
    if ms == 1:
        assert not holds
    if ms >= 100 or (ms == 16 and who == "world"):
        assert holds
        assert "stood still" in holds[0]["cause"]
    samples = outcome["samples"]
    assert samples["expected"] == samples["received"] + samples["lost"]


def test_the_world_tells_when_it_stood_still(tmp_path: Path) -> None:
    world, view = Lateness(tmp_path), LatenessView(tmp_path)
    assert view.stalled_ms(5 * MS, 10.0) == 0.0
    now_ns = 1_000 * MS
    for _ in range(5):
        world.turn(now_ns)
        now_ns += ALLOWED_NS
    last_ns = now_ns - ALLOWED_NS
    assert view.stalled_ms(last_ns + ALLOWED_NS + STALL_NS - 1, 10.0) == 0.0
    assert view.stalled_ms(last_ns + ALLOWED_NS + 16 * MS, 10.0) == pytest.approx(16.0)  # it stands still now
    world.turn(last_ns + ALLOWED_NS + 20 * MS)
    woke_ns = last_ns + ALLOWED_NS + 20 * MS
    assert view.stalled_ms(woke_ns + MS, 10.0) == pytest.approx(20.0)
    assert (view.stalls, view.longest_ms) == (1, pytest.approx(20.0))
    for k in range(1, 13):
        world.turn(woke_ns + k * MS)
    assert view.stalled_ms(woke_ns + 12 * MS, 10.0) == 0.0
    assert view.stalls == 1


@pytest.mark.parametrize("until_s", [2.0, 60.0])
def test_a_host_that_stands_still_in_the_self_test_is_waited_for_and_named(tmp_path: Path, until_s: float) -> None:
    """The DAQ's FIFO overflows every time, so that nothing can be watched for long enough."""
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    bench.write_text(bench.read_text() + "\n[firmware.self_test]\nwatch_ms = 300.0\nlimit_ms = 1000.0\n")
    far = FarBench()

    def strike(t_ns: int) -> None:
        if t_ns < until_s * 1e9:
            far.strike(OnHost(150.0), seed=5)
            far.clock.at(t_ns + 350 * MS, strike)

    def prepare(opened: OpenBench) -> None:
        far.attach(opened)
        far.clock.at(20 * MS, strike)

    request = RunRequest(bench, 0.5, pace="virtual", seed=5)
    outcome = run_in_process(request, on_open=prepare, wrap=far.wrap)[0]
    if until_s < 10.0:
        assert outcome["safe_state"]["normal"], outcome["safe_state"]
    else:
        assert outcome["safe_state"]["class"] == "host"
        assert outcome["safe_state"]["finding"] == "self_test_disturbed"
        assert "this host stood still again and again" in outcome["safe_state"]["reason"]
    assert outcome["holds"] == []
