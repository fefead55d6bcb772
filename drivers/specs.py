"""Check each driver's entry in a bench file, and the arithmetic constraints that a bench must satisfy.

``hal.bench`` has checked references and addresses; here the drivers' own keys, channel claims, rates and the
time that each bus has per second are checked, so that an impossible bench is refused before it is opened.
"""

from __future__ import annotations

from typing import Any

from drivers.added import added_driver, added_names
from drivers.bus_use import bus_uses, overloads
from drivers.imu.bench import IMU_OPTIONS, address_problems
from drivers.options import (
    Ads1115Options,
    Adxl203Options,
    AmplifierMonitorOptions,
    AnalogOptions,
    BleMotionCardOptions,
    CanAmplifierOptions,
    CanTelemetryOptions,
    DacAmplifierOptions,
    DaqOptions,
    Di4108Options,
    E727Options,
    Hmc2003Options,
    MotionCardOptions,
    NiDaqOptions,
    NiOutputOptions,
    Options,
)
from drivers.polling import polling_of
from hal.bench import BenchDescription
from hal.errors import BenchError
from hal.validation import validate_table

OPTIONS: dict[str, type[Options]] = {
    "di4108": Di4108Options,
    "nidaqmx": NiDaqOptions,
    "adxl203": Adxl203Options,
    "analog": AnalogOptions,
    "ads1115": Ads1115Options,
    "hmc2003": Hmc2003Options,
    "amplifier_monitor": AmplifierMonitorOptions,
    "dac_amplifier": DacAmplifierOptions,
    "e727": E727Options,
    "nidaqmx_ao": NiOutputOptions,
    "can_amplifier": CanAmplifierOptions,
    "can_telemetry": CanTelemetryOptions,
    **IMU_OPTIONS,
    "motion_card": MotionCardOptions,
    "ble_motion_card": BleMotionCardOptions,
}
"""Our drivers by the name used in a bench file; those of other packages come beside (``drivers.added``)."""

NEEDS = {
    "di4108": "bus",
    "adxl203": "daq",
    "analog": "daq",
    "ads1115": "bus",
    "hmc2003": "adc",
    "amplifier_monitor": "adc",
    "dac_amplifier": "bus",
    "e727": "bus",
    "can_amplifier": "bus",
    "can_telemetry": "bus",
    "mpu6050": "bus",
    "lsm6ds3": "bus",
    "bmx055": "bus",
    "motion_card": "bus",
}


ADDRESSES = {"dac_amplifier": range(0x0C, 0x10), "ads1115": range(0x48, 0x4C)}
"""I2C addresses that the pins of a part can select."""


def device_options(description: BenchDescription, name: str, where: str) -> Any:
    """The checked options of device ``name``. Raises ``BenchError`` naming file and key."""
    spec = description.device[name]
    added = None if spec.driver in OPTIONS else added_driver(spec.driver)
    if spec.driver not in OPTIONS and added is None:
        known = ", ".join((*OPTIONS, *added_names()))
        raise BenchError(f"{where}: [device.{name}.driver] there is no driver '{spec.driver}'; drivers are {known}")
    needed = NEEDS.get(spec.driver) if added is None else added.needs
    if needed and getattr(spec, needed) is None:
        raise BenchError(f"{where}: [device.{name}] driver '{spec.driver}' needs '{needed} = ...'")
    addresses = ADDRESSES.get(spec.driver)
    if addresses is not None and spec.address is not None and spec.address not in addresses:
        raise BenchError(
            f"{where}: [device.{name}.address] 0x{spec.address:02X} is not one of 0x{addresses[0]:02X}.."
            f"0x{addresses[-1]:02X}, which the pins of '{spec.driver}' can select"
        )
    return validate_table(
        OPTIONS[spec.driver] if added is None else added.options, spec.options(), f"{where}: device.{name}"
    )


def check_devices(description: BenchDescription, where: str) -> dict[str, Any]:
    """Options of every device by name, after all checks that need more than one of them."""
    options = {name: device_options(description, name, where) for name in description.device}
    problems = [
        *_channel_claims(description, options),
        *address_problems(description, options),
        *_rates(description, options),
    ]
    polling, unkept = polling_of(description, options)
    problems += unkept or overloads(description, bus_uses(description, options, polling))
    if problems:
        raise BenchError("\n".join(f"{where}: {p}" for p in problems))
    return options


def _channel_claims(description: BenchDescription, options: dict[str, Any]) -> list[str]:
    problems: list[str] = []
    taken: dict[tuple[str, int], str] = {}
    for name, spec in description.device.items():
        claims: tuple[int, ...]
        parent = spec.daq or spec.adc
        match options[name]:
            case Adxl203Options(channels=channels):
                claims = tuple(channels.values())
            case AnalogOptions(channel=channel):
                claims = (channel,)
            case Hmc2003Options(channels=adc_channels) | AmplifierMonitorOptions(channels=adc_channels):
                claims = adc_channels
            case _:
                added = None if spec.driver in OPTIONS else added_driver(spec.driver)
                claims = () if added is None else added.inputs(options[name])
        if parent is None:
            continue
        offered: tuple[int, ...] = getattr(options[parent], "channels", (0, 1, 2, 3))
        for channel in claims:
            if channel not in offered:
                problems.append(f"[device.{name}] channel {channel} is not scanned by '{parent}' ({list(offered)})")
            if (parent, channel) in taken:
                problems.append(
                    f"[device.{name}] channel {channel} of '{parent}' is taken by '{taken[parent, channel]}'"
                )
            taken.setdefault((parent, channel), name)
    return problems


def _rates(description: BenchDescription, options: dict[str, Any]) -> list[str]:
    problems: list[str] = []
    tick_hz = description.clock.tick_hz
    for name, option in options.items():
        if isinstance(option, DaqOptions) and option.rate_hz != tick_hz:
            problems.append(
                f"[device.{name}.rate_hz] {option.rate_hz:g} Hz, but the scans drive the tick of {tick_hz} Hz; "
                "make them equal"
            )
        if isinstance(option, Di4108Options) and (60_000_000 / option.rate_hz) % 1:
            problems.append(f"[device.{name}.rate_hz] {option.rate_hz:g} Hz is no whole divisor of the 60 MHz clock")
    return problems
