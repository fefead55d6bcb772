"""The honest I2C bus: unmodified smbus2 opens a file, the kernel carries its ioctls, the chip is in other processes."""

from __future__ import annotations

import errno
import importlib
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import smbus2

from hal.backends.open import open_i2c
from hal.errors import I2cNack
from hal.types import I2cRead, I2cWrite
from sim_devices.process_world import ProcessWorld
from sim_devices.register import provider
from tests.contract.imu_contract import CHIPS, DESCRIPTION, check_imu

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="level C needs root (it mounts a file system)"),
    pytest.mark.skipif(not os.access("/dev/fuse", os.R_OK | os.W_OK), reason="level C needs /dev/fuse"),
]


class WorldClock:
    """Reads the time of the emulated world, which waits for a host that is too slow for it."""

    def __init__(self, world: ProcessWorld) -> None:
        self._world = world

    def now_ns(self) -> int:
        return round(self._world.control({"list": True})["t_s"] * 1e9)

    def sleep_until_ns(self, t_ns: int) -> int:
        while (wait_ns := t_ns - self.now_ns()) > 0:
            time.sleep(wait_ns * 1e-9)
        return -wait_ns


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessWorld]:
    # it serves programs of others: a host that is too slow makes its time slow, and no transfer waits for the rest
    description = {**DESCRIPTION, "emulation": {**DESCRIPTION["emulation"], "serve": {}}}
    runtime = tmp_path_factory.mktemp("run")
    world = provider(description, clock=None, runtime_dir=runtime, hand_file=None, hand_scale=None)
    assert isinstance(world, ProcessWorld)
    yield world
    world.stop()


@pytest.fixture(scope="module")
def device_file(world: ProcessWorld, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("mount")
    command = [sys.executable, "-m", "tests.contract.i2c_fuse", world.endpoint("i2c0"), str(folder)]
    daemon = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert daemon.stdout is not None
    assert daemon.stderr is not None
    try:
        if daemon.stdout.readline() != "ready\n":
            pytest.skip(f"level C: no FUSE mount here: {daemon.stderr.read().strip()}")
        yield str(folder / "i2c-1")
    finally:
        daemon.terminate()
        daemon.wait(10)
        daemon.stdout.close()
        daemon.stderr.close()


def test_smbus2_identifies_the_chip(device_file: str) -> None:
    with smbus2.SMBus(device_file) as bus:
        assert bus.read_byte_data(0x69, 0x75) == 0x68
        assert bus.read_i2c_block_data(0x69, 0x75, 1) == [0x68]


def test_combined_transfer_and_burst(device_file: str) -> None:
    with smbus2.SMBus(device_file) as bus:
        bus.write_byte_data(0x69, 0x6B, 0x80)  # reset: another test of the module may have left a range or offsets
        while bus.read_byte_data(0x69, 0x6B) & 0x80:
            time.sleep(0.001)
        bus.write_byte_data(0x69, 0x1A, 3)
        bus.write_byte_data(0x69, 0x6B, 0)
        bus.write_byte_data(0x69, 0x38, 1)
        for _ in range(400):  # settles in some 100 ms; each look takes its bus time
            write, read = smbus2.i2c_msg.write(0x69, [0x3B]), smbus2.i2c_msg.read(0x69, 14)
            bus.i2c_rdwr(write, read)
        values = list(read)
        assert int.from_bytes(bytes(values[:2]), "big", signed=True) == pytest.approx(-8188, abs=8)
        assert bus.read_byte_data(0x69, 0x3A) == 1


def test_nack_is_enxio(device_file: str) -> None:
    with smbus2.SMBus(device_file) as bus:
        with pytest.raises(OSError, match="No such device or address") as refused:
            bus.read_byte_data(0x50, 0)
        assert refused.value.errno == errno.ENXIO


def test_our_own_linux_backend(device_file: str) -> None:
    bus = open_i2c(f"linux-i2c://{device_file}")
    try:
        assert bus.transfer(0x69, [I2cWrite(b"\x75"), I2cRead(1)]) == b"\x68"
        with pytest.raises(I2cNack):
            bus.transfer(0x50, [I2cRead(1)])
    finally:
        bus.close()


@pytest.mark.parametrize("name", CHIPS)
def test_our_drivers_are_the_same_here(world: ProcessWorld, device_file: str, name: str) -> None:
    bus = open_i2c(f"linux-i2c://{device_file}")
    try:
        check_imu(name, bus, WorldClock(world))
    finally:
        bus.close()


def test_third_party_driver_on_real_smbus2(device_file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("mpu6050") is None:
        pytest.skip("mpu6050-raspberrypi is not installed; install the dev extra")
    monkeypatch.setitem(sys.modules, "smbus", smbus2)
    for name in ("mpu6050", "mpu6050.mpu6050"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    driver = importlib.import_module("mpu6050").mpu6050(0x69, device_file)
    try:
        driver.set_accel_range(driver.ACCEL_RANGE_4G)
        assert driver.read_accel_range() == 4
        assert driver.get_temp() == pytest.approx(25.0, abs=0.01)
    finally:
        driver.bus.close()
