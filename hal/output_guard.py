"""Protection that every analog output shares: clipping, slew limit, refusal of non-finite values, ramp to safe state.

``OutputGuard`` runs the functions of ``hal.output_guard_steps`` in the interpreter; a compiled loop runs the same ones
over the same memory (``GuardState.view``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from hal.contracts import Clock, Float64Array
from hal.errors import ErrorKind, SafetyTrip
from hal.output_guard_steps import (
    ARMED,
    CLIPPED,
    NOT_FINITE,
    OFFERED_NS,
    RAMP_DONE,
    RAMP_STEPS,
    SENT_NS,
    SLEW_LIMITED,
    WRITES,
    admit,
    new_state,
    next_ramp_step,
    note_sent,
)
from hal.types import OutputLimit

__all__ = ["RAMP_STEPS", "TOLD", "OutputGuard", "Told"]

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
        self.state = new_state(self.limits, clock.now_ns(), ramp_steps, ramp_step_s, longest_gap_s)
        self.told: deque[Told] = deque(maxlen=TOLD)
        """Holds the commands that were sent from Python, the newest last, for comparison with the measured outputs."""
        self._clock = clock

    @property
    def armed(self) -> bool:
        return bool(self.state.words[ARMED])

    @armed.setter
    def armed(self, armed: bool) -> None:
        self.state.words[ARMED] = armed

    @property
    def last_V(self) -> list[float]:
        return self.state.last_V.tolist()

    @property
    def next_V(self) -> list[float]:
        return self.state.next_V.tolist()

    @property
    def writes(self) -> int:
        return self.state.words[WRITES]

    @property
    def clipped(self) -> int:
        return self.state.words[CLIPPED]

    @property
    def slew_limited(self) -> int:
        return self.state.words[SLEW_LIMITED]

    def admit(self, values_V: Float64Array) -> int:
        """Fill ``next_V`` from the wish; returns the mask of channels that were clipped or slew limited.

        Raises ``SafetyTrip`` when not armed, on a wrong number of values and on a value that is not finite.
        """
        if not self.armed:
            raise SafetyTrip("outputs are not armed: call arm() first", device=self.device)
        wishes: list[float] = values_V.tolist()
        if len(wishes) != len(self.limits):
            raise SafetyTrip(f"{len(wishes)} values for {len(self.limits)} output channels", device=self.device)
        mask = admit(self.state, wishes, self._clock.now_ns())
        if mask < 0:
            channel = NOT_FINITE - mask
            raise SafetyTrip(f"channel {channel} was commanded to {wishes[channel]} V", device=self.device)
        return mask

    def ramp(self) -> bool:
        """Disarm and fill ``next_V`` with the next step of a straight ramp to the safe state.

        True when that step is the safe state itself. Call again only after ``sent()``: a step that failed on
        the bus is offered once more. Time that was lost is made up for, by as many steps at once as the slew limit
        allows in the time of one.
        """
        return next_ramp_step(self.state, self._clock.now_ns())

    def begin_ramp(self, since_ns: int) -> None:
        """Let the ramp that ``ramp`` goes on with have begun at ``since_ns``: where the device is had to be asked since
        then. The time is made up for as ``ramp`` says."""
        next_ramp_step(self.state, since_ns)

    def not_before(self, t_ns: int) -> None:
        """``next_V`` cannot take force before ``t_ns``: its transfer takes so long."""
        self.state.words[OFFERED_NS] = t_ns

    def sent(self, ago_ns: int = 0) -> None:
        """The device was told ``next_V``, at least ``ago_ns`` ago."""
        note_sent(self.state, self._clock.now_ns() - ago_ns)
        words = self.state.words
        self.told.append(Told(words[OFFERED_NS], words[SENT_NS], tuple(self.state.last_V)))

    def start_from(self, values_V: Sequence[float]) -> None:
        """Believe that the device is at ``values_V``: after a readback, before a ramp."""
        for i, value_V in enumerate(values_V):
            self.state.last_V[i] = float(value_V)
        self.state.words[RAMP_DONE] = -1

    def offer_last(self) -> None:
        """Make ``next_V`` what the device was last told, so that it can be sent again."""
        for i, value_V in enumerate(self.state.last_V):
            self.state.next_V[i] = value_V

    def brought_to_safe_state(self) -> None:
        """Somebody else has taken the device to its safe state and read that back."""
        state, now_ns = self.state, self._clock.now_ns()
        for i, safe_V in enumerate(state.safe_V):
            state.next_V[i] = state.last_V[i] = safe_V
        state.words[OFFERED_NS] = now_ns
        state.words[RAMP_DONE] = -1
        self.told.append(Told(now_ns, now_ns, tuple(state.last_V)))

    def at_safe_state(self) -> bool:
        return self.state.last_V == self.state.safe_V

    def require(self, good: bool, why: str) -> None:
        """Raise ``SafetyTrip`` when a self-test failed."""
        if not good:
            self.armed = False
            raise SafetyTrip(f"self-test failed: {why}", kind=ErrorKind.SAFETY, device=self.device)
