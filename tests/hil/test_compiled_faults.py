"""Faults of the outputs in the compiled loop over real carriers: ptys and sockets to the emulated world, in real time.

The answer is compared with the one that the catalogue of faults expects, and with the outputs' truth; no test asserts
on time. A run that the host held up is repeated by nobody: it is skipped, and says so.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.recording.recorder import RecorderProcess
from firmware_py.run.findings import CauseClass
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from tests.conftest import with_keys
from tools.research.faults.catalogue import faults
from tools.research.faults.fault import Fault, InWorld
from tools.research.faults.points import POINTS, write_bench

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(400)]
BENCHES = Path(__file__).parents[2] / "benches"
NEUTRAL_V = 50.0
CLOSE_V = 0.5
LIMIT_S = 60.0
ROOMS = ("output bus:", "actuator:")
IN_DEFAULT_SUITE = ("output bus: DAC refuses its address", "actuator: open")


def faults_of_world() -> list[Fault]:
    """Return every fault of an output that the emulated world can do to itself and that ends a run."""
    return [
        fault
        for fault in faults()
        if fault.name.startswith(ROOMS)
        and isinstance(fault.how, InWorld)
        and fault.expected == "safe state"
        and not fault.at_start
    ]


OF_OTHER_OUTPUTS = (
    ("micron-e727", Fault("line: unplugged", InWorld("unplug", "e7270"), "safe state", ("piezo",))),
    ("micron-e727", Fault("line: E-727 does not answer", InWorld("freeze", "piezo"), "safe state", ("piezo",))),
    ("micron-can", Fault("can: node does not answer", InWorld("silence", "piezo"), "safe state", ("piezo",))),
)


def run_with(folder: Path, bench: str, fault: Fault) -> tuple[dict[str, Any], dict[str, Any]]:
    """Strike as soon as the outputs have moved; return the outcome and the truth."""
    file = write_bench(BENCHES / f"{bench}.toml", POINTS[1], folder)
    file.write_text(with_keys(file.read_text(), "firmware.safety", "holds_per_minute = 60\n"))
    opened_bench: list[OpenBench] = []
    strikes: list[threading.Thread] = []
    how = fault.how
    assert isinstance(how, InWorld)

    def strike_once(status: Mapping[str, Any]) -> None:
        moves = any(abs(volts - NEUTRAL_V) > CLOSE_V for volts in status.get("command_V", ()))
        if not strikes and moves and status["state"] == "running":
            world: Any = opened_bench[0].world
            strikes.append(threading.Thread(target=world.inject, args=(how.fault, how.target)))
            strikes[0].start()

    request = RunRequest(file, LIMIT_S, pace="realtime", stale_ms=300.0, compiled=True)
    outcome, truth = run_in_process(request, strike_once, folder, opened_bench.append)
    for strike in strikes:
        strike.join()
    if any(hold["class"] == CauseClass.HOST for hold in outcome["holds"]):
        pytest.skip(f"this host stood still: {outcome['holds'][0]['cause']}")
    assert strikes, f"the outputs never moved: {outcome['safe_state']}, {outcome['ticks']}"
    assert truth is not None
    return outcome, truth


def check(outcome: dict[str, Any], truth: dict[str, Any], fault: Fault) -> None:
    safe = outcome["safe_state"]
    assert outcome["loop"]["kind"] == "compiled"
    assert outcome["loop"]["ticks"] > 0
    assert not safe["normal"], "the run ended by itself"
    assert any(word.lower() in safe["reason"].lower() for word in fault.names), safe["reason"]
    how = fault.how
    assert isinstance(how, InWorld)
    broken = int(how.target) if how.target.isdigit() else None
    last_V = np.delete(truth["amplifier_V"][-1], [] if broken is None else [broken])
    if safe["reached"]:
        np.testing.assert_allclose(last_V, NEUTRAL_V, atol=CLOSE_V)


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, marks=[] if fault.name in IN_DEFAULT_SUITE else [pytest.mark.slow], id=fault.name)
        for fault in faults_of_world()
    ],
)
def test_a_fault_of_the_dac_or_its_stacks_ends_the_run(tmp_path: Path, fault: Fault):
    check(*run_with(tmp_path, "micron", fault), fault)


@pytest.mark.slow
@pytest.mark.parametrize(("bench", "fault"), OF_OTHER_OUTPUTS, ids=[fault.name for _, fault in OF_OTHER_OUTPUTS])
def test_a_fault_of_another_output_ends_the_run(tmp_path: Path, bench: str, fault: Fault):
    check(*run_with(tmp_path, bench, fault), fault)


def test_a_full_ring_of_the_recorder_loses_rows_and_the_loop_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The recorder's process stands still for the whole run. In virtual time the outputs are those of a run without a
    recorder, bit for bit (``tests/unit/compiled/test_full_queues.py``)."""
    start, stop = RecorderProcess.start, RecorderProcess.stop
    recorders: list[int] = []

    def start_and_halt(*arguments: Any, **keywords: Any) -> RecorderProcess:
        recorder = start(*arguments, **keywords, capacity_rows=64)
        recorders.append(recorder.pid)
        os.kill(recorder.pid, signal.SIGSTOP)
        return recorder

    def wake_and_stop(recorder: RecorderProcess, *arguments: Any) -> Any:
        os.kill(recorder.pid, signal.SIGCONT)
        return stop(recorder, *arguments)

    monkeypatch.setattr(RecorderProcess, "start", start_and_halt)
    monkeypatch.setattr(RecorderProcess, "stop", wake_and_stop)
    file = write_bench(BENCHES / "micron-e727.toml", POINTS[1], tmp_path)
    file.write_text(with_keys(file.read_text(), "firmware.safety", "holds_per_minute = 60\n"))
    record = tmp_path / "run.mcap"
    request = RunRequest(file, 2.0, pace="realtime", stale_ms=300.0, compiled=True, record=record)
    outcome, truth = run_in_process(request)
    assert recorders
    assert outcome["safe_state"]["normal"], outcome["safe_state"]
    assert {hold["class"] for hold in outcome["holds"]} <= {CauseClass.HOST}
    assert outcome["loop"]["ticks"] > 500
    kept, dropped = outcome["recorder"]["ticks"], outcome["recorder"]["dropped"]
    assert dropped > 500
    assert kept + dropped == outcome["samples"]["received"]
    assert truth is not None
    np.testing.assert_allclose(truth["amplifier_V"][-1], NEUTRAL_V, atol=CLOSE_V)
