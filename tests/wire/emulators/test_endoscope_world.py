"""IMUs and motion card in a world: buses, addresses, mounting, faults, virtual and real time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from hal.clock import VirtualClock
from hal.errors import BenchError, I2cNack
from hal.types import I2cRead, I2cWrite
from sim_devices.lockstep_world import LockstepWorld
from sim_devices.process_world import ProcessWorld
from sim_devices.register import provider

MS = 1_000_000


def description(**devices: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": 1,
        "name": "endoscope",
        "emulation": {"seed": 3, "endoscope": {"scenario": "hand"}},
        "bus": {
            "i2c0": {"kind": "i2c", "uri": "sim://i2c0", "speed_hz": 400_000},
            **({"card0": {"kind": "serial", "uri": "sim://card0", "baud": 115_200}} if "card" in devices else {}),
        },
        "device": devices,
    }


MPU = {"driver": "mpu6050", "bus": "i2c0", "address": 0x69}
LSM = {"driver": "lsm6ds3", "bus": "i2c0", "address": 0x6A}
BMX = {"driver": "bmx055", "bus": "i2c0", "address": 0x18}
CARD = {"driver": "motion_card", "bus": "card0"}


def start(table: dict[str, Any], tmp_path: Path) -> tuple[LockstepWorld, VirtualClock]:
    clock = VirtualClock(5_000_000_000)
    world = provider(table, clock=clock, runtime_dir=tmp_path, hand_file=None, hand_scale=None)
    assert isinstance(world, LockstepWorld)
    return world, clock


def test_three_kinds_on_one_bus_answer_with_their_identities(tmp_path: Path) -> None:
    world, clock = start(description(a=MPU, b=LSM, c=BMX), tmp_path)
    bus = world.endpoint("i2c0")
    clock.advance_to(clock.now_ns() + 20 * MS)
    bus.transfer(0x10, [I2cWrite(b"\x4b\x01")])  # type: ignore[union-attr]
    clock.advance_to(clock.now_ns() + 5 * MS)
    who = ((0x69, 0x75, 0x68), (0x6A, 0x0F, 0x69), (0x18, 0x00, 0xFA), (0x68, 0x00, 0x0F), (0x10, 0x40, 0x32))
    for address, register, identity in who:
        assert bus.transfer(address, [I2cWrite(bytes((register,))), I2cRead(1)]) == bytes((identity,))  # type: ignore[union-attr]


def test_mpu6050_and_bmx055_gyroscope_clash_at_0x68(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="0x68"):
        start(description(a=MPU | {"address": 0x68}, c=BMX), tmp_path)
    world, _ = start(description(a=MPU | {"address": 0x68}, c=BMX | {"gyro_address": 0x69}), tmp_path)
    assert set(world.world.devices) == {"a", "c", "c.gyro", "c.magnetometer"}


def test_faults_by_name(tmp_path: Path) -> None:
    world, clock = start(description(c=BMX, card=CARD), tmp_path)
    bus = world.endpoint("i2c0")
    world.inject("nack", "c.gyro")
    with pytest.raises(I2cNack):
        bus.transfer(0x68, [I2cWrite(b"\0"), I2cRead(1)])  # type: ignore[union-attr]
    bus.transfer(0x18, [I2cWrite(b"\0"), I2cRead(1)])  # type: ignore[union-attr]
    world.inject("press", "card")
    clock.advance_to(clock.now_ns() + 600 * MS)
    world.inject("release", "card")
    assert world.world.devices["card"].status == 2


def test_burst_costs_its_bus_time(tmp_path: Path) -> None:
    """14 bytes with pointer and both addresses: 1 + 2 x 10 + 9 + 14 x 9 = 156 bits at 400 kHz."""
    world, clock = start(description(a=MPU), tmp_path)
    before_ns = clock.now_ns()
    world.endpoint("i2c0").transfer(0x69, [I2cWrite(b"\x3b"), I2cRead(14)])  # type: ignore[union-attr]
    assert clock.now_ns() - before_ns == 390_000


def test_runs_are_bit_identical_and_follow_the_truth(tmp_path: Path) -> None:
    def run() -> tuple[bytes, dict[str, Any]]:
        world, clock = start(description(card=CARD), tmp_path)
        port, data, buffer = world.endpoint("card0"), b"", bytearray(256)
        until_ns = clock.now_ns() + 500 * MS
        while clock.now_ns() < until_ns:
            data += bytes(buffer[: port.read_into(memoryview(buffer), 0.02)])  # type: ignore[union-attr]
        world.stop()
        return data, world.truth()

    one, truth = run()
    assert one == run()[0]
    lines = one.split(b"\r\n")[:-1]
    last = np.array([int(v) for v in lines[-1].split(b":")[1:7]]) / [16384, 16384, 16384, 16.4, 16.4, 16.4]
    row = len(lines)  # the first line's sample and the second row of the truth are both 10 ms after the start
    assert last[:3] == pytest.approx(truth["specific_force_m_s2"][row] / 9.80665, abs=0.05)
    assert last[3:] == pytest.approx(np.degrees(truth["rate_rad_s"][row]), abs=4.0)


def test_card_on_a_pty_in_real_time(tmp_path: Path) -> None:
    world = provider(description(card=CARD), clock=None, runtime_dir=tmp_path, hand_file=None, hand_scale=None)
    assert isinstance(world, ProcessWorld)
    try:
        with serial.Serial(world.endpoint("card0").removeprefix("serial://"), 115_200, timeout=2.0) as port:
            port.read_until(b"\r\n")  # opening flushes the line: the first one may be a rest
            lines = [port.read_until(b"\r\n") for _ in range(21)]
    finally:
        world.stop()
    assert all(line.startswith(b"#:") and line.endswith(b":0:\r\n") and line.count(b":") == 9 for line in lines)
    truth = world.truth()
    assert truth["t_ns"][-1] - truth["t_ns"][0] >= 20 * 10 * MS  # no line before its time
