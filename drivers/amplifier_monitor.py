"""Monitor outputs of a piezo amplifier, or sense wires at the stacks, read by an ADC and compared with the commands.

What is measured must lie between the lowest and the highest voltage that was commanded during the conversion and
the amplifier's settling time before it, give or take a tolerance: no model of the amplifier is needed. A reading
a little outside is looked at once more, on the same channel, before anything is said. Wired to the stack's terminals
it sees a broken cable too; wired to the amplifier's monitor socket it sees the amplifier only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from drivers.adc.ads1115 import Ads1115
from hal.contracts import Clock, Float64Array
from hal.output_guard import OutputGuard

GROSS = 8.0
"""Times the tolerance: no noise and no mistake of a model, believed at once."""


class AmplifierMonitor:
    """``channels``: ADC inputs of outputs 1, 2, 3; output volts = ADC volts x ``ratio``.

    ``settle_s``: how long the amplifier may take to follow a step of one tick. ``tolerance_V``: sum of the errors of
    gain and offset of amplifier, divider and ADC.
    """

    def __init__(
        self,
        adc: Ads1115,
        guard: OutputGuard,
        clock: Clock,
        channels: Sequence[int] = (0, 1, 2),
        *,
        ratio: float = 20.0,
        tolerance_V: float = 0.5,
        settle_s: float = 0.0003,
        name: str = "monitor",
    ) -> None:
        self.name = name
        self.volts: Float64Array = np.full(len(channels), np.nan)
        """Last reading of each output, V."""
        self.readings = 0
        self.suspicions = 0
        self._adc = adc
        self._guard = guard
        self._clock = clock
        self._channels = tuple(channels)
        self._ratio = ratio
        self._tolerance_V = tolerance_V
        self._settle_ns = round(settle_s * 1e9)
        self._output = 0
        self._asked_ns = self._started_ns = 0  # the conversion under way began in between
        self._suspected = False

    def poll(self) -> str:
        """Collect what is ready, start the next conversion; empty, or which output does not follow.

        At most two short I2C transfers; never waits. Raises what the bus raises.
        """
        wrong = ""
        if self._adc.pending is not None:
            value_V = self._adc.collect()
            if value_V is None:
                return ""
            wrong = self._judge(value_V * self._ratio)
        self._asked_ns = self._clock.now_ns()
        self._adc.start_conversion(self._channels[self._output])
        self._started_ns = self._clock.now_ns()
        return wrong

    def forget(self) -> None:
        """Give up the conversion under way: what it saw is not to be compared."""
        self._adc.pending = None
        self._suspected = False

    def expected_V(self, output: int, from_ns: int, to_ns: int) -> tuple[float, float] | None:
        """Lowest and highest command that may have been in force between two times; ``None``: not known any more."""
        lowest, highest = math.inf, -math.inf
        for told in reversed(self._guard.told):
            if told.offered_ns < to_ns:
                v = told.volts[output]
                lowest, highest = min(lowest, v), max(highest, v)
            if told.sent_ns <= from_ns:  # all that came before had been replaced by this one
                return lowest, highest
        return None  # commands older than those that are kept

    def _judge(self, measured_V: float) -> str:
        output = self._output
        self.volts[output] = measured_V
        self.readings += 1
        span = self.expected_V(output, self._asked_ns - self._settle_ns, self._started_ns + self._adc.conversion_ns)
        if span is None or span[0] - self._tolerance_V <= measured_V <= span[1] + self._tolerance_V:
            self._suspected = False
            self._output = (output + 1) % len(self._channels)
            return ""
        self.suspicions += 1
        beyond_V = max(span[0] - measured_V, measured_V - span[1])
        if not self._suspected and beyond_V < GROSS * self._tolerance_V:
            self._suspected = True  # and the same output is converted again
            return ""
        told = f"{span[0]:.2f} V" if span[1] - span[0] < 0.005 else f"{span[0]:.2f} to {span[1]:.2f} V"
        return (
            f"output {output + 1} is at {measured_V:.2f} V and was told {told}: the amplifier, its supply, a cable or "
            f"a stack is broken (or {self.name} is); switch the amplifier off"
        )
