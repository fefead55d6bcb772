"""Emulated devices from other packages: entry points of group ``micron.devices``, named like their drivers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hal.plugins import DEVICES, load
from sim_devices.devices.faces import VoltageSource
from sim_devices.plant.body_motion import BodyMotion


@dataclass(frozen=True)
class Surroundings:
    """Holds all that an emulated device may know of the world: the truth at bench times in ns, its entry, a seed.

    ``entry`` is the device's entry in the bench file. ``motion`` returns the motion of the body, with the temperature;
    ``analog_V`` returns all voltages at the DAQ's inputs; ``switch(bits, t_ns)`` sets the DAQ's digital outputs, which
    fire the magnetometer's strap.
    """

    name: str
    entry: Mapping[str, Any]
    seed: int
    start_ns: int
    motion: Callable[[int], BodyMotion]
    analog_V: VoltageSource
    switch: Callable[[int, int], None] = lambda bits, t_ns: None


@dataclass(frozen=True)
class AddedDevice:
    """Describes an emulated device of another package; the package's entry point names an object of this type.

    ``make(surroundings)`` returns the wire face that its bus requires (``devices.faces``); for a device on a DAQ it
    returns functions from bench time in ns to volts, by input.
    """

    make: Callable[[Surroundings], Any]


def added_device(driver: str) -> AddedDevice | None:
    """``BenchError`` when its package is broken."""
    return load(DEVICES, driver, AddedDevice)
