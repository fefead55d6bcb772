"""The drivers unchanged on emulated chips that others wrote from the data sheets: all three parts on one bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.imu.base import ImuBlock, ImuSample
from drivers.imu.bench import open_imu
from drivers.motion_card import MotionCard
from drivers.specs import check_devices
from hal.bench import load_bench, open_bench
from hal.types import Status

BENCH = """
format = 1
name = "three"
[emulation]
provider = "sim_devices.register:provider"
unit = 1
seed = 1
[bus.i2c0]
kind = "i2c"
uri = "sim://i2c0"
[bus.card0]
kind = "serial"
uri = "sim://card0"
[device.mpu]
driver = "mpu6050"
bus = "i2c0"
address = 0x69
[device.lsm]
driver = "lsm6ds3"
bus = "i2c0"
address = 0x6A
[device.bmx]
driver = "bmx055"
bus = "i2c0"
address = 0x18
[device.card]
driver = "motion_card"
bus = "card0"
"""


@pytest.mark.parametrize("name", ["mpu", "lsm", "bmx"])
def test_a_sensor_measures_gravity_tests_itself_and_fills_its_fifo(tmp_path: Path, name: str):
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    file = load_bench(path)
    options = check_devices(file.description, str(path))
    with open_bench(file, pace="virtual", runtime_dir=tmp_path) as bench:
        clock = bench.clock
        imu = open_imu(file.description.device[name], options[name], bench.i2c("i2c0"), clock, name)
        imu.start()
        period_ns = round(1e9 / options[name].rate_hz)
        out = ImuSample()
        due_ns = clock.now_ns()
        seen: list[Status] = []
        for _ in range(50):
            due_ns += period_ns
            clock.sleep_until_ns(due_ns)
            seen.append(imu.read(out))
        assert seen.count(Status.OK) >= 45  # the chip's clock and ours drift: now and then none or two
        assert np.linalg.norm(out.accel_mps2) == pytest.approx(9.8, abs=1.5)
        assert out.temperature_C == pytest.approx(25.0, abs=10.0)
        assert imu.self_test().passed
        imu.start("fifo")
        block = ImuBlock()
        n = 0
        for _ in range(5):
            clock.sleep_until_ns(clock.now_ns() + 10 * period_ns)
            n += imu.read_fifo(block)
            assert block.status is Status.OK
        assert block.seq0 + block.n == n >= 49
        assert np.linalg.norm(block.accel_mps2[: block.n], axis=1) == pytest.approx(9.8, abs=1.5)


def test_motion_card_on_its_line(tmp_path: Path):
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    with open_bench(load_bench(path), pace="virtual", runtime_dir=tmp_path) as bench:
        card = MotionCard(bench.serial("card0"), bench.clock)
        card.probe()
        out = ImuSample()
        taken = 0
        for _ in range(100):
            bench.clock.sleep_until_ns(bench.clock.now_ns() + 10_000_000)
            taken += Status.STALE not in card.read(out)
        assert taken >= 98
        assert card.parser.bad_frames == 0
        assert np.linalg.norm(out.accel_mps2) == pytest.approx(9.8, abs=1.5)
