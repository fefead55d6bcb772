"""The fault campaign gives the same answers through the compiled loop as through the Python loop.

Whole runs in virtual time over socket pairs, judged from the devices' truth. All faults: ``micron faults --compiled``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tools.research.faults.campaign import FaultRow, run_campaign
from tools.research.faults.catalogue import faults
from tools.research.faults.phases import HOLD, LEARNING, RAMP, STEADY, Phase
from tools.research.faults.points import POINTS

BENCHES = Path(__file__).parents[3] / "benches"
SERIAL = (
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
CAN = (
    "can: bus silent",
    "can: one frame in five lost",
    "can: bits of frames flipped",
    "can: frames out of order",
    "can: controller bus-off",
    "host: stalls for 50 ms",
)
OF_THE_OUTPUT = ("output bus: ", "actuator: ", "host: stalls", "host: guardian", "host: firmware")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def campaigns(bench: str, names: Sequence[str], phases: Sequence[Phase]) -> tuple[list[FaultRow], list[FaultRow]]:
    """Return the rows of the faults whose names begin with one of ``names``, by the Python loop and compiled."""
    chosen = [fault for fault in faults() if fault.name.startswith(tuple(names))]
    assert len(chosen) >= len(names)
    python, compiled = (
        run_campaign(
            BENCHES / f"{bench}.toml", chosen, points=POINTS[1:2], phases=phases, seeds=(5,), jobs=1,
            progress=lambda text: None, compiled=c,
        )
        for c in (False, True)
    )  # fmt: skip
    return python, compiled


def differences(python: list[FaultRow], compiled: list[FaultRow]) -> list[str]:
    assert len(python) == len(compiled) > 0
    pairs = [
        (a, b)
        for p, c in zip(python, compiled, strict=True)
        for a, b in zip(p.observations, c.observations, strict=True)
    ]
    return [f"{a}\nbut compiled\n{b}" for a, b in pairs if a != b]


def test_the_serial_bench():
    assert not differences(*campaigns("micron-e727", SERIAL, (LEARNING, STEADY, HOLD, RAMP)))


def test_every_fault_of_the_output_of_the_default_bench():
    python, compiled = campaigns("micron", OF_THE_OUTPUT, (STEADY, HOLD))
    assert not differences(python, compiled)
    assert all(row.as_dict()["as_expected"] == row.as_dict()["runs"] for row in compiled)


def test_the_bench_with_the_can_node():
    assert not differences(*campaigns("micron-can", CAN, (STEADY, HOLD)))
