"""A part of the fault campaign in virtual time: one fault of each room, one hand, one seed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import DEFAULT_BENCH
from tools.research.faults.campaign import FaultRow, totals
from tools.research.faults.catalogue import faults
from tools.research.faults.pairs import join
from tools.research.faults.phases import SELF_TEST
from tools.research.faults.points import POINTS, write_bench
from tools.research.faults.trial import observe_running, observe_start

NAMES = (
    "serial: silence",
    "daq: FIFO overflow",
    "host: stalls for 50 ms",
    "sensor: stuck",
    "sensor: sign turned round",
    "output bus: DAC holds its outputs",
    "output bus: DAC restarts",
    "magnetometer: ADC never ready",
    "can: stop button pressed",
    "host: stalls for 500 ms",
)


def test_every_name_is_there_once():
    names = [fault.name for fault in faults()]
    assert len(set(names)) == len(names) >= 60
    assert set(NAMES) <= set(names)


@pytest.mark.timeout(200)
def test_answers_are_as_expected_and_nothing_is_unsafe_or_uncounted(tmp_path: Path):
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    chosen = [fault for fault in faults() if fault.name in NAMES]
    observations = observe_running(bench, "typical", chosen, 5)
    rows = [FaultRow(fault, "typical", (o,)) for fault, o in zip(chosen, observations, strict=True)]
    for row in rows:
        assert row.as_expected == 1, row.as_dict()
        assert row.wrong_messages == 0, row.as_dict()
    total = totals(rows)
    assert total["unsafe_outputs"] == 0
    assert total["uncounted_samples"] == 0


def test_a_bench_that_reads_back_knows_of_a_wrong_bit_at_once(tmp_path: Path):
    bench = write_bench(DEFAULT_BENCH.with_name("micron-read-back.toml"), POINTS[1], tmp_path)
    fault = next(f for f in faults() if f.name == "output bus: a bit wrong in every transfer")
    (o,) = observe_running(bench, "typical", [fault], 1)
    assert o.answer == "safe state"
    assert "was told" in o.message
    assert "check the wires of the bus" in o.message
    assert o.detect_ms is not None
    assert o.detect_ms < 3.0


def test_a_bench_with_a_broken_sensor_does_not_start(tmp_path: Path):
    bench = write_bench(DEFAULT_BENCH, POINTS[0], tmp_path)
    fault = next(fault for fault in faults() if fault.name == "sensor: wire broken at start")
    o = observe_start(bench, "steady", fault, 1)
    assert o.answer == "refused"
    assert "acc1.z (DAQ input 1)" in o.message


def test_a_ramp_that_took_longer_than_promised_is_not_reported_as_on_time(tmp_path: Path):
    """Every transfer of the ramp has a wrong bit, too: neutral is late, and the report says so."""
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    fault = next(f for f in faults() if f.name == "output bus: a bit wrong in every transfer")
    (o,) = observe_running(bench, "typical", [fault], 133569468)
    assert o.neutral_ms is not None
    assert o.neutral_ms > 21.0
    assert not o.false_neutral
    assert "neutral was confirmed only after 2" in o.message


def test_a_firmware_that_dies_with_its_outputs_at_neutral_leaves_them_there(tmp_path: Path):
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    fault = next(f for f in faults() if f.name == "host: firmware killed (kill -9)")
    (o,) = observe_running(bench, "typical", [fault], 1, SELF_TEST)
    assert (o.confirmed, o.false_neutral, o.rough) == (True, False, 0)
    assert "died with its outputs at neutral" in o.message


def test_scans_of_a_line_that_fails_again_and_again_in_the_self_test_are_counted(tmp_path: Path):
    """Every new start may fail before its first scan is read."""
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    names = ("serial: bytes doubled", "serial: one byte in a thousand lost", "output bus: adapter unplugged")
    chosen = [next(f for f in faults() if f.name == name) for name in names]
    doubled, lost, unplugged = observe_running(bench, "typical", chosen, 2, SELF_TEST)
    assert (doubled.uncounted, lost.uncounted) == (0, 0)
    assert unplugged.message.startswith("piezo: ")


def test_both_faults_of_a_pair_on_one_bus_act(tmp_path: Path):
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    wrong, late = (
        next(f for f in faults() if f.name == f"output bus: {name}")
        for name in ("a bit wrong in every transfer", "transfers 1 ms late")
    )
    (o,) = observe_running(bench, "typical", [join(wrong, late, 0.001)], 1)
    assert o.answer == "safe state"
    assert "commands were late" in o.noticed


def test_a_hold_whose_ramp_was_held_up_says_when_neutral_was_reached(tmp_path: Path):
    """The host stands still within the ramp of a hold."""
    bench = write_bench(DEFAULT_BENCH, POINTS[1], tmp_path)
    killed, stall = (
        next(f for f in faults() if f.name == f"host: {name}")
        for name in ("guardian killed (kill -9)", "stalls for 50 ms")
    )
    (o,) = observe_running(bench, "typical", [join(killed, stall, 0.012)], 1)
    assert o.neutral_ms is not None
    assert o.neutral_ms > 21.0
    assert not o.false_neutral


def test_outputs_that_rest_beside_neutral_in_a_hold_are_seen(tmp_path: Path):
    bench = write_bench(DEFAULT_BENCH, POINTS[0], tmp_path)
    killed = next(f for f in faults() if f.name == "host: guardian killed (kill -9)")
    wrong = next(f for f in faults() if f.name == "output bus: a bit wrong in every transfer")
    (o,) = observe_running(bench, "steady", [join(killed, wrong, 0.012)], 35582166)
    assert o.answer == "safe state"
    assert not o.false_neutral
