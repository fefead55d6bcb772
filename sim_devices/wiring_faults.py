"""Injects faults between the plant and its devices: sensors, their wires and supply, amplifier channels.

Volts pass through here on their way to the DAQ, demands on their way to the amplifier. While no fault is injected,
they pass unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sim_devices.faces import Volts

SUPPLY_V = 5.0
MIDDLE_V = 2.5
SATURATED_V = 4.2  # 1.7 g above the middle at 1 V/g
SENSOR_FAULTS = {
    "stuck": "holds its voltage",
    "open": "0 V (broken wire with a pull-down)",
    "short": "supply voltage",
    "saturate": "at the end of its range",
    "drift": "offset grows, V/s (default 0.05)",
    "spike": "one conversion off by so many V (default 0.5)",
    "noise": "additional noise, V rms (default 0.05)",
    "gain": "deviation from 2.5 V times (default 0.5)",
    "sign": "deviation from 2.5 V turned round",
    "swap": "exchanged with the next input",
}
ACTUATOR_FAULTS = {
    "open": "the stack sees 0 V",
    "rail": "the stack sees 100 V",
    "stuck": "demands do not arrive any more",
    "slow": "follows a demand by so much per update (default 0.02)",
    "weak": "deviation from 50 V times (default 0.5)",
}
_DEFAULT = {"drift": 0.05, "spike": 0.5, "noise": 0.05, "gain": 0.5, "slow": 0.02, "weak": 0.5}


@dataclass
class _Active:
    kind: str
    amount: float
    since_ns: int
    held_V: float
    done: bool = False


@dataclass
class WiringFaults:
    """Holds the active faults by input of the DAQ and by channel of the amplifier."""

    seed: int = 1
    _sensors: dict[int, _Active] = field(default_factory=dict[int, _Active])
    _actuators: dict[int, _Active] = field(default_factory=dict[int, _Active])
    _last_V: Volts = field(default_factory=lambda: np.zeros(8))
    _demand_V: list[float] = field(default_factory=lambda: [50.0, 50.0, 50.0])
    on_demand: Callable[[int, float], None] | None = None
    """Is called with every demand that reaches the amplifier, before its own faults, to judge the commands."""

    def __post_init__(self) -> None:
        self._random = np.random.default_rng([self.seed, 77])
        self._healthy_V = np.zeros(8)

    def sensor(self, channel: int, kind: str, amount: float | None, t_ns: int) -> None:
        """Begin ``kind`` (SENSOR_FAULTS) at DAQ input ``channel``; ``ok`` ends it."""
        if kind == "ok":
            self._sensors.pop(channel, None)
            return
        amount = _DEFAULT.get(kind, 0.0) if amount is None else amount
        self._sensors[channel] = _Active(kind, amount, t_ns, float(self._last_V[channel]))

    def actuator(self, channel: int, kind: str, amount: float | None, t_ns: int) -> float:
        """Begin ``kind`` (ACTUATOR_FAULTS) at ``channel``; ``ok`` ends it. The volts that the stack sees at once."""
        if kind == "ok":
            self._actuators.pop(channel, None)
        else:
            amount = _DEFAULT.get(kind, 0.0) if amount is None else amount
            self._actuators[channel] = _Active(kind, amount, t_ns, self._demand_V[channel])
        return self._driven_V(channel)

    def inputs(self, volts: Volts, t_ns: int) -> Volts:
        """Return the voltages (8,) that arrive at the DAQ; this is ``volts`` itself if no sensor has a fault."""
        if not self._sensors:
            self._last_V = volts
            return volts
        self._healthy_V = volts
        out = volts.copy()
        for channel, fault in self._sensors.items():
            out[channel] = self._damaged(fault, channel, out, t_ns)
        self._last_V = out
        return out

    def demand(self, channel: int, volts: float) -> float:
        """Record the demand ``volts`` on ``channel``; return the demand in V that takes effect on its stack."""
        self._demand_V[channel] = volts
        if self.on_demand is not None:
            self.on_demand(channel, volts)
        return self._driven_V(channel) if self._actuators else volts

    def _driven_V(self, channel: int) -> float:
        volts, fault = self._demand_V[channel], self._actuators.get(channel)
        if fault is None:
            return volts
        match fault.kind:
            case "open":
                return 0.0
            case "rail":
                return 100.0
            case "stuck":
                return fault.held_V
            case "slow":
                fault.held_V += fault.amount * (volts - fault.held_V)
                return fault.held_V
            case _:  # weak
                return 50.0 + fault.amount * (volts - 50.0)

    def _damaged(self, fault: _Active, channel: int, volts: Volts, t_ns: int) -> float:
        v = float(volts[channel])
        match fault.kind:
            case "stuck":
                return fault.held_V
            case "open":
                return 0.0
            case "short":
                return SUPPLY_V
            case "saturate":
                return SATURATED_V
            case "drift":
                return v + fault.amount * (t_ns - fault.since_ns) * 1e-9
            case "spike":
                once, fault.done = not fault.done, True
                return v + fault.amount * once
            case "noise":
                return v + fault.amount * float(self._random.standard_normal())
            case "gain":
                return MIDDLE_V + fault.amount * (v - MIDDLE_V)
            case "sign":
                return 2.0 * MIDDLE_V - v
            case _:  # swap: ``amount`` leads to the partner, which has a fault of its own
                return float(self._healthy_V[channel + int(fault.amount)])
