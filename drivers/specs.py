"""Checks each driver's entry in a bench file, and the arithmetic constraints that a bench must satisfy.

``hal.bench`` has checked references and addresses; here the drivers' own keys, channel claims, rates and the
time that each bus has per second are checked, so that an impossible bench is refused before it is opened.
"""

from __future__ import annotations

from typing import Any

from drivers.bus_use import bus_uses, overloads
from drivers.imu.bench import address_problems
from drivers.options import DaqOptions, Di4108Options
from drivers.polling import polling_of
from drivers.registry import REGISTRY, driver_names, find_driver
from hal.bench import BenchDescription
from hal.errors import BenchError
from hal.validation import validate_table


def device_options(description: BenchDescription, name: str, where: str) -> Any:
    """Return the checked options of device ``name``. Raises ``BenchError`` naming file and key."""
    spec = description.device[name]
    driver = REGISTRY.find(spec.driver)
    if driver is None:
        known = ", ".join(driver_names())
        raise BenchError(f"{where}: [device.{name}.driver] there is no driver '{spec.driver}'; drivers are {known}")
    if driver.needs and getattr(spec, driver.needs) is None:
        raise BenchError(f"{where}: [device.{name}] driver '{spec.driver}' needs '{driver.needs} = ...'")
    if driver.addresses and spec.address is not None and spec.address not in driver.addresses:
        raise BenchError(
            f"{where}: [device.{name}.address] 0x{spec.address:02X} is not one of 0x{driver.addresses[0]:02X}.."
            f"0x{driver.addresses[-1]:02X}, which the pins of '{spec.driver}' can select"
        )
    return validate_table(driver.options, spec.options(), f"{where}: device.{name}")


def check_devices(description: BenchDescription, where: str) -> dict[str, Any]:
    """Return the options of every device by name, after all checks that involve several devices. Raises ``BenchError``
    with all problems."""
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
    claimed: dict[tuple[str, int], str] = {}
    for name, spec in description.device.items():
        parent = spec.daq or spec.adc
        claims = find_driver(spec.driver).inputs(options[name])
        if parent is None:
            continue
        offered: tuple[int, ...] = getattr(options[parent], "channels", (0, 1, 2, 3))
        for channel in claims:
            if channel not in offered:
                problems.append(f"[device.{name}] channel {channel} is not scanned by '{parent}' ({list(offered)})")
            if (parent, channel) in claimed:
                problems.append(
                    f"[device.{name}] channel {channel} of '{parent}' is taken by '{claimed[parent, channel]}'"
                )
            claimed.setdefault((parent, channel), name)
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
