"""A public driver that none of us wrote (PyPI: mpu6050-raspberrypi) against the emulated MPU-6050.

The package imports ``smbus``; here that is a module of thirty lines whose bus is the emulated one in virtual time.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from hal.clock import VirtualClock
from hal.contracts import I2cBus
from hal.types import I2cRead, I2cWrite
from sim_devices.lockstep_world import LockstepWorld
from sim_devices.register import provider

DESCRIPTION: dict[str, Any] = {
    "format": 1,
    "name": "endoscope",
    "emulation": {
        "provider": "sim_devices.register:provider",
        "seed": 7,
        "endoscope": {"scenario": "turntable", "attitude_deg": [0.0, 30.0, 0.0], "rate_dps": 100.0},
        "imu": {"imu": {"errors": 0.0, "noise": 0.0}},
    },
    "bus": {"i2c0": {"kind": "i2c", "uri": "sim://i2c0", "speed_hz": 400_000}},
    "device": {"imu": {"driver": "mpu6050", "bus": "i2c0", "address": 0x69}},
}
DESCRIPTION["emulation"]["endoscope"] |= {"start_C": 31.0, "end_C": 31.0}


class EmulatedSmbus:
    """The calls of ``smbus.SMBus`` that byte-register drivers use."""

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus

    def read_byte_data(self, address: int, register: int) -> int:
        return self._bus.transfer(address, [I2cWrite(bytes((register,))), I2cRead(1)])[0]

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        self._bus.transfer(address, [I2cWrite(bytes((register, value)))])

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        return list(self._bus.transfer(address, [I2cWrite(bytes((register,))), I2cRead(length)]))


class Bench:
    def __init__(self, driver: Any, clock: VirtualClock, world: LockstepWorld) -> None:
        self.driver, self.clock, self.world = driver, clock, world


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bench]:
    if importlib.util.find_spec("mpu6050") is None:
        pytest.skip("mpu6050-raspberrypi is not installed; install the dev extra")
    clock = VirtualClock()
    world = provider(DESCRIPTION, clock=clock, runtime_dir=tmp_path, hand_file=None, hand_scale=None)
    assert isinstance(world, LockstepWorld)
    shim = ModuleType("smbus")
    shim.SMBus = lambda bus: EmulatedSmbus(world.endpoint("i2c0"))  # type: ignore[attr-defined, arg-type]
    monkeypatch.setitem(sys.modules, "smbus", shim)
    monkeypatch.delitem(sys.modules, "mpu6050", raising=False)
    monkeypatch.delitem(sys.modules, "mpu6050.mpu6050", raising=False)
    package = importlib.import_module("mpu6050")
    yield Bench(package.mpu6050(0x69), clock, world)
    world.stop()


def test_wakes_the_chip_and_reads_the_truth_at_rest(bench: Bench) -> None:
    bench.clock.advance_to(500_000_000)
    accel = bench.driver.get_accel_data()
    # pitch +30 deg: body x points 30 deg down, so gravity's reaction shows -g sin 30 there
    assert accel["x"] == pytest.approx(-0.5 * 9.80131, abs=0.002)
    assert accel["y"] == pytest.approx(0.0, abs=0.002)
    assert accel["z"] == pytest.approx(0.866025 * 9.80131, abs=0.002)
    assert bench.driver.get_temp() == pytest.approx(31.0, abs=0.01)
    assert all(abs(rate) < 0.02 for rate in bench.driver.get_gyro_data().values())


@pytest.mark.parametrize("range_g", [2, 4, 8, 16])
def test_accelerometer_ranges(bench: Bench, range_g: int) -> None:
    bench.driver.set_accel_range(getattr(bench.driver, f"ACCEL_RANGE_{range_g}G"))
    bench.clock.advance_to(500_000_000)
    assert bench.driver.read_accel_range() == range_g
    assert bench.driver.get_accel_data(g=True)["x"] == pytest.approx(-0.5 * 9.80131 / 9.80665, abs=range_g / 32768)


@pytest.mark.parametrize("range_dps", [250, 500, 1000, 2000])
def test_gyroscope_ranges_on_the_turntable(bench: Bench, range_dps: int) -> None:
    bench.driver.set_gyro_range(getattr(bench.driver, f"GYRO_RANGE_{range_dps}DEG"))
    bench.driver.set_filter_range(bench.driver.FILTER_BW_42)
    bench.clock.advance_to(2_500_000_000)
    assert bench.driver.read_gyro_range() == range_dps
    rate = bench.driver.get_gyro_data()
    # 100 dps about the vertical, seen from a body pitched by 30 deg
    assert rate["x"] == pytest.approx(-50.0, abs=range_dps / 32768 + 0.02)
    assert rate["z"] == pytest.approx(86.6025, abs=range_dps / 32768 + 0.02)
    assert len(bench.driver.get_all_data()) == 3


def test_truth_of_the_turntable(bench: Bench) -> None:
    bench.driver.set_filter_range(bench.driver.FILTER_BW_5)
    bench.clock.advance_to(2_000_000_000)
    bench.world.stop()
    truth = bench.world.truth()
    assert truth["t_ns"][-1] == 2_000_000_000
    assert truth["rate_rad_s"][-1] == pytest.approx([-0.872665, 0.0, 1.511499], abs=1e-6)
