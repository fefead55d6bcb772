"""What every analog output shares: clip, limit the slew, refuse what is not finite, ramp to the safe state.

Plain arithmetic on a few floats: a numpy expression on three values costs more than the loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from hal.contracts import Clock, Float64Array
from hal.errors import ErrorKind, SafetyTrip
from hal.types import OutputLimit


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
        ramp_steps: int = 20,
        longest_gap_s: float = 0.005,
    ) -> None:
        self.device = device
        self.limits = tuple(limits)
        self.last_V = [limit.safe_V for limit in limits]
        self.next_V = list(self.last_V)
        self.armed = False
        self.writes = 0
        self.clipped = 0
        self.slew_limited = 0
        self._clock = clock
        self._ramp_steps = ramp_steps
        self._longest_gap_s = longest_gap_s
        self._sent_ns = clock.now_ns()
        self._ramp_step = 0
        self._ramp_from = list(self.last_V)

    def admit(self, values_V: Float64Array) -> int:
        """Fill ``next_V`` from the wish; returns the mask of channels that were clipped or slew limited.

        Raises ``SafetyTrip`` when not armed, on a wrong number of values and on a value that is not finite.
        """
        if not self.armed:
            raise SafetyTrip("outputs are not armed: call arm() first", device=self.device)
        if len(values_V) != len(self.limits):
            raise SafetyTrip(f"{len(values_V)} values for {len(self.limits)} output channels", device=self.device)
        gap_s = min((self._clock.now_ns() - self._sent_ns) * 1e-9, self._longest_gap_s)
        mask = 0
        for i, limit in enumerate(self.limits):
            wish = float(values_V[i])
            if not math.isfinite(wish):
                raise SafetyTrip(f"channel {i} was commanded to {wish} V", device=self.device)
            value = min(max(wish, limit.lo_V), limit.hi_V)
            if value != wish:
                self.clipped += 1
                mask |= 1 << i
            step = limit.slew_V_per_s * gap_s
            last = self.last_V[i]
            if abs(value - last) > step:
                value = last + math.copysign(step, value - last)
                self.slew_limited += 1
                mask |= 1 << i
            self.next_V[i] = value
        self._ramp_step = 0
        return mask

    def ramp(self) -> bool:
        """Disarm and fill ``next_V`` with the next step of a straight ramp to the safe state.

        True when that step is the safe state itself. Call again only after ``sent()``: a step that failed on
        the bus is offered once more.
        """
        self.armed = False
        if self._ramp_step == 0:
            self._ramp_from = list(self.last_V)
            self._ramp_step = 1
        part = self._ramp_step / self._ramp_steps
        for i, limit in enumerate(self.limits):
            start = self._ramp_from[i]
            self.next_V[i] = limit.safe_V if part >= 1.0 else start + (limit.safe_V - start) * part
        return part >= 1.0 or all(v == limit.safe_V for v, limit in zip(self._ramp_from, self.limits, strict=True))

    def sent(self) -> None:
        """The device has been told ``next_V``."""
        self.last_V[:] = self.next_V
        self._sent_ns = self._clock.now_ns()
        if self._ramp_step:
            self._ramp_step += 1
        else:
            self.writes += 1

    def start_from(self, values_V: Sequence[float]) -> None:
        """Believe that the device is at ``values_V``: after a readback, before a ramp."""
        self.last_V[:] = [float(v) for v in values_V]
        self._ramp_step = 0

    def at_safe_state(self) -> bool:
        return all(v == limit.safe_V for v, limit in zip(self.last_V, self.limits, strict=True))

    def require(self, good: bool, why: str) -> None:
        """Raise ``SafetyTrip`` when a self-test failed."""
        if not good:
            self.armed = False
            raise SafetyTrip(f"self-test failed: {why}", kind=ErrorKind.SAFETY, device=self.device)
