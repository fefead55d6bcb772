"""Outputs: refused before arming, at neutral after it, where they were told to be, and neutral at the end."""

from __future__ import annotations

import numpy as np
import pytest

from hal.errors import SafetyTrip
from tests.hil.conftest import Stand


@pytest.mark.effect(0)
def test_nothing_moves_before_arming(stand: Stand):
    amplifier = stand.devices.amplifier
    with pytest.raises(SafetyTrip):
        amplifier.write(np.array([limit.safe_V for limit in amplifier.limits]))


@pytest.mark.effect(2)
def test_arming_ends_at_neutral(stand: Stand):
    amplifier = stand.devices.amplifier
    amplifier.arm()
    assert amplifier.readback_V() == pytest.approx([limit.safe_V for limit in amplifier.limits], abs=0.01)


@pytest.mark.effect(2)
def test_a_small_step_reads_back(stand: Stand):
    amplifier, clock = stand.devices.amplifier, stand.bench.clock
    amplifier.arm()
    wanted = np.array([limit.safe_V for limit in amplifier.limits]) + np.array([1.0, -1.0, 0.5])
    for _ in range(5):
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
        amplifier.write(wanted)
    assert amplifier.readback_V() == pytest.approx(wanted, abs=0.01)


@pytest.mark.effect(2)
def test_not_a_number_is_refused(stand: Stand):
    amplifier = stand.devices.amplifier
    amplifier.arm()
    with pytest.raises(SafetyTrip):
        amplifier.write(np.array([np.nan, 50.0, 50.0]))


@pytest.mark.effect(3)
def test_neutral_within_twenty_steps_from_anywhere(stand: Stand):
    amplifier, clock = stand.devices.amplifier, stand.bench.clock
    amplifier.arm()
    for _ in range(20):
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
        amplifier.write(np.array([limit.hi_V for limit in amplifier.limits]))
    steps = 1
    while not amplifier.safe_step():
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
        steps += 1
    assert steps <= 20
    assert amplifier.readback_V() == pytest.approx([limit.safe_V for limit in amplifier.limits], abs=0.01)
    with pytest.raises(SafetyTrip):
        amplifier.write(np.array([50.0, 50.0, 50.0]))
