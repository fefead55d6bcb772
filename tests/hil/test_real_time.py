"""The whole chain in real time, over real ptys and sockets, with every process of its own.

Assertions are on logic and counts only: what a shared machine does to the clock is not ours to judge. The stale
limit is wide here for the same reason; its exact value is tested in virtual time.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from sim_devices.process_world import ProcessWorld
from tests.conftest import PATIENT, copy_of_default_bench
from tools.cli.run import complete_result

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]


@pytest.fixture
def patient_bench(tmp_path: Path) -> Path:
    return copy_of_default_bench(tmp_path, PATIENT)


def test_closed_loop_over_real_ports_cancels_tremor(patient_bench: Path, tmp_path: Path):
    request = RunRequest(patient_bench, 6.0, record=tmp_path / "run.mcap")
    outcome, truth = run_in_process(request)
    result = complete_result(outcome, truth)
    assert result["safe_state"]["reason"] == "run finished"
    assert result["safe_state"]["reached"]
    assert result["samples"]["lost"] == 0
    assert result["samples"]["received"] >= 6000
    assert result["recorder"]["dropped"] == 0
    assert result["tremor"]["reduction_percent"] > 50.0


@pytest.mark.parametrize("blow", ["unplug", "kill", "overflow"])
def test_losing_the_link_in_real_time_ends_safe_and_names_it(patient_bench: Path, blow: str):
    timers: list[threading.Timer] = []

    def prepare(bench: OpenBench) -> None:
        world = cast(ProcessWorld, bench.world)
        strike = (lambda: os.kill(world.pid, signal.SIGKILL)) if blow == "kill" else (lambda: world.inject(blow, "daq"))
        timers.append(threading.Timer(0.3, strike))

    def start_when_running(status: dict[str, Any]) -> None:
        if status.get("state") == "running" and not timers[0].is_alive() and not timers[0].finished.is_set():
            timers[0].start()

    outcome, truth = run_in_process(RunRequest(patient_bench, 30.0), start_when_running, on_open=prepare)
    timers[0].join()
    safe = outcome["safe_state"]
    assert not safe["normal"]
    # all links of a killed world die at once; which one is asked first is chance
    assert safe["reason"].startswith(("daq: ", "piezo: ") if blow == "kill" else "daq: ")
    if blow == "kill":
        # the amplifier died with its world: nobody can confirm neutral, and the report says so
        assert not safe["reached"]
        assert "NOT confirmed" in safe["reason"]
        assert truth is None
    else:
        assert safe["reached"]
        assert truth is not None
        np.testing.assert_allclose(truth["amplifier_V"][-1], 50.0, atol=0.5)


def test_the_process_form_leaves_an_outcome_that_another_program_can_read(patient_bench: Path, tmp_path: Path):
    (tmp_path / "request.json").write_text(RunRequest(patient_bench, 1.0).to_json(tmp_path))
    command = [sys.executable, "-m", "firmware_py.app", str(tmp_path / "request.json")]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["samples"]["received"] >= 900
    assert outcome["safe_state"]["reason"] == "run finished"
    assert (tmp_path / "truth.npz").is_file()
