"""Decides when a hold may end: scans and self-test have been good for a stated time, and a person agreed if asked.

The supervisor owns the states; this module owns the times. All times are the bench clock's, in ns.
"""

from __future__ import annotations

from typing import Any

from firmware_py.run.findings import CauseClass, Finding
from firmware_py.run.safety import Hold, SafetyLimits, State, Supervisor

MINUTE_NS = 60_000_000_000
OPERATOR = "the operator"


class Holds:
    """Counts holds and decides when one may end. ``waits_for`` is a text for display: what the hold waits for.

    ``allows_host_stalls``: a hold that this host has caused does not count towards ``holds_per_minute``.
    """

    def __init__(self, limits: SafetyLimits, supervisor: Supervisor, *, allows_host_stalls: bool = False) -> None:
        self.waits_for = ""
        self._spares_host = allows_host_stalls
        self._limits = limits
        self._supervisor = supervisor
        self._good_since_ns = 0
        self._last_ready_ns = 0
        self._refused: tuple[Hold, int] | None = None
        self._is_ready = False
        self._asked = False

    @property
    def current(self) -> Hold | None:
        """Return the hold that lasts now, or ``None``."""
        return self._supervisor.holds[-1] if self._supervisor.is_holding else None

    def count_within_a_minute(self, now_ns: int) -> int:
        """Return the number of holds that began within the last minute and count."""
        return sum(now_ns - hold.t_ns < MINUTE_NS for hold in self._supervisor.holds if self.counts(hold.cause))

    def counts(self, cause: CauseClass) -> bool:
        """Return True if a hold of this cause counts towards ``holds_per_minute``."""
        return cause is not CauseClass.HOST or not self._spares_host

    def interrupt(self, now_ns: int, why: str) -> None:
        """Restart the time that must be good without interruption; ``why`` is what the hold waits for."""
        self._good_since_ns, self.waits_for = now_ns, why
        self._is_ready = self._asked = False

    def good_ms(self, now_ns: int) -> float:
        """Return the time since the last interruption, ms."""
        return (now_ns - self._good_since_ns) * 1e-6

    def may_end(self, now_ns: int) -> bool:
        """Return True if the outputs may move again. Called once per pass of the loop while they are at neutral."""
        self._is_ready = self.good_ms(now_ns) >= self._limits.hold_ms
        if not self._is_ready:
            return False
        self._last_ready_ns = now_ns
        self.waits_for = OPERATOR
        return self._asked or self._limits.rearm == "automatic"

    @property
    def is_ready(self) -> bool:
        """True once the cause has passed, so that at most the operator's consent is missing."""
        return self._is_ready

    def ask(self) -> bool:
        """Accept the operator's request to end the hold. Return False, and drop the request, if the hold cannot end yet
        (``may_end``)."""
        self._asked = self._is_ready and self._supervisor.state is State.HOLD
        return self._asked

    def exclude_host_stall(self, now_ns: int, reason: str) -> None:
        """Exclude a stall of the host within a hold from the hold's time limit. A hold that the host caused takes
        ``reason`` as its own."""
        self._last_ready_ns, self._refused = now_ns, None
        hold = self.current
        if hold is not None and hold.finding is Finding.HOST_OVERSLEPT:
            hold.reason = reason

    def wait_for(self, now_ns: int, what: str) -> None:
        """Let the hold wait for ``what``, which has a time limit of its own and does not count towards the hold's."""
        self.interrupt(now_ns, what)
        self._last_ready_ns, self._refused = now_ns, None

    def note_refusal(self, now_ns: int) -> None:
        """Note that the outputs could not be armed, although the hold was to end by itself."""
        hold = self.current
        if hold is None or self._limits.rearm != "automatic":
            return
        if self._refused is None or self._refused[0] is not hold:
            self._refused = hold, now_ns

    def has_timed_out(self, now_ns: int) -> bool:
        """Return True if the hold has not become good within ``hold_limit_ms``, or has not been able to end for as long
        because the outputs could not be armed."""
        hold = self.current
        if self._refused is not None and self._refused[0] is hold:
            return (now_ns - self._refused[1]) * 1e-6 >= self._limits.hold_limit_ms
        if hold is None or self._is_ready:
            return False
        return (now_ns - max(hold.t_ns, self._last_ready_ns)) * 1e-6 >= self._limits.hold_limit_ms

    def end(self, now_ns: int) -> Hold:
        """Mark the last hold as ended with the outputs moving again, and return it."""
        hold = self._supervisor.holds[-1]
        hold.end_ns, hold.resumed = now_ns, True
        self._is_ready = self._asked = False
        self.waits_for = ""
        return hold

    def as_status(self, now_ns: int) -> dict[str, Any] | None:
        """Return the hold that lasts now as JSON values for page and terminal, or ``None``."""
        hold = self.current
        if hold is None:
            return None
        return {
            "cause": hold.reason,
            "class": hold.cause.value,
            "for_s": (now_ns - hold.t_ns) * 1e-9,
            "waits_for": self.waits_for,
            "rearm": self._limits.rearm,
        }

    def as_list(self, started_ns: int, now_ns: int) -> list[dict[str, Any]]:
        """Return all holds as the run's JSON has them. ``t_s`` counts from ``started_ns``, as a recording's time does.
        A hold that was not ``resumed`` ended with the run."""
        return [
            {
                "t_s": (hold.t_ns - started_ns) * 1e-9,
                "cause": hold.reason,
                "class": hold.cause.value,
                "length_s": ((now_ns if hold.end_ns is None else hold.end_ns) - hold.t_ns) * 1e-9,
                "finding": hold.finding.name.lower(),
                "t_ns": hold.t_ns,
                "resumed": hold.resumed,
                "neutral_ms": None if hold.neutral_ns is None else (hold.neutral_ns - hold.t_ns) * 1e-6,
            }
            for hold in self._supervisor.holds
        ]
