"""Compares the measured outputs of a piezo amplifier with the commands, through an ADC.

The ADC reads the amplifier's monitor outputs, or sense wires at the stacks; only the latter show a broken cable.

The converter averages over its conversion, so a reading must be a mean of the commands that were in force meanwhile,
each with a weight between the shortest and the longest time that it can have been in force. This needs no model of the
amplifier, only its longest settling time. The difference of a healthy output (gain and offset of amplifier and divider)
is learned within the tolerance where the commands are known well enough, and a change of it is as suspicious as a
difference beyond the tolerance. A suspicious output is measured once more before it is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drivers.adc.ads1115 import EXCHANGE_NS, ORDER_NS, RATE_TOLERANCE, WAKE_UP_NS, Ads1115
from drivers.options import AmplifierMonitorOptions
from drivers.output_guard import OutputGuard
from drivers.registry import Driver
from hal.arrays import Array
from hal.contracts import Clock

GROSS = 8.0
"""Deviation, as a multiple of the tolerance, at which one reading is enough to report the output."""


class Window(NamedTuple):
    """Bounds a conversion: its earliest and latest start (bench ns), and its longest and shortest duration (ns)."""

    earliest_ns: int
    latest_ns: int
    longest_ns: int
    shortest_ns: int


MEMORY = 240
"""Number of readings of an output after which an older one has the weight 1/e in the usual difference."""
LEARN = 20.0
"""Sum of the readings' weights from which the usual difference of an output counts as known."""


class Usual:
    """Fits a straight line to the recent differences of one output from the middle of its expected range.

    A middle may be off by half the range. So the line is learnt from ranges up to ``2 * change_V`` alone, whose
    middles are off by ``change_V`` at most. A slow bus leaves wider ranges; after some ``MEMORY`` readings with
    nothing else the line counts as unknown, and the tolerance alone judges.
    """

    def __init__(self, change_V: float) -> None:
        self._widest_V = 2.0 * change_V
        self._sums = [0.0] * 5  # 1, x, x x, y, x y, forgetting

    @property
    def is_known(self) -> bool:
        return self._sums[0] >= LEARN

    def at(self, x_V: float) -> float:
        """Return the usual difference (V) at ``x_V``."""
        n, sx, sxx, sy, sxy = self._sums
        slope = (sxy - sx * sy / n) / (sxx - sx * sx / n + n)  # prior of the slope: 0 +- the difference over 1 V rms
        return sy / n + slope * (x_V - sx / n)

    def learn(self, span_V: tuple[float, float], measured_V: float) -> None:
        """Learn from a healthy reading whose command was within ``span_V``."""
        x_V = 0.5 * (span_V[0] + span_V[1])
        y_V = measured_V - x_V
        weight = float(span_V[1] - span_V[0] <= self._widest_V)
        new = (1.0, x_V, x_V * x_V, y_V, x_V * y_V)
        self._sums = [(1.0 - 1.0 / MEMORY) * old + weight * term for old, term in zip(self._sums, new, strict=True)]


