"""Faults that a test can inject into a running world, by name of a device or bus of the bench file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sim_devices.devices.ad5696r import Ad5696r
from sim_devices.devices.can_stop_button import CanStopButton
from sim_devices.devices.di4108 import Di4108
from sim_devices.devices.motion_card import MotionCard
from sim_devices.wiring_faults import ACTUATOR_FAULTS, SENSOR_FAULTS
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
    "brown_out: an I2C DAC restarts with its power-up outputs",
    "clock=PPM: the DAQ's crystal runs fast by so much from now on",
    "clock_step=US: the DAQ's scans come so many microseconds later, once",
    "model=NUMBER: the DAQ says that it is another model",
    "always_ready: an I2C converter says that it has finished when it has not",
    "sensor_KIND[=AMOUNT] / sensor_ok: at DAQ input NUMBER; kinds: " + ", ".join(SENSOR_FAULTS),
    "actuator_KIND[=AMOUNT] / actuator_ok: at amplifier channel NUMBER; kinds: " + ", ".join(ACTUATOR_FAULTS),
    "supply=FACTOR: the supply of the sensors sags (1 ends it)",
)


class UnknownFault(ValueError):
    """There is no such fault, or it does not apply to the target."""


def inject(
    world: World,
    fault: str,
    target: str,
    unplug: Mapping[str, Callable[[], None]],
    bus_of: Mapping[str, str],
    t_ns: int,
) -> None:
    """Do ``fault`` to ``target`` at ``t_ns``. ``unplug`` hangs up per bus, ``bus_of`` has the bus of a device."""
    if _between_plant_and_devices(world, fault, target, t_ns):
        return
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
        "always_ready": ("always_ready", True),
    }
    if fault == "ack":
        where.nack_address = where.nack_data = False
    elif fault == "overflow" and isinstance(where, Di4108):
        where.force_overflow()
    elif fault == "brown_out" and isinstance(where, Ad5696r):
        where.brown_out(t_ns)
    elif fault.startswith("clock=") and isinstance(where, Di4108):
        where.set_clock_error_ppb(round(_number(fault, fault[6:]) * 1000), t_ns)
    elif fault.startswith("clock_step=") and isinstance(where, Di4108):
        where.step_clock(round(_number(fault, fault[11:]) * 1000), t_ns)
    elif fault.startswith("model=") and isinstance(where, Di4108):
        where.model = fault[6:]
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


def _between_plant_and_devices(world: World, fault: str, target: str, t_ns: int) -> bool:
    """Faults of sensors, amplifier channels and supply; False when ``fault`` is none of them."""
    name, _, text = fault.partition("=")
    group, _, kind = name.partition("_")
    amount = _number(fault, text) if text else None
    if name == "supply" and amount is not None:
        world.plant.advance_to(t_ns - world.epoch_ns)
        world.plant.sag_supply(amount)
    elif group == "sensor" and kind in {*SENSOR_FAULTS, "ok"}:
        channel = _channel(fault, target, 8)
        if kind == "swap":
            partner = (channel + 1) % 8
            world.faults.sensor(channel, kind, float(partner - channel), t_ns)
            world.faults.sensor(partner, kind, float(channel - partner), t_ns)
        else:
            world.faults.sensor(channel, kind, amount, t_ns)
    elif group == "actuator" and kind in {*ACTUATOR_FAULTS, "ok"}:
        world.break_actuator(_channel(fault, target, 3), kind, amount, t_ns)
    else:
        return False
    return True


def _number(fault: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UnknownFault(f"'{fault}': '{text}' is not a number") from None


def _channel(fault: str, target: str, count: int) -> int:
    if not (target.isascii() and target.isdigit() and int(target) < count):
        raise UnknownFault(f"'{fault}' needs a channel 0..{count - 1}, not '{target}'")
    return int(target)
