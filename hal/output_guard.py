"""Protection that every analog output shares: clipping, slew limit, refusal of non-finite values, ramp to safe state.

Plain arithmetic on a few floats: a numpy expression on three values costs more than the loop.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from hal.contracts import Clock, Float64Array
from hal.errors import ErrorKind, SafetyTrip
from hal.types import OutputLimit

RAMP_STEPS = 16
"""Number of ramp steps (1 ms each). It leaves 4 of the 20 ms until neutral for transfers that must be repeated."""

TOLD = 16


class Told(NamedTuple):
    """Describes a sent command. It took effect between its two times (bench clock, ns) if the driver says no better."""

    offered_ns: int
    sent_ns: int
    volts: tuple[float, ...]


class OutputGuard:
    """Decides what may go out next; the driver sends ``next_V`` and then calls ``sent()``.

    ``last_V`` is what the device was last told. The slew allowance grows with the time since then, up to
    ``longest_gap_s``, so that a stall does not buy one large step.
    """

    def __init__(
        self,
        device: str,
        limits: Sequence[OutputLimit],
        clock: Clock,
        *,
        ramp_steps: int = RAMP_STEPS,
        ramp_step_s: float = 0.001,
        longest_gap_s: float = 0.005,
    ) -> None:
        self.device = device
        self.limits = tuple(limits)
        self.last_V = [limit.safe_V for limit in limits]
        self.next_V = list(self.last_V)
        self.armed = False
        self.told: deque[Told] = deque(maxlen=TOLD)
        """Holds the commands that were sent, the newest last, for comparison with the measured outputs."""
        self.writes = 0
        self.clipped = 0
        self.slew_limited = 0
        self._clock = clock
        self._ramp_steps = ramp_steps
        self._ramp_step_ns = ramp_step_s * 1e9
        self._longest_gap_s = longest_gap_s
        self._sent_ns = self._offered_ns = clock.now_ns()
        self._ramp_done = -1  # steps of the ramp that the device has been told; -1: no ramp
        self._ramp_next = 0
        self._ramp_start_ns = 0
        self._ramp_from = list(self.last_V)
        self._ramp_longest = 1
        self._bounds = [(limit.lo_V, limit.hi_V, limit.slew_V_per_s) for limit in limits]

    def admit(self, values_V: Float64Array) -> int:
        """Fill ``next_V`` from the wish; returns the mask of channels that were clipped or slew limited.

        Raises ``SafetyTrip`` when not armed, on a wrong number of values and on a value that is not finite.
        """
        if not self.armed:
            raise SafetyTrip("outputs are not armed: call arm() first", device=self.device)
        if len(values_V) != len(self.limits):
            raise SafetyTrip(f"{len(values_V)} values for {len(self.limits)} output channels", device=self.device)
        self._offered_ns = self._clock.now_ns()
        gap_s = (self._offered_ns - self._sent_ns) * 1e-9
        if gap_s > self._longest_gap_s:
            gap_s = self._longest_gap_s
        mask = 0
        bit = 1
        next_V: list[float] = []
        wishes: list[float] = values_V.tolist()
        for wish, last, (lo_V, hi_V, slew) in zip(wishes, self.last_V, self._bounds, strict=True):
            value = wish
            # written so that NaN and infinities fall through to the last branch
            if lo_V <= wish <= hi_V:
                pass
            elif -math.inf < wish < lo_V:
                value = lo_V
                self.clipped += 1
                mask |= bit
            elif hi_V < wish < math.inf:
                value = hi_V
                self.clipped += 1
                mask |= bit
            else:
                raise SafetyTrip(f"channel {len(next_V)} was commanded to {wish} V", device=self.device)
            step = slew * gap_s
            if value > last + step:
                value = last + step
                self.slew_limited += 1
                mask |= bit
            elif value < last - step:
                value = last - step
                self.slew_limited += 1
                mask |= bit
            next_V.append(value)
            bit <<= 1
        self.next_V = next_V
        self._ramp_done = -1
        return mask

    def ramp(self) -> bool:
        """Disarm and fill ``next_V`` with the next step of a straight ramp to the safe state.

        True when that step is the safe state itself. Call again only after ``sent()``: a step that failed on
        the bus is offered once more. Time that was lost is made up for, by as many steps at once as the slew limit
        allows in the time of one.
        """
        self.armed = False
        self._offered_ns = now_ns = self._clock.now_ns()
        if self._ramp_done < 0:
            self._ramp_from = list(self.last_V)
            self._ramp_done = 0
            self._ramp_start_ns = now_ns
            self._ramp_longest = self._steps_within_slew()
        due = 1 + round((now_ns - self._ramp_start_ns) / self._ramp_step_ns)
        self._ramp_next = min(max(due, self._ramp_done + 1), self._ramp_done + self._ramp_longest)
        part = self._ramp_next / self._ramp_steps
        for i, limit in enumerate(self.limits):
            start = self._ramp_from[i]
            self.next_V[i] = limit.safe_V if part >= 1.0 else start + (limit.safe_V - start) * part
        return part >= 1.0 or all(v == limit.safe_V for v, limit in zip(self._ramp_from, self.limits, strict=True))

    def _steps_within_slew(self) -> int:
        fewest = self._ramp_steps
        for start, limit in zip(self._ramp_from, self.limits, strict=True):
            step_V = abs(start - limit.safe_V) / self._ramp_steps
            if step_V > 0.0:
                fewest = min(fewest, int(limit.slew_V_per_s * self._ramp_step_ns * 1e-9 / step_V))
        return max(1, fewest)

    def not_before(self, t_ns: int) -> None:
        """``next_V`` cannot take force before ``t_ns``: its transfer takes so long."""
        self._offered_ns = t_ns

    def sent(self, ago_ns: int = 0) -> None:
        """The device was told ``next_V``, at least ``ago_ns`` ago."""
        self.last_V[:] = self.next_V
        self._sent_ns = self._clock.now_ns() - ago_ns
        self.told.append(Told(self._offered_ns, self._sent_ns, tuple(self.next_V)))
        if self._ramp_done >= 0:
            self._ramp_done = self._ramp_next
        else:
            self.writes += 1

    def start_from(self, values_V: Sequence[float]) -> None:
        """Believe that the device is at ``values_V``: after a readback, before a ramp."""
        self.last_V[:] = [float(v) for v in values_V]
        self._ramp_done = -1

    def brought_to_safe_state(self) -> None:
        """Somebody else has taken the device to its safe state and read that back."""
        self.next_V[:] = [limit.safe_V for limit in self.limits]
        self._offered_ns = self._clock.now_ns()
        self._ramp_done = -1
        self.last_V[:] = self.next_V
        self.told.append(Told(self._offered_ns, self._offered_ns, tuple(self.next_V)))

    def at_safe_state(self) -> bool:
        return all(v == limit.safe_V for v, limit in zip(self.last_V, self.limits, strict=True))

    def require(self, good: bool, why: str) -> None:
        """Raise ``SafetyTrip`` when a self-test failed."""
        if not good:
            self.armed = False
            raise SafetyTrip(f"self-test failed: {why}", kind=ErrorKind.SAFETY, device=self.device)
