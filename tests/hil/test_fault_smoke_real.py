"""One fault of each room in real time, over real ptys and sockets, with every process of its own.

Logic only: which part is named, whether neutral is confirmed. How soon is measured in virtual time (``micron faults``).
The limits of time are wide, for a shared machine; a run that the machine itself ended is done again.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from sim_devices.process_world import ProcessWorld
from tests.conftest import DEFAULT_BENCH

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]

HOST = ("host stood still", "lost the outputs", "scans came at once", "the host did not read")
TRIES = 3


def run_with(bench: Path, fault: str, target: str) -> tuple[dict[str, Any], dict[str, Any] | None, bool]:
    """Outcome, truth, and whether the fault was struck before the run ended."""
    struck = threading.Event()
    world: list[ProcessWorld] = []

    def strike_when_running(status: dict[str, Any]) -> None:
        if status.get("state") == "running" and status["t_s"] > 1.0 and not struck.is_set():
            struck.set()
            world[0].inject(fault, target)

    outcome, truth = run_in_process(
        RunRequest(bench, 15.0),
        strike_when_running,
        on_open=lambda opened: world.append(cast(ProcessWorld, cast(OpenBench, opened).world)),
    )
    return outcome, truth, struck.is_set()


@pytest.mark.parametrize(
    ("fault", "target", "named", "confirmed"),
    [
        ("freeze", "daq", "daq: no new scan", True),
        ("sensor_open", "1", "DAQ input 1", True),
        ("nack", "mag_adc", "0x48", True),
        ("nack", "piezo", "piezo: ", False),
        ("actuator_rail", "1", "output 2 is at", True),
        ("press", "", "stop button pressed", True),
    ],
)
def test_each_ends_at_neutral_and_names_the_part(tmp_path: Path, fault: str, target: str, named: str, confirmed: bool):
    text = DEFAULT_BENCH.read_text().replace('"calibration/', f'"{DEFAULT_BENCH.parent / "calibration"}/')
    bench = tmp_path / "bench.toml"
    bench.write_text(text + "\n[firmware.safety]\nstale_ms = 500.0\n")
    for _ in range(TRIES):
        outcome, truth, struck = run_with(bench, fault, target)
        reason = outcome["safe_state"]["reason"]
        if struck and not any(word in reason for word in HOST):
            break
    assert named in reason
    assert not outcome["safe_state"]["normal"]
    assert outcome["safe_state"]["reached"] is confirmed
    samples = outcome["samples"]
    assert samples["expected"] == samples["received"] + samples["lost"]
    if confirmed:
        assert truth is not None
        if not fault.startswith("actuator"):
            np.testing.assert_allclose(truth["amplifier_V"][-1], 50.0, atol=0.5)
    else:
        assert "NOT confirmed" in reason
