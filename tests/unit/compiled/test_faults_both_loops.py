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

BENCHES = Path(__file__).parents[3] / "benches"
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
OF_THE_DAC = (
    "output bus: DAC refuses its address",
    "output bus: DAC refuses data",
    "output bus: SDA stuck",
    "output bus: DAC restarts",
    "output bus: one transfer in a hundred refused",
    "output bus: a bit wrong in one transfer of ten",
    "output bus: silence",
    "output bus: adapter unplugged",
    "actuator: open",
    "host: stalls for 50 ms",
    "host: stalls for 500 ms",
    "host: guardian killed (kill -9)",
)
pytestmark = pytest.mark.slow


def compare(folder: Path, bench: str, names: tuple[str, ...], phase: Phase) -> None:
    file = write_bench(BENCHES / f"{bench}.toml", POINTS[1], folder)
    chosen = [fault for fault in faults() if fault.name in names]
    assert len(chosen) == len(names)
    python, compiled = (observe_running(file, "typical", chosen, 5, phase, compiled=c) for c in (False, True))
    assert compiled == python


@pytest.mark.timeout(400)
@pytest.mark.parametrize("phase", [LEARNING, STEADY, HOLD, RAMP], ids=lambda phase: phase.name)
def test_answers_are_those_of_the_python_loop(tmp_path: Path, phase: Phase):
    compare(tmp_path, "micron-e727", NAMES, phase)


@pytest.mark.timeout(400)
@pytest.mark.parametrize("phase", [STEADY, HOLD], ids=lambda phase: phase.name)
def test_answers_of_the_bench_with_a_guardian_are_those_of_the_python_loop(tmp_path: Path, phase: Phase):
    compare(tmp_path, "micron", OF_THE_DAC, phase)
