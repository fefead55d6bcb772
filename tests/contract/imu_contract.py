"""What every inertial sensor's driver must do on whatever carries its bus: in process, or the honest bus of level C.

The emulated body lies still, pitched by 30 degrees, without sensor errors and noise.
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.base import wait_s
from drivers.imu.base import Imu, ImuOffsets, ImuSample
from drivers.imu.bench import IMU_OPTIONS, open_imu
from hal.bench import DeviceSpec
from hal.contracts import Clock, I2cBus
from hal.types import Status

G = 9.80665
PITCH = math.radians(30.0)
UP = (-G * math.sin(PITCH), 0.0, G * math.cos(PITCH))
CHIPS: dict[str, dict[str, Any]] = {
    "mpu6050": {"address": 0x69},
    "lsm6ds3": {"address": 0x6A, "rate_hz": 104},
    "bmx055": {"address": 0x18, "gyro_address": 0x68, "mag_address": 0x10, "mag_rate_hz": 0},
}
DESCRIPTION: dict[str, Any] = {
    "format": 1,
    "name": "endoscope",
    "emulation": {
        "seed": 7,
        "endoscope": {"scenario": "rest", "attitude_deg": [0.0, 30.0, 0.0], "start_C": 25.0, "end_C": 25.0},
        "imu": {name: {"errors": 0.0, "noise": 0.0} for name in CHIPS},
    },
    "bus": {"i2c0": {"kind": "i2c", "uri": "sim://i2c0", "speed_hz": 400_000}},
    "device": {name: {"driver": name, "bus": "i2c0", **keys} for name, keys in CHIPS.items()},
}


def opened(name: str, bus: I2cBus, clock: Clock) -> Imu:
    spec = DeviceSpec.model_validate(DESCRIPTION["device"][name])
    options = IMU_OPTIONS[name].model_validate(spec.options())
    return open_imu(spec, options, bus, clock, name)


def fresh(imu: Imu, clock: Clock) -> ImuSample:
    """The next sample that is new."""
    sample = ImuSample()
    for _ in range(200):
        if not imu.read(sample) & Status.STALE:
            return sample
        wait_s(clock, 0.002)
    pytest.fail("no new sample within 0.4 s")


def check_imu(name: str, bus: I2cBus, clock: Clock) -> None:
    """Identity, reset, ranges, self-test, samples of the truth, offset registers there and back."""
    imu = opened(name, bus, clock)
    assert imu.self_test().passed
    imu.start()
    wait_s(clock, 0.2)
    sample = fresh(imu, clock)
    step = 4 * G / 1000  # the coarsest of the three steps 0.98 mg; four of them
    assert sample.accel_mps2 == pytest.approx(UP, abs=step)
    assert sample.gyro_rad_s == pytest.approx((0.0, 0.0, 0.0), abs=0.003)
    before, seq = imu.read_offsets(), sample.seq
    assert fresh(imu, clock).seq > seq
    kept = imu.write_offsets(ImuOffsets((before.accel_mps2[0] + 0.5, *before.accel_mps2[1:]), before.gyro_rad_s))
    assert imu.read_offsets() == kept
    wait_s(clock, 0.1)
    fresh(imu, clock)
    assert fresh(imu, clock).accel_mps2[0] - UP[0] == pytest.approx(0.5, abs=G / 128)  # the BMX055's register step
