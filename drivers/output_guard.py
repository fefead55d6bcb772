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

RAMP_STEP_S = 0.001
LISTED = KEPT - 1
"""Number of commands that ``OutputGuard.sent_commands`` yields at most."""


class SentCommand(NamedTuple):
    """Describes a sent command. It took effect between its two times (bench clock, ns); ``offered_ns`` is the earliest
    time that the driver can state."""

    offered_ns: int
    sent_ns: int
    volts: tuple[float, ...]


class OutputGuard:
    """Limits what a driver sends: the driver sends ``next_V`` and then calls ``sent()``.

    ``last_V`` are the set points (V) that were sent last. The step that the slew limit allows grows with the time since
    then, up to ``longest_gap_s``, so that no large step follows a stall. Each ramp has ``ramp_steps`` steps of
    ``ramp_step_s``.
    """

    def __init__(
        self,
        device: str,
        limits: Sequence[OutputLimit],
        clock: Clock,
        *,
        ramp_steps: int = RAMP_STEPS,
        ramp_step_s: float = RAMP_STEP_S,
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
        """Fill ``next_V`` (n,) from ``values_V`` (n,). Return a bit mask: bit i is set if channel i was clipped or slew
        limited.

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

        Return True if that step is the safe state itself. Without ``sent()`` in between, the next call offers the same
        step again, as after a failed transfer. After lost time a call advances by several steps, as many as the slew
        limit allows in the time of one.
        """
        return next_ramp_step(self.state, self._clock.now_ns())

    def begin_ramp(self, since_ns: int) -> None:
        """Start a ramp as if at ``since_ns`` (bench clock), the time before the outputs were read back. ``ramp``
        continues it and makes up for the time since."""
        next_ramp_step(self.state, since_ns)

    def not_before(self, t_ns: int) -> None:
        """Note that ``next_V`` cannot take effect before ``t_ns`` (bench clock), the shortest end of its transfer."""
        self.state.words[OFFERED_NS] = t_ns

    def sent(self, ago_ns: int = 0) -> None:
        """Note that ``next_V`` was sent, at least ``ago_ns`` ago."""
        note_sent(self.state, self._clock.now_ns() - ago_ns)

    def start_from(self, values_V: Sequence[float]) -> None:
        """Set ``last_V`` to ``values_V`` (n,), which were read back, so that a ramp starts there."""
        for i, value_V in enumerate(values_V):
            self.state.last_V[i] = float(value_V)
        self.state.words[RAMP_DONE] = -1

    def offer_last(self) -> None:
        """Set ``next_V`` to ``last_V``, so that the last command can be sent again."""
        for i, value_V in enumerate(self.state.last_V):
            self.state.next_V[i] = value_V

    def brought_to_safe_state(self) -> None:
        """Note that the guardian has taken the device to its safe state and read that back."""
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
        """Disarm and raise ``SafetyTrip`` unless ``good``: a self-test has failed because of ``why``."""
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

    def safe_step(self) -> bool:
        """See ``AnalogOutput``."""
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

    def ramp_to_neutral(self) -> None:
        """Make the steps of the ramp, one per millisecond, until the outputs are at neutral."""
        with self.bringing_to_neutral():
            while self._is_away() and not self.safe_step():
                wait_s(self._clock, RAMP_STEP_S)

    def _is_away(self) -> bool:
        """Return True while the outputs are not at neutral."""
        return not self.guard.at_safe_state()

    @contextmanager
    def bringing_to_neutral(self, failed: str = "were NOT brought to neutral") -> Generator[None]:
        """Append to an error of the block, which takes the outputs to neutral, that they may not be there."""
        try:
            yield
        except HalError as error:
            raise type(error)(f"{error}; the outputs {failed}", kind=error.kind, device=self.name) from error
