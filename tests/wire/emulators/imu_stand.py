"""A body in a test's hand: what it feels is set by attribute; ideal specimens unless asked otherwise."""

from __future__ import annotations

import numpy as np

from sim_devices.devices.register_map import RegisterFace
from sim_devices.plant.body_motion import BodyMotion
from sim_devices.plant.imu import Imu, ImuSpec
from sim_devices.plant.sensors import STANDARD_GRAVITY


class Stand:
    """Motion source: ``g``, ``dps``, ``field_uT`` (3,), ``temperature_C``; ``ramp_g`` (3,) adds g per second."""

    def __init__(self) -> None:
        self.g = np.array([0.0, 0.0, 1.0])
        self.dps = np.zeros(3)
        self.field_uT = np.array([20.0, 0.0, -44.0])
        self.temperature_C = 25.0
        self.ramp_g = np.zeros(3)

    def __call__(self, t_ns: int) -> BodyMotion:
        force = (self.g + self.ramp_g * t_ns * 1e-9) * STANDARD_GRAVITY
        rate = np.radians(self.dps)
        return BodyMotion(np.eye(3), rate, force, field_world_uT=self.field_uT, temperature_C=self.temperature_C)

    def imu(self, spec: ImuSpec, errors: float = 0.0, noise: float = 0.0) -> Imu:
        return Imu(spec, self, errors=errors, noise=noise)


def get(device: RegisterFace, register: int, t_ns: int, n: int = 1) -> bytes:
    """Pointer write and read, both at one instant, outside any transport."""
    assert device.write(bytes((register,)), t_ns) == 1
    return device.read(n, t_ns)


def put(device: RegisterFace, register: int, *values: int, t_ns: int) -> None:
    assert device.write(bytes((register, *values)), t_ns) == 1 + len(values)


def words(data: bytes, order: str = "big") -> list[int]:
    return [int.from_bytes(data[i : i + 2], order, signed=True) for i in range(0, len(data), 2)]  # type: ignore[arg-type]
