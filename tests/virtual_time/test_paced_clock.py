"""Emulated time keeps pace with a host that stands still now and then, and the host changes no bit of a result."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal import bench as hal_bench
from hal.bench import load_bench, open_bench
from hal.clock import PACE_NS, STALL_NS, PacedClock
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH

MS = 1_000_000


class Host:
    """A host whose clock moves when it sleeps, works or stands still. Work costs CPU time, a stall does not."""

    def __init__(self, seed: int = 0) -> None:
        self.wall_ns = 1_000 * MS
        self.cpu_ns = 0
        self.slept_ns = 0
        self.stalls_ms: list[float] = []
        self._random = random.Random(seed)

    def clock(self, start_ns: int = 0) -> PacedClock:
        return PacedClock(start_ns, wall_ns=lambda: self.wall_ns, sleep_s=self.sleep, cpu_ns=lambda: self.cpu_ns)

    def sleep(self, seconds: float) -> None:
        self.wall_ns += round(seconds * 1e9)
        self.slept_ns += round(seconds * 1e9)

    def work(self, ns: int) -> None:
        self.wall_ns += ns
        self.cpu_ns += ns

    def stand_still(self, ns: int) -> None:
        self.wall_ns += ns


def test_a_second_takes_a_second():
    host = Host()
    clock = host.clock()
    for _ in range(1000):
        host.work(400_000)
        clock.burn_ns(MS)
    report = clock.report()
    assert report.emulated_s == pytest.approx(1.0, abs=1e-12)
    assert report.wall_s == pytest.approx(1.0, abs=2 * PACE_NS * 1e-9)
    assert report.stalls == 0


def test_a_host_that_is_too_slow_makes_emulated_time_slow_and_counts_no_stall():
    host = Host()
    clock = host.clock()
    for _ in range(1000):
        host.work(3 * MS)
        clock.burn_ns(MS)
    assert clock.report().wall_s == pytest.approx(3.0)
    assert clock.report().stalls == 0
    assert host.slept_ns == 0


@pytest.mark.parametrize("stall_ms", [1, 5, 16, 100, 1000, 5000])
def test_a_stall_is_waited_out_and_not_made_up(stall_ms: int):
    host = Host()
    clock = host.clock()
    for tick in range(1000):
        if tick == 500:
            host.stand_still(stall_ms * MS)
        host.work(200_000)
        clock.burn_ns(MS)
    report = clock.report()
    # what was lost stays lost, but for the slack of one look at the clock
    assert 1.0 + 1e-3 * stall_ms - 2 * PACE_NS * 1e-9 <= report.wall_s <= 1.0 + 1e-3 * stall_ms + 2 * PACE_NS * 1e-9
    assert report.stalls == (stall_ms * MS >= STALL_NS)
    assert report.longest_stall_ms == pytest.approx(stall_ms if stall_ms >= 5 else 0)


def test_begin_forgets_what_was_before():
    host = Host()
    clock = host.clock()
    host.stand_still(60_000 * MS)  # compiling
    clock.begin()
    clock.burn_ns(100 * MS)
    report = clock.report()
    assert (report.stalls, report.emulated_s) == (0, pytest.approx(0.1))
    assert report.wall_s == pytest.approx(0.1)


def test_callbacks_see_the_same_times_as_without_a_pace():
    host = Host()
    clock = host.clock(start_ns=7)
    seen: list[int] = []

    def again(t_ns: int) -> None:
        seen.append(clock.now_ns())
        if t_ns < 50 * MS:
            clock.at(t_ns + 3 * MS, again)

    clock.at(5 * MS, again)
    clock.advance_to(60 * MS)
    assert seen == [k * MS for k in range(5, 51, 3)]
    assert clock.now_ns() == 60 * MS


@pytest.fixture(scope="module")
def unpaced() -> tuple[dict[str, Any], dict[str, Any]]:
    outcome, truth = run_in_process(RunRequest(DEFAULT_BENCH, 1.5, pace="virtual", seed=5))
    assert truth is not None
    return outcome, truth


@pytest.mark.parametrize("stall_ms", [0, 1, 5, 16, 100, 1000, 5000])
def test_a_paced_run_on_a_host_that_stands_still_gives_the_same_bits(
    monkeypatch: pytest.MonkeyPatch, unpaced: tuple[dict[str, Any], dict[str, Any]], stall_ms: int
):
    """World and firmware stand still together: they share the clock. Stalls strike at random phases."""
    host = Host()
    chance = random.Random(stall_ms)

    def slow_wall_ns() -> int:
        if stall_ms and chance.random() < 0.05:
            host.stand_still(stall_ms * MS)
        host.work(100_000)
        return host.wall_ns

    def clock(start_ns: int) -> PacedClock:
        return PacedClock(start_ns, wall_ns=slow_wall_ns, sleep_s=host.sleep, cpu_ns=lambda: host.cpu_ns)

    monkeypatch.setattr(hal_bench, "EMULATED_CLOCKS", {"paced": clock})
    outcome, truth = run_in_process(RunRequest(DEFAULT_BENCH, 1.5, seed=5))
    assert outcome["host"]["pace"] == "paced"
    assert outcome["host"]["stalls"] > 0 or stall_ms < 5
    assert outcome["safe_state"]["reason"] == "run finished"
    assert outcome["samples"]["lost"] == outcome["ticks"]["caught_up"] == outcome["ticks"]["skipped"] == 0
    expected, expected_truth = unpaced
    for key in ("samples", "commands", "latency", "safe_state", "noticed", "armed_ns", "safe_ns"):
        assert outcome[key] == expected[key], key
    for name, task in expected["tasks"].items():
        assert {**outcome["tasks"][name], "cpu_us": 0} == {**task, "cpu_us": 0}
    assert truth is not None
    for name, column in expected_truth.items():
        np.testing.assert_array_equal(truth[name], column)


def test_a_bench_with_a_real_bus_cannot_be_paced(tmp_path: Path):
    path = tmp_path / "bench.toml"
    path.write_text(DEFAULT_BENCH.read_text().replace("sim://daq0", "serial:///dev/no-daq"))
    with (
        pytest.raises(BenchError, match="virtual time needs every bus emulated, but daq0 are real"),
        open_bench(load_bench(path), pace="paced", runtime_dir=tmp_path),
    ):
        pass
