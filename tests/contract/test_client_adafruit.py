"""The emulated ADS1115 and MPU-6050 with Adafruit's drivers, which open ``/dev/i2c-1`` by themselves."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.emulated_client import need_client, run_client

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

CONTROL = """
import json, os, socket, time
control = socket.socket(socket.AF_UNIX)
control.connect(os.environ["MICRON_CONTROL"])
answers = control.makefile()

def put(**values):
    named = {name.replace("__", "."): value for name, value in values.items()}
    control.sendall(json.dumps({"set": named}).encode() + b"\\n")
    assert json.loads(answers.readline())["ok"]

from adafruit_extended_bus import ExtendedI2C
i2c = ExtendedI2C(1)
"""


def test_ads1x15_measures_what_is_put_at_its_inputs(tmp_path: Path) -> None:
    need_client("adafruit_ads1x15")
    program = """
from adafruit_ads1x15 import ADS1115, AnalogIn
while not i2c.try_lock():
    pass
found = i2c.scan()
i2c.unlock()
adc = ADS1115(i2c)
put(adc__0=1.0, adc__1=0.25, adc__3=3.0)
volts = [AnalogIn(adc, n).voltage for n in (0, 1, 3)]
print(json.dumps({"found": found, "volts": volts, "difference": AnalogIn(adc, 0, 1).voltage}))
"""
    seen = run_client(tmp_path, CONTROL + program)
    assert seen["found"] == [0x0C, 0x48, 0x68]
    assert seen["volts"] == pytest.approx([1.0, 0.25, 3.0], abs=2 * 125e-6)  # 125 uV at +-4.096 V
    assert seen["difference"] == pytest.approx(0.75, abs=2 * 125e-6)


def test_mpu6050_feels_what_is_put_at_its_axes(tmp_path: Path) -> None:
    need_client("adafruit_mpu6050")
    program = """
from adafruit_mpu6050 import MPU6050
chip = MPU6050(i2c)
put(imu__ax=1.0, imu__ay=-2.0, imu__az=3.0, imu__gx=0.5, imu__gy=0.0, imu__gz=-1.0, imu__temperature=30.0)
time.sleep(0.2)
rows = [(*chip.acceleration, *chip.gyro, chip.temperature) for _ in range(50)]
print(json.dumps([sum(column) / len(rows) for column in zip(*rows)]))
"""
    seen = run_client(tmp_path, CONTROL + program)
    # the chip has the errors that its data sheet allows: 50 and 80 mg of offset, 20 deg/s, 3 % of scale
    assert seen[:2] == pytest.approx([1.0, -2.0], abs=0.05 * 9.81 + 0.06)
    assert seen[2] == pytest.approx(3.0, abs=0.08 * 9.81 + 0.09)
    assert seen[3:6] == pytest.approx([0.5, 0.0, -1.0], abs=0.35 + 0.03)
    assert seen[6] == pytest.approx(30.0, abs=8.0)
