"""A staircase on the analog outputs with read-back: does the amplifier do what it is told?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_py.control.wiring import open_devices
from hal.bench import OpenBench

STEP_NS = 1_000_000


@dataclass(frozen=True)
class RampStep:
    """Holds one step: wanted and read back, in V."""

    channel: int
    wanted_V: float
    read_V: float

    @property
    def error_V(self) -> float:
        return self.read_V - self.wanted_V


def staircase(low_V: float, high_V: float, neutral_V: float, steps: int) -> list[float]:
    """Return the levels in V from neutral up, down and back, with ``steps`` steps between the limits."""
    grid = np.linspace(low_V, high_V, steps)
    up, down = grid[grid > neutral_V], grid[::-1]
    rise = grid[(grid > low_V) & (grid <= neutral_V)]
    return [neutral_V, *up.tolist(), *down.tolist(), *rise.tolist(), neutral_V]


def ramp(
    bench: OpenBench,
    channels: list[int],
    steps: int,
    dwell_s: float,
    progress: Callable[[RampStep], None] = lambda _: None,
) -> list[RampStep]:
    """Arm, climb one channel after the other, always end in the safe state. The guard's slew limit holds.

    Raises ``SafetyTrip`` when the amplifier's own test fails.
    """
    devices = open_devices(bench)
    amplifier, clock = devices.amplifier, bench.clock
    limits = amplifier.limits
    steps_done: list[RampStep] = []
    try:
        amplifier.arm()
        wish = np.array([limit.safe_V for limit in limits])
        for channel in channels:
            limit = limits[channel]
            for stair in staircase(limit.lo_V, limit.hi_V, limit.safe_V, steps):
                wish[channel] = stair
                end_ns = clock.now_ns() + round(dwell_s * 1e9)
                while True:
                    due_ns = clock.now_ns() + STEP_NS
                    limited = amplifier.write(wish)
                    clock.sleep_until_ns(due_ns)
                    if not limited and clock.now_ns() >= end_ns:
                        break
                steps_done.append(RampStep(channel, stair, float(amplifier.readback_V()[channel])))
                progress(steps_done[-1])
    finally:
        amplifier.close()
    return steps_done
