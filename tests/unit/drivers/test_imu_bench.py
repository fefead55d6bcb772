"""Inertial sensors and motion card in a bench file: bus time by hand, clashing addresses, what is made of it."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import pytest

from drivers.bus_use import bus_uses
from drivers.imu.bench import make_imu
from drivers.imu.bmx055 import Bmx055
from drivers.imu.lsm6ds3 import Lsm6ds3
from drivers.imu.mpu6050 import Mpu6050
from drivers.polling import polling_of
from drivers.specs import check_devices
from hal.bench import BenchFile, load_bench
from hal.clock import VirtualClock
from hal.errors import BenchError
from tests.wire.drivers.scripted_ports import ScriptedI2c

HEAD = """
format = 1
name = "imus"
[bus.i2c0]
kind = "i2c"
uri = "linux-i2c://1"
speed_hz = 400_000
[bus.i2c1]
kind = "i2c"
uri = "linux-i2c://2"
[bus.card0]
kind = "serial"
uri = "serial:///dev/ttyUSB0"
"""


def bench(tmp_path: Path, *devices: str) -> BenchFile:
    path = tmp_path / "bench.toml"
    text = HEAD
    for i, device in enumerate(devices):
        text += f"[device.dev{i}]\n{device}\n"
    path.write_text(text)
    return load_bench(path)


def problem(tmp_path: Path, *devices: str) -> str:
    file = bench(tmp_path, *devices)
    with pytest.raises(BenchError) as caught:
        check_devices(file.description, str(file.path))
    return str(caught.value)


def imu(driver: str, more: str = "", bus: str = "i2c0") -> str:
    lowest = {"mpu6050": "address = 0x68\n", "lsm6ds3": "address = 0x6a\n", "bmx055": "address = 0x18\n"}
    address = "" if more.startswith("address") else lowest.get(driver, "")
    return f'driver = "{driver}"\nbus = "{bus}"\n{address}{more}'


def shares(file: BenchFile) -> dict[str, float]:
    """Part of its bus that each device asks for."""
    options = check_devices(file.description, str(file.path))
    found: dict[str, float] = defaultdict(float)
    for use in bus_uses(file.description, options, polling_of(file.description, options)[0]):
        found[use.device] += use.share
    return found


def test_endoscope_bench_is_valid():
    file = load_bench(Path(__file__).parents[3] / "benches" / "endoscope.toml")
    loads = shares(file)
    assert loads["imu"] == pytest.approx(100 * 165 / 400_000)
    assert loads["card"] == pytest.approx(100 * 55 * 10 / 115_200)


def test_three_imus_at_1_khz_are_refused_with_the_arithmetic(tmp_path: Path):
    """By hand: (3 + 15) x 9 + 3 = 165 bit; (3 + 16) x 9 + 3 = 174; 93 + 84 + 39 + 84 = 300, and 10 x 102 a second."""
    message = problem(
        tmp_path,
        imu("mpu6050", "rate_hz = 1000"),
        imu("lsm6ds3", "rate_hz = 1000"),
        imu("bmx055", "rate_hz = 1000\ngyro_address = 0x69\nmag_address = 0x11"),
    )
    assert "[bus.i2c0] is asked for 160 % of its time" in message
    assert "dev0 sample 1000/s x 165 bit = 41.2 %" in message
    assert "dev1 sample 1000/s x 174 bit = 43.5 %" in message
    assert "dev2 sample 1000/s x 300 bit = 75.0 %" in message
    assert "lower rate_hz of 'dev2'" in message


def test_fifo_bus_time_by_hand(tmp_path: Path):
    """MPU-6050: 50 x (39 + 48 + 30) bit for status, count and head, and 14 bytes a frame. The LSM6DS3 has no
    1 kHz: its FIFO fills at 1660 Hz."""
    file = bench(
        tmp_path,
        imu("mpu6050", 'rate_hz = 1000\nmode = "fifo"'),
        imu("lsm6ds3", 'rate_hz = 1000\nmode = "fifo"', "i2c1"),
    )
    loads = shares(file)
    assert loads["dev0"] == pytest.approx((50 * 117 + 1000 * 126) / 400_000)
    assert loads["dev1"] == pytest.approx((50 * 162 + 1660 * 108) / 400_000)


def test_mpu6050_and_bmx055_gyro_at_0x68(tmp_path: Path):
    message = problem(tmp_path, imu("mpu6050", "address = 0x68"), imu("bmx055"))
    assert "0x68 on 'i2c0' is claimed by 'dev0' (MPU6050) and the gyro of 'dev1' (BMX055)" in message
    assert "tie AD0 of 'dev0' high (address = 0x69)" in message
    assert "tie SDO2 of 'dev1' high (gyro_address = 0x69, mag_address = 0x11)" in message
    check_devices(bench(tmp_path, imu("mpu6050"), imu("bmx055", bus="i2c1")).description, "")
    check_devices(bench(tmp_path, imu("mpu6050", "address = 0x69"), imu("bmx055")).description, "")


def test_two_of_one_family_need_two_straps(tmp_path: Path):
    with pytest.raises(BenchError, match=r"\[device.dev1.address\] 0x6a on 'i2c0' is already taken by 'dev0'"):
        bench(tmp_path, imu("lsm6ds3"), imu("lsm6ds3"))
    check_devices(bench(tmp_path, imu("lsm6ds3"), imu("lsm6ds3", "address = 0x6b")).description, "")


@pytest.mark.parametrize(
    ("device", "words"),
    [
        (imu("mpu6050", "address = 0x6a"), "0x68 or 0x69, which AD0 selects"),
        (imu("bmx055", "gyro_address = 0x69"), "SDO2"),
        (imu("mpu6050", "gyro_range_dps = 125"), "125 is not one of"),
        (imu("lsm6ds3", "rate_hz = 2000"), "rate_hz"),
        (imu("bmx055", "mag_rate_hz = 12"), "12 is not one of"),
        (imu("mpu6050", 'mode = "interrupt"'), "mode"),
        ('driver = "mpu6050"', "needs 'bus = ...'"),
        ('driver = "mpu6050"\nbus = "i2c0"', "[device.dev0.address] is missing; it is 0x68 or 0x69"),
        (imu("motion_card", "rate_hz = 1000", "card0"), "line 1000/s x 550 bit = 477.4 %"),
    ],
)
def test_refusals(tmp_path: Path, device: str, words: str):
    assert words in problem(tmp_path, device)


def test_drivers_made_from_the_bench(tmp_path: Path):
    file = bench(
        tmp_path,
        imu("mpu6050", "address = 0x69"),
        imu("lsm6ds3"),
        imu("bmx055", "mag_rate_hz = 0"),
    )
    options = check_devices(file.description, "")
    made = [
        make_imu(spec, options[name], ScriptedI2c([]), VirtualClock(), name)
        for name, spec in file.description.device.items()
    ]
    assert [type(m) for m in made] == [Mpu6050, Lsm6ds3, Bmx055]
    assert [m.name for m in made] == ["dev0", "dev1", "dev2"]
    assert len(made[2].channels()) == 7  # no magnetometer
