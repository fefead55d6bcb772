"""Connects emulated inertial sensors and the motion card to the world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sim_devices.devices.bmx055 import Bmx055Accelerometer, Bmx055Gyroscope
from sim_devices.devices.bmx055_magnetometer import Bmx055Magnetometer
from sim_devices.devices.lsm6ds3 import Lsm6ds3
from sim_devices.devices.motion_card import MotionCard
from sim_devices.devices.mpu6050 import Mpu6050
from sim_devices.plant.imu import BMX055_SPEC, LSM6DS3_SPEC, MPU6050_SPEC, Imu, ImuSpec
from sim_devices.registry import Device

if TYPE_CHECKING:
    from sim_devices.world import World


def _imu(world: World, name: str, spec: ImuSpec) -> Imu:
    specimen = world.specimen(name)
    return Imu(spec, world.stimuli.motion(name, world.motion, specimen["mount"]), **specimen)


def _build_mpu6050(world: World, name: str, device: Mapping[str, Any]) -> None:
    world.add_chip(name, device, Mpu6050(_imu(world, name, MPU6050_SPEC)))


def _build_lsm6ds3(world: World, name: str, device: Mapping[str, Any]) -> None:
    world.add_chip(name, device, Lsm6ds3(_imu(world, name, LSM6DS3_SPEC)))


def _build_bmx055(world: World, name: str, device: Mapping[str, Any]) -> None:
    """Add three dies; ``NAME.gyro`` and ``NAME.magnetometer`` are the further two, for fault injection."""
    imu = _imu(world, name, BMX055_SPEC)
    world.add_chip(name, device, Bmx055Accelerometer(imu, start_ns=world.epoch_ns))
    gyro = {"bus": device["bus"], "address": device.get("gyro_address", 0x68)}
    world.add_chip(f"{name}.gyro", gyro, Bmx055Gyroscope(imu, start_ns=world.epoch_ns))
    magnetometer = {"bus": device["bus"], "address": device.get("mag_address", 0x10)}
    world.add_chip(f"{name}.magnetometer", magnetometer, Bmx055Magnetometer(imu, seed=world.seed))


def _build_motion_card(world: World, name: str, device: Mapping[str, Any]) -> None:
    specimen = world.specimen(name)
    card = MotionCard(
        world.stimuli.motion(name, world.motion, specimen["mount"]),
        baud=world.baud[device["bus"]],
        rate_hz=float(device.get("rate_hz", 100.0)),
        scaled=device.get("fields") == "scaled",
        start_ns=world.epoch_ns,
        presses=world.presses,
        **specimen,
    )
    world.add_serial(name, device, card)


MPU6050 = Device(build=_build_mpu6050)
LSM6DS3 = Device(build=_build_lsm6ds3)
BMX055 = Device(build=_build_bmx055)
MOTION_CARD = Device(build=_build_motion_card)
