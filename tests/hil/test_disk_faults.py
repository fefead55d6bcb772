"""A slow and a full disk under the running instrument: the loop does not notice, the recorder says what is missing."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.recording.reader import Recording
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from hal.clock import VirtualClock
from tests.conftest import DEFAULT_BENCH

SECONDS = 1.5
MS = 1_000_000


@pytest.fixture(autouse=True)
def _emulated_only(request: pytest.FixtureRequest) -> None:
    if request.config.getoption("--bench") is not None:
        pytest.skip("exact comparisons need virtual time")


def recorder_pid() -> int:
    """The recorder that this process has started."""
    for task in Path("/proc/self/task").iterdir():
        for pid in (task / "children").read_text().split():
            if b"firmware_py.recording.recorder" in Path(f"/proc/{pid}/cmdline").read_bytes():
                return int(pid)
    raise AssertionError("there is no recorder")


def run_with(path: Path | None, *blows: tuple[int, Callable[[int], None]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A run in which each blow (bench ms, what is done to the recorder) happens at its time."""

    def prepare(bench: OpenBench) -> None:
        clock = cast(VirtualClock, bench.clock)
        for at_ms, blow in blows:
            clock.at(at_ms * MS, lambda _, blow=blow: blow(recorder_pid()))

    outcome, truth = run_in_process(RunRequest(DEFAULT_BENCH, SECONDS, pace="virtual", record=path), on_open=prepare)
    assert truth is not None
    return outcome, truth


@pytest.fixture(scope="module")
def undisturbed() -> tuple[dict[str, Any], dict[str, Any]]:
    return run_with(None)


def test_a_full_disk_ends_the_recording_and_not_the_run(
    tmp_path: Path, undisturbed: tuple[dict[str, Any], dict[str, Any]]
):
    """A quota is reached half-way. The tip goes the same way, bit for bit; what was written is whole."""
    path = tmp_path / "run.mcap"

    def fill(pid: int) -> None:
        size = path.stat().st_size
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (size + 40_000, size + 40_000))

    outcome, truth = run_with(path, (1200, fill))
    expected, path_expected = undisturbed
    assert outcome["safe_state"]["normal"]
    for key in ("samples", "commands", "noticed"):
        assert outcome[key] == expected[key]
    np.testing.assert_array_equal(truth["tip_m"], path_expected["tip_m"])
    recorder = outcome["recorder"]
    assert recorder["dropped"] > 0
    assert recorder["ticks"] + recorder["dropped"] == outcome["ticks"]["run"]
    recording = Recording(path)
    assert recording.column("tick").tolist() == list(range(recorder["ticks"]))
    assert not recording.health.damage
    assert recording.health.lost


def test_a_disk_that_stands_still_for_a_second_costs_nothing(
    tmp_path: Path, undisturbed: tuple[dict[str, Any], dict[str, Any]]
):
    """The ring bridges it; ``test_recorder_process.py`` counts what is dropped when it is full."""
    path = tmp_path / "run.mcap"
    outcome, truth = run_with(
        path,
        (1000, lambda pid: os.kill(pid, signal.SIGSTOP)),
        (2000, lambda pid: os.kill(pid, signal.SIGCONT)),
    )
    np.testing.assert_array_equal(truth["tip_m"], undisturbed[1]["tip_m"])
    assert outcome["recorder"] == {"ticks": outcome["ticks"]["run"], "dropped": 0, "problem": ""}
    recording = Recording(path)
    assert recording.column("tick").tolist() == list(range(outcome["ticks"]["run"]))
    assert not recording.health.lost
