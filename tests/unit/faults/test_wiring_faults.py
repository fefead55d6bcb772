"""Faults between plant and devices do to volts and demands what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.wiring_faults import WiringFaults

VOLTS = np.array([2.6, 2.2, 3.5, 2.4, 2.5, 3.4, 2.5, 0.75])


@pytest.mark.parametrize(
    ("kind", "amount", "expected_V"),
    [
        ("stuck", None, 3.5),
        ("open", None, 0.0),
        ("short", None, 5.0),
        ("saturate", None, 4.2),
        ("drift", 0.1, 3.6 + 0.1 * 2.0),
        ("gain", 0.5, 2.5 + 0.5 * 1.1),
        ("sign", None, 1.4),
    ],
)
def test_one_input_changes_and_the_others_do_not(kind: str, amount: float | None, expected_V: float):
    faults = WiringFaults()
    faults.inputs(VOLTS, 0)
    faults.sensor(2, kind, amount, 1_000_000_000)
    later = VOLTS + 0.1 * (np.arange(8) == 2)
    out = faults.inputs(later, 3_000_000_000)
    assert out[2] == pytest.approx(expected_V)
    np.testing.assert_array_equal(np.delete(out, 2), np.delete(VOLTS, 2))
    faults.sensor(2, "ok", None, 3_000_000_000)
    assert faults.inputs(later, 4_000_000_000) is later


def test_a_spike_is_one_conversion():
    faults = WiringFaults()
    faults.sensor(0, "spike", 0.5, 0)
    assert [faults.inputs(VOLTS, t)[0] for t in range(3)] == [3.1, 2.6, 2.6]


def test_two_inputs_are_exchanged():
    faults = WiringFaults()
    faults.sensor(2, "swap", 1.0, 0)
    faults.sensor(3, "swap", -1.0, 0)
    np.testing.assert_array_equal(faults.inputs(VOLTS, 1)[2:4], VOLTS[[3, 2]])


@pytest.mark.parametrize(("kind", "expected_V"), [("open", 0.0), ("rail", 100.0), ("stuck", 60.0), ("weak", 55.0)])
def test_actuator_faults(kind: str, expected_V: float):
    faults = WiringFaults()
    told: list[float] = []
    faults.on_demand = lambda channel, volts: told.append(volts)
    assert faults.demand(1, 60.0) == 60.0
    assert faults.actuator(1, kind, None, 0) == expected_V
    assert faults.demand(1, 60.0) == expected_V
    assert faults.demand(0, 60.0) == 60.0
    assert told == [60.0, 60.0, 60.0]


def test_a_slow_channel_follows_by_two_percent_an_update():
    faults = WiringFaults()
    faults.demand(0, 50.0)
    faults.actuator(0, "slow", None, 0)
    assert [faults.demand(0, 60.0) for _ in range(3)] == pytest.approx([50.2, 50.396, 50.58808])
