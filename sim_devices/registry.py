"""Emulated devices by the name of their driver.

Beside those that ``sim_devices.world`` makes itself, a device is a folder ``sim_devices/parts/NAME`` whose module
``device`` holds ``DEVICE``, or an entry point of group ``micron.devices`` of another package.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from hal.plugins import DEVICES, Registry
from sim_devices.devices.faces import VoltageSource
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

    ``make(surroundings)`` returns the wire face that its bus requires (``devices.faces``); for a device on a DAQ it
    returns functions from bench time in ns to volts, by input. A face with ``output_V`` (``HasOutputs``) drives the
    amplifier of the stacks.
    """

    make: Callable[[Surroundings], Any]


REGISTRY = Registry(DEVICES, Device, {}, "sim_devices.parts:device:DEVICE")


def find_device(driver: str) -> Device | None:
    """Return the emulated device for ``driver``, or ``None``. ``BenchError`` when its package is broken."""
    return REGISTRY.find(driver)
