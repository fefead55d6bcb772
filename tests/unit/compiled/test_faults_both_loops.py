"""The fault campaign gives the same answers through the compiled loop as through the Python loop.

Whole runs in virtual time over socket pairs, judged from the devices' truth. All faults: ``micron faults --compiled``.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.research.faults.catalogue import faults
from tools.research.faults.phases import HOLD, LEARNING, RAMP, STEADY, Phase
from tools.research.faults.points import POINTS, write_bench
from tools.research.faults.trial import observe_running

BENCH = Path(__file__).parents[3] / "benches" / "micron-e727.toml"
NAMES = (
    "serial: silence",
    "serial: one byte in a thousand lost",
    "serial: bytes doubled",
    "daq: FIFO overflow",
    "host: stalls for 50 ms",
    "host: stalls for 500 ms",
    "sensor: stuck",
    "sensor: sign turned round",
    "magnetometer: ADC never ready",
    "can: stop button pressed",
)
pytestmark = pytest.mark.slow


@pytest.mark.timeout(400)
@pytest.mark.parametrize("phase", [LEARNING, STEADY, HOLD, RAMP], ids=lambda phase: phase.name)
def test_answers_are_those_of_the_python_loop(tmp_path: Path, phase: Phase):
    bench = write_bench(BENCH, POINTS[1], tmp_path)
    chosen = [fault for fault in faults() if fault.name in NAMES]
    assert len(chosen) == len(NAMES)
    python, compiled = (observe_running(bench, "typical", chosen, 5, phase, compiled=c) for c in (False, True))
    assert compiled == python
