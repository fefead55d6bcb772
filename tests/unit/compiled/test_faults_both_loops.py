"""The fault campaign gives the same answers through the compiled loop as through the Python loop.

Whole runs in virtual time over socket pairs, judged from the devices' truth. All faults: ``micron faults --compiled``;
over ptys and sockets in real time: ``tests/hil/test_compiled_faults.py``.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.research.faults.catalogue import faults
from tools.research.faults.phases import HOLD, LEARNING, PHASES, RAMP, STEADY, Phase
from tools.research.faults.points import POINTS, write_bench
from tools.research.faults.trial import observe_running, observe_start

pytestmark = pytest.mark.timeout(900)
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
ROOMS_OF_OUTPUTS = ("output bus:", "actuator:", "host:")
"""Faults of these rooms are all run through the compiled loop, also those that will be added to the catalogue."""
FEW = ("output bus: DAC refuses its address", "output bus: one transfer in a hundred refused", "host: stalls for 5 ms")
"""The faults that the default suite runs."""


def of_outputs(*, at_start: bool) -> tuple[str, ...]:
    """Return the name of every fault of an output, an actuator or the host."""
    chosen = [fault for fault in faults() if fault.at_start is at_start]
    return tuple(fault.name for fault in chosen if fault.name.startswith(ROOMS_OF_OUTPUTS))


def compare(folder: Path, bench: str, names: tuple[str, ...], phase: Phase) -> None:
    file = write_bench(BENCHES / f"{bench}.toml", POINTS[1], folder)
    chosen = [fault for fault in faults() if fault.name in names]
    assert len(chosen) == len(names)
    python, compiled = (observe_running(file, "typical", chosen, 5, phase, compiled=c) for c in (False, True))
    assert compiled == python


def test_a_few_faults_get_the_same_answers(tmp_path: Path):
    compare(tmp_path, "micron", FEW, LEARNING)


@pytest.mark.slow
@pytest.mark.parametrize("phase", [LEARNING, STEADY, HOLD, RAMP], ids=lambda phase: phase.name)
def test_answers_are_those_of_the_python_loop(tmp_path: Path, phase: Phase):
    compare(tmp_path, "micron-e727", NAMES, phase)


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES, ids=lambda phase: phase.name)
def test_every_fault_of_an_output_gets_the_answer_of_the_python_loop(tmp_path: Path, phase: Phase):
    compare(tmp_path, "micron", of_outputs(at_start=False), phase)


@pytest.mark.slow
@pytest.mark.parametrize("name", of_outputs(at_start=True))
def test_a_bench_whose_output_is_broken_at_the_start_is_refused_alike(tmp_path: Path, name: str):
    file = write_bench(BENCHES / "micron.toml", POINTS[1], tmp_path)
    fault = next(fault for fault in faults() if fault.name == name)
    python, compiled = (observe_start(file, "typical", fault, 5, compiled=c) for c in (False, True))
    assert python.answer == "refused"
    assert compiled == python
