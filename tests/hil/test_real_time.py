"""The whole chain in real time, over real ptys and sockets, with every process of its own.

Assertions are on logic and counts only: a machine that stands still holds the run or ends it, and is named for it.
How soon things happen is tested in virtual time, exactly.
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
from tests.conftest import DEFAULT_BENCH, copy_of_default_bench
from tools.cli.run import complete_result

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]


def test_closed_loop_over_real_ports_cancels_tremor_or_names_the_host(tmp_path: Path):
    request = RunRequest(DEFAULT_BENCH, 6.0, pace="realtime", record=tmp_path / "run.mcap")
    outcome, truth = run_in_process(request)
    result = complete_result(outcome, truth)
    safe, samples = result["safe_state"], result["samples"]
    assert safe["reached"]
    assert samples["expected"] == samples["received"] + samples["lost"]
    assert {hold["class"] for hold in result["holds"]} <= {"host"}
    if not safe["normal"]:
        assert safe["class"] == "host"
        assert "stood still" in safe["reason"]
    elif not result["holds"]:
        # a machine that stands still for a moment may lose a scan, and the report says so
        assert samples["lost"] == 0 or outcome["noticed"]
        assert samples["expected"] >= 6000
        assert result["tremor"]["reduction_percent"] > 50.0


@pytest.mark.parametrize(
    ("blow", "compiled"),
    [
        ("unplug", False),
        ("kill", False),
        ("unplug", True),
        pytest.param("kill", True, marks=pytest.mark.slow),
    ],
)
def test_losing_the_link_in_real_time_ends_safe_and_names_it(tmp_path: Path, blow: str, compiled: bool):
    # whatever the machine does meanwhile, the blow falls into a run that still goes on
    bench = copy_of_default_bench(tmp_path, "\n[firmware.safety]\nholds_per_minute = 60\n")
    timers: list[threading.Timer] = []

    def prepare(bench: OpenBench) -> None:
        world = cast(ProcessWorld, bench.world)
        strike = (lambda: os.kill(world.pid, signal.SIGKILL)) if blow == "kill" else (lambda: world.inject(blow, "daq"))
        timers.append(threading.Timer(0.3, strike))

    def start_when_running(status: dict[str, Any]) -> None:
        if status.get("state") == "running" and not timers[0].is_alive() and not timers[0].finished.is_set():
            timers[0].start()

    request = RunRequest(bench, 30.0, pace="realtime", compiled=compiled)
    outcome, truth = run_in_process(request, start_when_running, on_open=prepare)
    safe = outcome["safe_state"]
    if timers[0].ident is None and safe["class"] == "host":
        pytest.skip(f"this host stood still before the blow: {safe['reason']}")
    assert timers[0].ident is not None, f"the run ended before the blow: {safe['reason']}"
    timers[0].join()
    assert not safe["normal"]
    # all links of a killed world die at once; which one is asked first is chance
    assert safe["reason"].startswith(("daq: ", "piezo: ", "telemetry: ") if blow == "kill" else "daq: ")
    if blow == "kill":
        # the amplifier died with its world: nobody can confirm neutral, and the report says so
        assert not safe["reached"]
        assert "NOT confirmed" in safe["reason"]
        assert truth is None
    else:
        assert safe["reached"]
        assert truth is not None
        np.testing.assert_allclose(truth["amplifier_V"][-1], 50.0, atol=0.5)


def test_the_process_form_leaves_an_outcome_that_another_program_can_read(tmp_path: Path):
    (tmp_path / "request.json").write_text(RunRequest(DEFAULT_BENCH, 1.0, pace="realtime").to_json(tmp_path))
    command = [sys.executable, "-m", "firmware_py.app", str(tmp_path / "request.json")]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["host"]["pace"] == "realtime"
    assert outcome["safe_state"]["normal"] or outcome["safe_state"]["class"] == "host", outcome["safe_state"]
    assert (tmp_path / "truth.npz").is_file()
