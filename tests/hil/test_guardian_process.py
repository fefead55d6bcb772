"""kill -9 and SIGSTOP of the firmware in real time, over a real socket: the DAC must end at neutral all the same."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.guardian.process import REPORT, describe
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]
NEUTRAL_V = 50.0


def wait_for(condition: Callable[[], Any], what: str, limit_s: float = 120.0) -> Any:
    deadline_s = time.monotonic() + limit_s
    while not (found := condition()):
        assert time.monotonic() < deadline_s, f"waited in vain for: {what}"
        time.sleep(0.002)
    return found


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    made = Run(tmp_path)
    yield made
    made.process.kill()
    made.process.communicate()


class Run:
    """The firmware as ``micron run`` starts it, and what it leaves behind."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        request = folder / "request.json"
        # limits of a busy test machine for scans; the guardian's are then twice that for silence, none for death
        request.write_text(RunRequest(DEFAULT_BENCH, 60.0, pace="realtime", stale_ms=300.0).to_json(folder))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "firmware_py.app", str(request)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )

    def wait_until_moving(self, extra_s: float) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            status = json.loads(line)
            moving = any(abs(volts - NEUTRAL_V) > 0.5 for volts in status.get("command_V", ()))
            if moving and status["state"] == "running":
                time.sleep(extra_s)
                return
        raise AssertionError("the firmware never moved anything")

    def report(self) -> dict[str, Any]:
        path = self.folder / REPORT
        wait_for(path.exists, "the guardian's report")
        return json.loads(path.read_text())

    def amplifier(self) -> tuple[np.ndarray, np.ndarray]:
        """Bench time (ns) and voltages at the stacks, from the world that has outlived the firmware."""
        path = wait_for(lambda: next(self.folder.glob("world-*/truth.npz"), None), "the world's truth")
        with np.load(path, allow_pickle=False) as truth:
            return truth["t_ns"], truth["amplifier_V"]


@pytest.mark.parametrize("extra_s", [0.0, 0.137])
def test_a_killed_firmware_leaves_neutral_outputs(run: Run, extra_s: float) -> None:
    run.wait_until_moving(extra_s)
    killed_ns = time.monotonic_ns()
    run.process.kill()
    run.process.wait()
    report = run.report()
    assert report["why"] == "died"
    assert report["neutral_ns"] > report["taken_ns"] >= report["last_beat_ns"] > 0
    assert "outputs neutral and read back" in describe(report)
    t_ns, volts = run.amplifier()
    before, after = t_ns < killed_ns, t_ns > report["neutral_ns"] + 2_000_000
    assert np.abs(volts[before] - NEUTRAL_V).max() > 0.05  # something was moving
    assert after.sum() > 100
    np.testing.assert_allclose(volts[after], NEUTRAL_V, atol=0.01)


def test_a_firmware_that_stands_still_is_taken_over_and_holds_when_it_wakes(run: Run, tmp_path: Path) -> None:
    run.wait_until_moving(0.1)
    os.kill(run.process.pid, signal.SIGSTOP)
    time.sleep(0.9)
    os.kill(run.process.pid, signal.SIGCONT)
    assert run.process.stdout is not None
    for line in run.process.stdout:
        status = json.loads(line)
        if status.get("state") in ("hold", "safe ramp", "safe") or status.get("holds"):
            break
    run.process.send_signal(signal.SIGINT)
    run.process.stdout.read()
    assert run.process.wait(60.0) == 0
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["safe_state"]["reached"]
    assert outcome["holds"][0]["class"] == "host"
    assert "no command for a while (guardian)" in outcome["noticed"]


def test_a_guardian_that_is_killed_is_missed(run: Run, tmp_path: Path) -> None:
    run.wait_until_moving(0.1)
    task = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children")
    children = [int(pid) for pid in task.read_text().split()]
    guardians = [pid for pid in children if b"guardian.process" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert len(guardians) == 1
    os.kill(guardians[0], signal.SIGKILL)
    time.sleep(0.5)
    run.process.send_signal(signal.SIGINT)
    assert run.process.stdout is not None
    run.process.stdout.read()
    assert run.process.wait(60.0) == 0
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert "the guardian of the outputs is not heard any more" in outcome["noticed"]
    assert outcome["safe_state"]["reached"]  # the firmware is not less able to stop