class AmplifierMonitor:
    """Compares the measured outputs of the amplifier with the commands that may have been in force.

    ``channels`` are the ADC inputs of outputs 1, 2, 3; output volts = ADC volts x ``ratio``. The amplifier may take
    ``settle_s`` to follow a step of one tick. ``tolerance_V`` is the sum of the errors of gain and offset of amplifier,
    divider and ADC. A reading may differ from its usual difference by ``change_V``.
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
        change_V: float = 0.15,
        name: str = "monitor",
    ) -> None:
        self.name = name
        self.volts: Array = np.full(len(channels), np.nan)
        """Last reading of each output, V."""
        self.readings = 0
        self.suspicions = 0
        self._adc = adc
        self._guard = guard
        self._clock = clock
        self._channels = tuple(channels)
        self._ratio = ratio
        self._tolerance_V = tolerance_V
        self._change_V = change_V
        self._usual = [Usual(change_V) for _ in channels]
        self._settle_ns = round(settle_s * 1e9)
        nominal_ns = (adc.conversion_ns - WAKE_UP_NS) / (1.0 + RATE_TOLERANCE)
        self._longest_ns = round(nominal_ns * (1.0 + RATE_TOLERANCE))
        self._shortest_ns = round(nominal_ns * (1.0 - RATE_TOLERANCE))
        self._output = self._turn = 0  # output of the conversion under way; output that was converted last
        self._ordered_ns = self._started_ns = 0  # the conversion under way began in between
        self._suspected = [False] * len(self._channels)

    def poll(self) -> str:
        """Collect a finished conversion and start the next one, in one transfer. Return a message that names the output
        which does not follow its commands, else an empty text.

        The next output is ordered before the reading is known, so a suspicious output is measured again after the one
        that follows it. Never waits. Raises what the bus raises.
        """
        asked_ns = self._clock.now_ns()
        if self._adc.pending is None:
            self._adc.start_conversion(self._channels[self._turn])
            self._ordered(self._turn, asked_ns + ORDER_NS)
            return ""
        following = self._following()
        value_V = self._adc.exchange(self._channels[following])
        if value_V is None:
            return ""
        output, window = self._output, self.window()
        self._ordered(following, asked_ns + EXCHANGE_NS)
        return self._judge(output, window, value_V * self._ratio)

    def forget(self) -> None:
        """Discard the conversion in progress, so that its result is not compared."""
        self._adc.pending = None
        self._suspected = [False] * len(self._channels)

    def window(self) -> Window:
        """Return the window of the conversion in progress.

        It started while its order was on the bus, or at most ``WAKE_UP_NS`` later because the ADC had to wake up."""
        return Window(self._ordered_ns, self._started_ns + WAKE_UP_NS, self._longest_ns, self._shortest_ns)

    def _following(self) -> int:
        """Return the output to convert after the one that is being read: a suspicious one, else the next in turn."""
        for output, suspected in enumerate(self._suspected):
            if suspected and output != self._output:
                return output
        return (self._turn + 1) % len(self._channels)

    def _ordered(self, output: int, ordered_ns: int) -> None:
        if not self._suspected[output]:
            self._turn = output
        self._output = output
        self._ordered_ns, self._started_ns = ordered_ns, self._clock.now_ns()

    def expected_V(self, output: int, window: Window) -> tuple[float, float] | None:
        """Return the lowest and highest mean, in V, of the commands of ``output`` over a conversion.

        Return ``None`` if the commands of that time are no longer kept. A command is in force from some time between
        its offer and its acknowledge, plus the settling time, until the next one is.
        """
        shortest: list[tuple[float, float, float]] = []  # volts, least weight, further weight
        end_ns = window.latest_ns + window.longest_ns
        gone_late_ns = gone_early_ns = end_ns  # when the next command took over, at the latest and at the earliest
        commands = self._guard.sent_commands()  # most of them are older than the conversion, and are not looked at
        tick_V = self._guard.limits[output].slew_V_per_s * 1e-3
        command = next(commands, None)
        while command is not None:
            before = next(commands, None)
            value_V = command.volts[output]
            ticks_worth = 1.0 if before is None else max(1.0, abs(value_V - before.volts[output]) / tick_V)  # a gap
            since_late_ns = command.sent_ns + round(self._settle_ns * ticks_worth)
            if command.offered_ns < end_ns:
                least_ns = min(gone_early_ns, window.earliest_ns + window.shortest_ns) - max(
                    since_late_ns, window.latest_ns
                )
                most_ns = min(gone_late_ns, end_ns) - max(command.offered_ns, window.earliest_ns)
                least = max(0, least_ns) / window.longest_ns
                most = min(1.0, max(0, most_ns) / window.shortest_ns)
                shortest.append((value_V, least, most - least))
            if since_late_ns <= window.earliest_ns:  # all that came before had been replaced by this one
                return _mean(sorted(shortest)), _mean(sorted(shortest, reverse=True))
            gone_late_ns, gone_early_ns = since_late_ns, command.offered_ns
            command = before
        return None  # commands older than those that are kept

    def _judge(self, output: int, window: Window, measured_V: float) -> str:
        self.volts[output] = measured_V
        self.readings += 1
        span = self.expected_V(output, window)
        if span is None or not self._is_odd(output, measured_V, span):
            self._suspected[output] = False
            return ""
        self.suspicions += 1
        beyond_V = max(span[0] - measured_V, measured_V - span[1])
        if not self._suspected[output] and beyond_V < GROSS * self._tolerance_V:
            self._suspected[output] = True
            return ""
        expected = f"{span[0]:.2f} V" if span[1] - span[0] < 0.005 else f"{span[0]:.2f} to {span[1]:.2f} V"
        if beyond_V <= self._tolerance_V:
            expected += f", from which it usually differs by {self._usual[output].at(0.5 * sum(span)):+.2f} V"
        return (
            f"output {output + 1} is at {measured_V:.2f} V and was told {expected}: the amplifier, its supply, a cable "
            f"or a stack is broken (or {self.name} is); switch the amplifier off"
        )

    def _is_odd(self, output: int, measured_V: float, span: tuple[float, float]) -> bool:
        if not span[0] - self._tolerance_V <= measured_V <= span[1] + self._tolerance_V:
            return True
        usual = self._usual[output]
        if usual.is_known:
            # the uncertainty of the commands stays; only gain and offset are known better
            healthy_V = measured_V - usual.at(0.5 * (span[0] + span[1]))
            if not span[0] - self._change_V <= healthy_V <= span[1] + self._change_V:
                return True
        usual.learn(span, measured_V)
        return False


def _mean(commands: Sequence[tuple[float, float, float]]) -> float:
    """Return the mean of volts with weights that sum to one: each gets its least weight, the first ones get the
    rest."""
    left = 1.0 - sum(least for _, least, _ in commands)
    mean_V = 0.0
    for volts, least, further in commands:
        extra = min(left, further)
        left -= extra
        mean_V += volts * (least + extra)
    return mean_V


DRIVER = Driver(AmplifierMonitorOptions, role="part", needs="adc", inputs=lambda options: options.channels)
