"""Injects faults into any bench, also a real one (``micron run --inject``), within a limit on how much they disturb it.

The scale is that of the hardware tests: 0 reads, 1 configures, 2 small output, 3 full range, 4 motion. On a real bus
nothing is injected without a limit that somebody has named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, cast

from drivers.registry import BUILT_IN, find_driver
from hal.bench import SIM_SCHEME, BenchDescription, BenchFile, Port
from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import BenchError
from hal.middleware.faults import FaultCan, FaultI2c, FaultPlan, FaultSerial

SENSING, MOTION = 1, 4
PROBABILITIES = (
    "loss", "corruption", "write_corruption", "duplication", "reorder", "truncation", "delay", "nack",
)  # fmt: skip
KEYS = tuple(f.name for f in fields(FaultPlan))
FOR_EVER = ("for_s", "silent_for_s", "reconnect_after_s")
"""Keys whose times may be inf."""
STARTS = ("from_s", "silent_after_s", "disconnect_after_s", "bus_off_after_s", "full_after_s")
"""Keys that say when a fault begins, in s after the bench was opened."""
FAULTS = (*PROBABILITIES, *STARTS[1:], "babble_hz", "error_frames_hz")
"""Keys that say what happens; the others say when, how long and how."""
ONLY_ON = {
    "nack": ("i2c",),
    "write_corruption": ("i2c",),
    "reorder": ("serial", "can"),
    "truncation": ("serial", "can"),
    "bus_off_after_s": ("can",),
    "babble_hz": ("can",),
    "error_frames_hz": ("can",),
}
"""Kinds of bus on which a key has an effect. Keys that are not listed have one on every kind."""
FORM = "write --inject BUS:KEY=VALUE[,KEY=VALUE], or BUS@0x0C:KEY=VALUE for one I2C device"

Wrap = Callable[[str, Port, Clock], Port]


@dataclass(frozen=True)
class Injection:
    """Applies ``plan`` to the port of ``bus``; ``only``: one I2C address. The plan's times count from opening the
    bench."""

    bus: str
    plan: FaultPlan
    only: int | None = None


def parse_injection(text: str) -> Injection:
    """``daq0:loss=0.001,from_s=2`` or ``i2c0@0x0C:nack=0.1``. ``BenchError`` says what is not understood."""
    where, colon, plan = text.partition(":")
    bus, at, address = where.partition("@")
    if not (bus and colon and plan):
        raise BenchError(f"--inject {text!r} is not understood; {FORM}")
    values: dict[str, Any] = {}
    for item in plan.split(","):
        key, equals, value = (part.strip() for part in item.partition("="))
        if key not in KEYS or not equals:
            raise BenchError(f"--inject {text!r}: {item!r} is not KEY=VALUE with one of {', '.join(KEYS)}")
        number = _number(text, key, value)
        if not (number >= 0.0 and (key not in PROBABILITIES or number <= 1.0)):
            raise BenchError(f"--inject {text!r}: {key} must be {'0 to 1' if key in PROBABILITIES else '0 or more'}")
        if math.isinf(number) and key not in FOR_EVER:
            raise BenchError(f"--inject {text!r}: {key} must be a finite number")
        values[key] = int(number) if key == "seed" else number
    if not set(values) & set(FAULTS):
        raise BenchError(f"--inject {text!r} names no fault; add one of {', '.join(FAULTS)}")
    return Injection(bus, FaultPlan(**values), _address(text, address) if at else None)


def _address(text: str, address: str) -> int:
    try:
        return int(address, 0)
    except ValueError:
        raise BenchError(f"--inject {text!r}: {address!r} is not an I2C address such as 0x0C") from None


def _number(text: str, key: str, value: str) -> float:
    try:
        return float(int(value, 16)) if value.lower().startswith("0x") else float(value)
    except ValueError:
        raise BenchError(f"--inject {text!r}: {key} = {value!r} is not a number") from None


def _only_senses(driver: str) -> bool:
    """Return True for a driver of ours that moves nothing; any other driver may move something."""
    return driver in BUILT_IN and find_driver(driver).role != "output"


def effect_of(description: BenchDescription, injection: Injection) -> int:
    """Return how much the fault may disturb: motion where outputs may be commanded over the bus, else sensing only."""
    moves = any(
        not _only_senses(device.driver)
        and device.bus == injection.bus
        and injection.only in (None, device.address if device.address is not None else injection.only)
        for device in description.device.values()
    )
    return MOTION if moves else SENSING


def check_injections(bench: BenchFile, injections: Sequence[Injection], max_effect: int | None) -> None:
    """Raise ``BenchError`` for a fault that would do nothing (no such bus, device, or key on such a bus; a second plan
    for a bus), and for a real bus that may not be disturbed so much."""
    description = bench.description
    for k, injection in enumerate(injections):
        spec = description.bus.get(injection.bus)
        if spec is None:
            known = ", ".join(description.bus)
            raise BenchError(f"{bench.path}: --inject: there is no bus '{injection.bus}'; buses are {known}")
        if any(other.bus == injection.bus for other in injections[:k]):
            raise BenchError(f"--inject: two plans for bus '{injection.bus}'; put all keys into one, divided by commas")
        _check_kind(description, injection, spec.kind)
        effect = effect_of(description, injection)
        if spec.uri.startswith(SIM_SCHEME) or (max_effect is not None and effect <= max_effect):
            continue
        given = "no --max-effect was given" if max_effect is None else f"--max-effect is {max_effect}"
        raise BenchError(
            f"{bench.path}: bus '{injection.bus}' is real ({spec.uri}) and a fault on it has effect {effect} "
            f"({'motion' if effect == MOTION else 'reads and configures'}), but {given}: take the tip away from "
            f"everything and give --max-effect {effect}, or use an emulated bench"
        )


def late_starts(injections: Sequence[Injection], seconds: float) -> list[str]:
    """Return a sentence for each fault that begins later than a run of ``seconds`` usually ends.

    It is no error: a run's seconds count from the end of the self-test, which takes longer on some benches.
    """
    return [
        f"--inject {injection.bus}: {key} = {start_s:g} s counts from opening the bench, and a run of {seconds:g} s "
        "after the self-test may end before that; give a smaller one, or more --seconds"
        for injection in injections
        for key in STARTS
        if (start_s := getattr(injection.plan, key)) is not None and start_s > seconds
    ]


def _check_kind(description: BenchDescription, injection: Injection, kind: str) -> None:
    for key, kinds in ONLY_ON.items():
        if getattr(injection.plan, key) != getattr(FaultPlan(), key) and kind not in kinds:
            raise BenchError(
                f"--inject: {key} does nothing on bus '{injection.bus}', which is {kind}; "
                f"it is for {' and '.join(kinds)}"
            )
    if injection.only is None:
        return
    addresses = sorted(
        {d.address for d in description.device.values() if d.bus == injection.bus and d.address is not None}
    )
    if injection.only not in addresses:
        known = ", ".join(f"0x{address:02X}" for address in addresses) or "none, it is no I2C bus"
        raise BenchError(
            f"--inject: there is no device 0x{injection.only:02X} on bus '{injection.bus}'; addresses are {known}"
        )


class Injector:
    """Puts the middleware around the ports as they are opened; ``counts`` by bus says what was really done."""

    def __init__(self, injections: Sequence[Injection], inner: Wrap | None = None) -> None:
        self._injections = {injection.bus: injection for injection in injections}
        self._inner = inner
        self._ports: dict[str, FaultSerial | FaultI2c | FaultCan] = {}

    def wrap(self, bus: str, port: Port, clock: Clock) -> Port:
        if self._inner is not None:
            port = self._inner(bus, port, clock)
        injection = self._injections.get(bus)
        if injection is None:
            return port
        made: FaultSerial | FaultI2c | FaultCan
        if hasattr(port, "transfer"):
            made = FaultI2c(cast(I2cBus, port), clock, injection.plan, only=injection.only)
        elif hasattr(port, "recv"):
            made = FaultCan(cast(CanBus, port), clock, injection.plan)
        else:
            made = FaultSerial(cast(SerialPort, port), clock, injection.plan)
        self._ports[bus] = made
        return made

    def counts(self) -> Mapping[str, dict[str, Any]]:
        return {bus: asdict(port.counts) for bus, port in self._ports.items()}
