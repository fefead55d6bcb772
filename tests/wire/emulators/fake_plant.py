"""A plant of twenty lines for tests of devices and transports: inputs that say when they were looked at."""

from __future__ import annotations

from typing import Any

import numpy as np


class FakePlant:
    """Analog input 0 is a ramp of 1 V/s; the demands are kept with their times."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.analog_V = np.zeros(8)
        self.magnetometer_V = np.array([2.0, 2.5, 3.0])
        self.stack_V = np.array([10.0, 50.0, 90.0])
        self.demands: list[tuple[int, float, int]] = []
        self.straps: list[str] = []

    def advance_to(self, t_ns: int) -> None:
        assert t_ns >= 0
        self.t_ns = max(self.t_ns, t_ns)
        self.analog_V[0] = self.t_ns * 1e-9 % 5.0

    def set_demand_V(self, channel: int, volts: float, t_ns: int) -> None:
        assert t_ns >= self.t_ns, "the world acts in order of time"
        self.t_ns = t_ns
        self.demands.append((channel, volts, t_ns))

    def sag_supply(self, part: float) -> None:
        self.supply_part = part

    def strap(self, pulse: str) -> None:
        self.straps.append(pulse)

    def truth_row(self) -> dict[str, Any]:
        latest = {channel: volts for channel, volts, _ in self.demands}
        return {"stroke_m": np.array([latest.get(c, 0.0) * 0.15e-6 for c in range(3)])}

    def truth(self) -> dict[str, Any]:
        return {"t_ns": np.array([0, self.t_ns]), "amplifier_V": np.array([d[1] for d in self.demands])}


def make_fake(description: dict[str, Any], hand_file: str | None, hand_scale: float | None) -> FakePlant:
    return FakePlant()
