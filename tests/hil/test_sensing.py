"""What must be true of the sensors of any bench: physics is the oracle, not the emulator's truth."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.control.wiring import ACCELEROMETERS
from hal.types import Status
from tests.hil.conftest import Stand

G = 9.81


def scan(stand: Stand, n: int) -> tuple[np.ndarray, np.ndarray]:
    """``n`` scans in volts (n, 8) and their times in ns."""
    daq, info = stand.devices.daq, stand.devices.scan
    buffer = np.zeros((256, len(info.channels)), dtype=np.int16)
    rows, times = [], []
    daq.start()
    while len(rows) < n:
        block = daq.read_scans(buffer, 0.1)
        assert block.n > 0, "no scan within 100 ms"
        assert block.lost == 0
        assert not block.status & Status.GAP
        rows += [buffer[i].copy() for i in range(block.n)]
        times += [block.t0_ns + i * block.dt_ns for i in range(block.n)]
    daq.stop()
    return np.array(rows[:n]) * np.array(info.lsb_V), np.array(times[:n])


@pytest.mark.effect(1)
def test_scans_come_at_their_rate_and_in_order(stand: Stand):
    _, times_ns = scan(stand, 1000)
    steps = np.diff(times_ns)
    assert np.all(steps > 0)
    assert (times_ns[-1] - times_ns[0]) / 999 == pytest.approx(1e6, rel=0.02)


@pytest.mark.effect(1)
def test_at_rest_in_a_hand_the_readings_are_near_gravity(stand: Stand):
    """Six axes give each body axis twice: the vector of their means has the size of g within 5 % (uncalibrated)."""
    volts, _ = scan(stand, 500)
    readings = (volts[:, :6].mean(axis=0) - 2.5) * G
    by_axis = {a: [readings[i] for i, (_, axis) in enumerate(ACCELEROMETERS) if axis == a] for a in "xyz"}
    size = np.linalg.norm([np.mean(values) for values in by_axis.values()])
    assert size == pytest.approx(G, rel=0.05)


@pytest.mark.effect(1)
def test_supply_and_temperature_are_plausible(stand: Stand):
    volts, _ = scan(stand, 100)
    assert 4.75 <= 2 * volts[:, 6].mean() <= 5.25
    assert 10.0 <= (volts[:, 7].mean() - 0.5) / 0.010 <= 45.0


@pytest.mark.effect(1)
def test_every_axis_makes_noise_and_none_is_stuck(stand: Stand):
    volts, _ = scan(stand, 500)
    noise_V = np.diff(volts[:, :6], axis=0).std(axis=0)
    assert np.all(noise_V > 1e-5)
    assert np.all(noise_V < 20e-3)


@pytest.mark.effect(1)
@pytest.mark.needs("mag")
def test_the_magnetic_field_is_the_earths(stand: Stand):
    magnetometer = stand.devices.magnetometer
    assert magnetometer is not None
    clock = stand.bench.clock
    limit_ns = clock.now_ns() + 1_000_000_000
    while not magnetometer.poll():
        assert clock.now_ns() < limit_ns, "no reading within 1 s"
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
    assert 20e-6 <= np.linalg.norm(magnetometer.field_T) <= 75e-6
