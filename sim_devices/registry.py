"""Emulated devices by the name of their driver.

A device is found in one of three places, in this order: ``BUILT_IN``; a folder ``sim_devices/parts/NAME`` whose module
``device`` holds ``DEVICE``; an entry point of group ``micron.devices`` of another package.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

from hal.plugins import DEVICES, Registry
from sim_devices.faces import VoltageSource
from sim_devices.plant.body_motion import BodyMotion


@dataclass(frozen=True)
class Surroundings:
    """Holds all that an emulated device may know of the world: the truth at bench times in ns, its entry, a seed.

    ``entry`` is the device's entry in the bench file. ``motion`` returns the motion of the body, with the temperature;
    ``analog_V`` returns all voltages at the DAQ's inputs; ``switch(bits, t_ns)`` sets the DAQ's digital outputs, which
    fire the magnetometer's strap; ``amplify(channel, volts, t_ns)`` sets an input of the amplifier of the stacks.
    """

    name: str
    entry: Mapping[str, Any]
    seed: int
    start_ns: int
    motion: Callable[[int], BodyMotion]
    analog_V: VoltageSource
    switch: Callable[[int, int], None] = lambda bits, t_ns: None
    amplify: Callable[[int, float, int], None] = lambda channel, volts, t_ns: None


@runtime_checkable
class HasOutputs(Protocol):
    """Describes a device with analog outputs. ``output_V`` are their voltages now; from those at power-up the amplifier
    behind them starts."""

    output_V: Sequence[float]


@dataclass(frozen=True)
class Device:
    """Describes an emulated device; its module holds it as ``DEVICE``.

    ``make(surroundings)`` returns the wire face that its bus requires (``faces``); for a device on a DAQ it
    returns functions from bench time in ns to volts, by input. A face with ``output_V`` (``HasOutputs``) drives the
    amplifier of the stacks. A part of ours that is more than one face, or that the plant reaches in more ways, has
    ``build(world, name, entry)`` instead, which puts its faces on the world's buses.
    """

    make: Callable[[Surroundings], Any] | None = None
    build: Callable[[Any, str, Mapping[str, Any]], None] | None = None


BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "di4108": "sim_devices.parts.instrument:DI4108",
        "ads1115": "sim_devices.parts.instrument:ADS1115",
        "dac_amplifier": "sim_devices.parts.instrument:DAC_AMPLIFIER",
        "e727": "sim_devices.parts.instrument:E727_CONTROLLER",
        "can_amplifier": "sim_devices.parts.instrument:CAN_AMPLIFIER",
        "can_telemetry": "sim_devices.parts.instrument:CAN_TELEMETRY",
        "mpu6050": "sim_devices.parts.inertial:MPU6050",
        "lsm6ds3": "sim_devices.parts.inertial:LSM6DS3",
        "bmx055": "sim_devices.parts.inertial:BMX055",
        "motion_card": "sim_devices.parts.inertial:MOTION_CARD",
    }
)
REGISTRY = Registry(DEVICES, Device, BUILT_IN, "sim_devices.parts:device:DEVICE")


def find_device(driver: str) -> Device | None:
    """Return the emulated device for ``driver``, or ``None``. ``BenchError`` when its package is broken."""
    return REGISTRY.find(driver)
