"""Protection that every analog output shares: clipping, slew limit, refusal of non-finite values, ramp to safe state.

``OutputGuard`` runs the functions of ``output_guard_steps`` in the interpreter; a compiled loop runs the same ones
over the same memory (``GuardState.view``).
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from drivers.base import wait_s
from drivers.output_guard_steps import (
    ARMED,
    CLIPPED,
    KEPT,
    N_SENT,
    NOT_FINITE,
    OFFERED_NS,
    RAMP_DONE,
    RAMP_NEXT,
    RAMP_STEPS,
    WRITES,
    admit,
    new_state,
    next_ramp_step,
    note_sent,
)
from hal.arrays import Array
from hal.contracts import ARMING_STEP_S, Clock
from hal.errors import ErrorKind, HalError, SafetyTrip
from hal.types import OutputLimit

__all__ = ["LISTED", "RAMP_STEPS", "OutputGuard", "SentCommand"]

LISTED = KEPT - 1
"""Number of commands that ``OutputGuard.sent_commands`` yields at most."""


class SentCommand(NamedTuple):
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

    def sent_commands(self) -> Iterator[SentCommand]:
        """Yield the last ``LISTED`` commands, the newest first.

        A compiled loop may send more in the meantime; what it could have overwritten is left out.
        """
        state, n = self.state, len(self.limits)
        newest = state.words[N_SENT]
        kept_ns, kept_V = state.kept_ns.tolist(), state.kept_V.tolist()
        for k in range(newest - 1, max(0, newest - LISTED) - 1, -1):
            p = k % KEPT
            yield SentCommand(kept_ns[2 * p], kept_ns[2 * p + 1], tuple(kept_V[n * p : n * p + n]))

    def admit(self, values_V: Array) -> int:
        """Fill ``next_V`` (n,) from the wanted values. Return the mask of channels that were clipped or slew limited.

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
        state, words, now_ns = self.state, self.state.words, self._clock.now_ns()
        for i, safe_V in enumerate(state.safe_V):
            state.next_V[i] = safe_V
        words[OFFERED_NS] = now_ns
        words[RAMP_DONE] = words[RAMP_NEXT] = 0  # a step of a ramp, which counts as no command
        note_sent(state, now_ns)
        words[RAMP_DONE] = -1

    def at_safe_state(self) -> bool:
        return self.state.last_V == self.state.safe_V

    def require(self, good: bool, why: str) -> None:
        """Raise ``SafetyTrip`` when a self-test failed."""
        if not good:
            self.armed = False
            raise SafetyTrip(f"self-test failed: {why}", kind=ErrorKind.SAFETY, device=self.device)


class GuardedOutput:
    """Base of the drivers whose commands pass an ``OutputGuard``; each sets ``name`` and ``guard``."""

    name: str
    guard: OutputGuard
    _clock: Clock

    def arming(self) -> Iterator[None]:
        """See ``ArmsInSteps``."""
        raise NotImplementedError

    def arm(self) -> None:
        """Do the steps of ``arming`` one after another."""
        for _ in self.arming():
            wait_s(self._clock, ARMING_STEP_S)

    @property
    def commands_sent(self) -> int:
        return self.guard.writes

    @property
    def commanded_V(self) -> Sequence[float]:
        return self.guard.last_V

    @contextmanager
    def bringing_to_neutral(self, failed: str = "were NOT brought to neutral") -> Generator[None]:
        """Let an error of the block, which brings the outputs to neutral, say that they may not be there."""
        try:
            yield
        except HalError as error:
            raise type(error)(f"{error}; the outputs {failed}", kind=error.kind, device=self.name) from error
