"""Computes how often the instrument's tasks use their devices, in whole ticks, from the rates of the bench file.

The firmware's task table and the load of the buses are both derived from this, so that they cannot differ.
A rate that the ticks do not give is refused with the nearest rates that they do give.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from drivers.adc.ads1115 import RATE_TOLERANCE, SAMPLES_PER_S, WAKE_UP_NS, WIRE_BITS
from drivers.options import (
    Ads1115Options,
    AmplifierMonitorOptions,
    CanTelemetryOptions,
    E727Options,
    Hmc2003Options,
)
from drivers.polls import Polling, Polls
from drivers.registry import find_driver
from hal.bench import BenchDescription, I2cSpec

LONGEST_FRAME = 1000
"""Largest number of ticks between two polls of a device."""
MOST_IN_FRAME = 4
AXES = 3


SUPERVISE = Polls(10)
TELEMETRY = Polls(20)
VERIFY = Polls(10, 3)
VERIFY_BESIDE_MONITOR = Polls(10)
MONITOR = Polls(5, 2)
"""Default of an amplifier monitor: a fault must be seen soon, whatever rate other converters have."""
SLOWER_MONITORS = (Polls(4), Polls(5), Polls(10), Polls(20))
"""Defaults where a conversion takes longer than two ticks; they repeat with the other tasks."""


def polling_of(description: BenchDescription, options: Mapping[str, Any]) -> tuple[Polling, list[str]]:
    """Return the polls of the bench's devices, and a message for each rate that the ticks do not allow."""
    tick_hz = description.clock.tick_hz
    problems: list[str] = []
    magnetometer = monitor = None
    for name, spec in description.device.items():
        option, adc = options[name], spec.adc or ""
        if not isinstance(option, Hmc2003Options | AmplifierMonitorOptions) or not isinstance(
            options.get(adc), Ads1115Options
        ):
            continue
        gap = _ticks_of_conversion(description, adc)
        asked = options[adc].rate_hz
        if isinstance(option, Hmc2003Options):
            asked = 100.0 if asked is None else asked
            magnetometer = _polls(asked, AXES, tick_hz, gap)
            if magnetometer is None:
                problems.append(_refusal(adc, asked, AXES, tick_hz, gap, f"each of the {AXES} inputs is read so often"))
        else:
            if asked is not None:
                problems.append(
                    f"[device.{adc}.rate_hz] this converter is read by '{name}': remove this key and write "
                    f"rate_hz = ... (readings per second, of one output each) under [device.{name}]"
                )
            if option.rate_hz is None:
                monitor = next((p for p in (MONITOR, *SLOWER_MONITORS) if p.shortest_gap >= gap), None)
            else:
                monitor = _polls(option.rate_hz, 1, tick_hz, gap)
            if monitor is None:
                asked = MONITOR.per_s(tick_hz) if option.rate_hz is None else option.rate_hz
                problems.append(_refusal(name, asked, 1, tick_hz, gap, "one output is read each time"))
    for name, option in options.items():
        if isinstance(option, E727Options) and _polls(option.rate_hz, 1, tick_hz, 1, most=1) is None:
            problems.append(_refusal(name, option.rate_hz, 1, tick_hz, 1, "a command goes out so often", most=1))
    verify = None
    if any(find_driver(spec.driver).verifies for spec in description.device.values()):
        verify = VERIFY if monitor is None else VERIFY_BESIDE_MONITOR
    telemetry = TELEMETRY if any(isinstance(option, CanTelemetryOptions) for option in options.values()) else None
    return Polling(magnetometer, monitor, verify, telemetry), problems


def poll_divider(rate_hz: float, tick_hz: int) -> int:
    """Return the ticks between two polls of a sensor that samples by its own clock, so that no sample is missed."""
    return max(1, int(tick_hz / rate_hz))


def _ticks_of_conversion(description: BenchDescription, adc: str) -> int:
    """Return the ticks from one poll of a converter to the next one that certainly finds its conversion done."""
    bus = description.bus.get(description.device[adc].bus or "")
    transfer_s = WIRE_BITS["reading"] / bus.speed_hz if isinstance(bus, I2cSpec) else 0.0
    conversion_s = WAKE_UP_NS * 1e-9 + (1.0 + RATE_TOLERANCE) / SAMPLES_PER_S
    return math.ceil((conversion_s + transfer_s) * description.clock.tick_hz)


def _polls(rate_hz: float, each: int, tick_hz: int, gap: int, most: int = MOST_IN_FRAME) -> Polls | None:
    """Return ``each * rate_hz`` polls per second in the shortest frame, at least ``gap`` ticks apart, or ``None`` if
    that is impossible."""
    for count in range(1, most + 1):
        divider = tick_hz * count / (each * rate_hz)
        if not divider <= LONGEST_FRAME + 1:  # infinite, for a rate of next to nothing
            continue
        whole = round(divider)
        if abs(divider - whole) > 1e-9 * divider or not 1 <= whole <= LONGEST_FRAME:
            continue
        polls = Polls(whole, count)
        return polls if polls.shortest_gap >= gap else None
    return None


def _rates(each: int, tick_hz: int, gap: int, most: int) -> Iterator[float]:
    """Yield the rates (Hz) that are possible, in six digits as a bench file states them."""
    for divider in range(1, LONGEST_FRAME + 1):
        for count in range(1, most + 1):
            rate_hz = float(f"{tick_hz * count / divider / each:g}")
            if _polls(rate_hz, each, tick_hz, gap, most) is not None:
                yield rate_hz


def _refusal(
    name: str, rate_hz: float, each: int, tick_hz: int, gap: int, what: str, *, most: int = MOST_IN_FRAME
) -> str:
    rates = set(_rates(each, tick_hz, gap, most))
    below = max((rate for rate in rates if rate < rate_hz), default=None)
    above = min((rate for rate in rates if rate > rate_hz), default=None)
    nearest = " and ".join(f"{rate:g} Hz" for rate in (below, above) if rate is not None)
    too_fast = _polls(rate_hz, each, tick_hz, 1, most) is not None
    why = "is faster than its conversions on this bus" if too_fast else f"does not divide the tick of {tick_hz} Hz"
    return f"[device.{name}.rate_hz] {rate_hz:g} Hz {why} ({what}); the nearest that work: {nearest or 'none'}"
