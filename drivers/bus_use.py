"""Computes each device's load on its bus from the transactions that its driver declares and the firmware's task rates.

An I2C bus gives ``speed_hz`` bits a second, a serial line ``baud``, a CAN bus ``bitrate`` with the worst case of stuff
bits. A bus with a load above ``MOST`` is refused: the rest carries retries, the reads of a supervisor and the gaps that
real adapters leave between bytes.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from drivers.polling import Polling
from drivers.registry import Load, find_driver
from hal.bench import BenchDescription, CanSpec, I2cSpec, SerialSpec

MOST = 0.8
"""Largest load of a bus, as a fraction of its time."""
TOP_BITRATE = 1_000_000  # CAN with classic frames


@dataclass(frozen=True)
class BusUse:
    """Describes one kind of transaction on one bus: ``bits`` on the wire, ``per_s`` times a second.

    ``task`` is the firmware's task that waits for it. It is empty for queued transfers (CAN and serial frames).
    """

    bus: str
    device: str
    what: str
    bits: float
    per_s: float
    share: float
    task: str = ""

    @property
    def bus_us(self) -> float:
        """Return the time of one transaction on the wire, us."""
        return 1e6 * self.share / self.per_s

    def __str__(self) -> str:
        return f"{self.device} {self.what} {self.per_s:g}/s x {self.bits:g} bit = {100 * self.share:.1f} %"


def bus_uses(description: BenchDescription, options: Mapping[str, Any], polling: Polling) -> list[BusUse]:
    """Return all transactions that the devices of a bench repeat, in the order of the file."""
    uses: list[BusUse] = []
    with_heartbeat: set[str] = set()
    for name, spec in description.device.items():
        bus = description.bus.get(spec.bus or "")
        if bus is None or spec.bus is None:
            continue
        speed = bits_per_s(bus)
        readers = frozenset(other.driver for other in description.device.values() if other.adc == name)
        load = Load(name, options[name], description.clock.tick_hz, polling, readers)
        for what, bits, per_s, task in find_driver(spec.driver).repeated(load):
            if per_s <= 0.0 or bits <= 0:
                continue
            if what == "HOST_HEARTBEAT":  # a bus has one, and any of its drivers may send it
                if spec.bus in with_heartbeat:
                    continue
                with_heartbeat.add(spec.bus)
            uses.append(BusUse(spec.bus, name, what, bits, per_s, bits * per_s / speed, task))
    return uses


def bits_per_s(bus: SerialSpec | I2cSpec | CanSpec) -> int:
    """Return the capacity of the bus in bit/s."""
    match bus:
        case I2cSpec():
            return bus.speed_hz
        case SerialSpec():
            return bus.baud
        case CanSpec():
            return bus.bitrate


def bus_shares(uses: Iterable[BusUse]) -> dict[str, float]:
    """Return the load of each bus, as a fraction of its time."""
    shares: dict[str, float] = defaultdict(float)
    for use in uses:
        shares[use.bus] += use.share
    return dict(shares)


def overloads(description: BenchDescription, uses: list[BusUse]) -> list[str]:
    """Return a message for each bus that is set faster than its devices allow or loaded above ``MOST``."""
    problems: list[str] = []
    for name, bus in description.bus.items():
        slowest = _slowest(description, name)
        if isinstance(bus, I2cSpec) and slowest is not None and bus.speed_hz > slowest[0]:
            problems.append(
                f"[bus.{name}.speed_hz] {bus.speed_hz} Hz is more than '{slowest[1]}' allows; set at most {slowest[0]}"
            )
    for name, share in bus_shares(uses).items():
        if share > MOST:
            here = sorted((use for use in uses if use.bus == name), key=lambda use: -use.share)
            biggest = "; ".join(str(use) for use in here[:3]) + ("; ..." if len(here) > 3 else "")
            problems.append(
                f"[bus.{name}] is asked for {100 * share:.0f} % of its time, and at most {100 * MOST:.0f} % can be "
                f"relied on ({biggest}): {', or '.join(_remedies(description, name, here))}"
            )
    return problems


def _remedies(description: BenchDescription, name: str, here: list[BusUse]) -> Iterator[str]:
    """Yield changes that bring the load of bus ``name`` below ``MOST`` or reduce it.

    ``here`` holds the uses of the bus, the largest first."""
    bus = description.bus[name]
    share = sum(use.share for use in here)
    match bus:
        case I2cSpec():
            key, top = "speed_hz", (_slowest(description, name) or (3_400_000, ""))[0]
        case SerialSpec():
            key, top = "baud", 4_000_000
        case CanSpec():
            key, top = "bitrate", TOP_BITRATE
    if (needed := math.ceil(bits_per_s(bus) * share / MOST)) <= top:
        yield f"set {key} to {needed} or more (at most {top})"
    of_device: dict[str, float] = defaultdict(float)
    for use in here:
        of_device[use.device] += use.share
    first = here[0]
    if "read-back" in first.what:
        yield f"leave out read_back of '{first.device}'"
    elif first.what == "command" and first.per_s >= description.clock.tick_hz:
        yield "lower [clock] tick_hz"
    else:
        yield f"lower rate_hz of '{first.device}'"
    enough = [device for device, part in of_device.items() if share - part <= MOST]
    if enough and len(of_device) > 1:
        yield f"put '{min(enough, key=of_device.__getitem__)}' on a bus of its own"


def _slowest(description: BenchDescription, bus: str) -> tuple[int, str] | None:
    """Return the fastest clock (Hz) that all devices of an I2C bus allow, and the device that limits it."""
    members = [(d.driver, name) for name, d in description.device.items() if d.bus == bus]
    limits = [(find_driver(driver).max_bus_hz, name) for driver, name in members]
    return min(((hz, name) for hz, name in limits if hz is not None), default=None)
