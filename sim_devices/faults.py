"""Faults that a test can inject into a running world, by name of a device or bus of the bench file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sim_devices.devices.can_stop_button import CanStopButton
from sim_devices.devices.di4108 import Di4108
from sim_devices.devices.motion_card import MotionCard
from sim_devices.world import World

FAULTS = (
    "unplug: hang up the serial port of a device, or the whole bus named",
    "freeze / thaw: a device stops answering and acting / goes on",
    "nack / nack_data / ack: an I2C device refuses its address / its data / behaves again",
    "stuck / free: SDA of an I2C bus is held low / released",
    "silence / speak: a CAN node or CAN bus goes silent / comes back",
    "overflow: the DAQ's FIFO overflows now",
    "spike: a pulse of 0.5 V for 2 ms on a DAQ input; the target is its number, 0 to 7",
    "press / release: the stop button, or the button of the motion card named",
)


class UnknownFault(ValueError):
    """There is no such fault, or it does not apply to the target."""


def inject(
    world: World, fault: str, target: str, unplug: Mapping[str, Callable[[], None]], bus_of: Mapping[str, str]
) -> None:
    """Do ``fault`` to ``target``. ``unplug`` has the transport's hang-up per bus, ``bus_of`` the bus of a device."""
    if fault == "unplug":
        bus = bus_of.get(target, target)
        if bus not in unplug:
            raise UnknownFault(f"'{target}' has no port to unplug; ports are {', '.join(unplug)}")
        unplug[bus]()
        return
    if fault in ("press", "release"):
        named = world.devices.get(target)
        for device in (named,) if isinstance(named, MotionCard) else world.devices.values():
            if isinstance(device, CanStopButton | MotionCard):
                device.press() if fault == "press" else device.release()
                return
        raise UnknownFault("there is no button on this bench; add a can_telemetry device or a motion card")
    if fault == "spike":
        if target not in tuple("01234567"):
            raise UnknownFault(f"'{target}' is not a DAQ input; inputs are 0 to 7")
        world.spike(int(target))
        return
    where = _target(world, target)
    flags = {
        "freeze": ("frozen", True),
        "thaw": ("frozen", False),
        "nack": ("nack_address", True),
        "nack_data": ("nack_data", True),
        "stuck": ("stuck", True),
        "free": ("stuck", False),
        "silence": ("silent", True),
        "speak": ("silent", False),
    }
    if fault == "ack":
        where.nack_address = where.nack_data = False
    elif fault == "overflow" and isinstance(where, Di4108):
        where.force_overflow()
    elif fault in flags and hasattr(where, flags[fault][0]):
        setattr(where, *flags[fault])
    else:
        known = "\n  ".join(FAULTS)
        raise UnknownFault(f"cannot do '{fault}' to '{target}'; faults are\n  {known}")


def _target(world: World, name: str) -> Any:
    for table in (world.devices, world.buses.i2c, world.buses.can):
        if name in table:
            return table[name]
    raise UnknownFault(f"nothing is named '{name}'; devices are {', '.join(world.devices)}")
