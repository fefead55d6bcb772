"""When a hold may end: scans have flowed and the self-test has passed for a stated time, and a person agreed if asked.

The supervisor owns the states, this owns the times. All times are the bench clock's, in ns.
"""

from __future__ import annotations

from typing import Any

from firmware_py.control.findings import Finding
from firmware_py.control.safety import Hold, SafetyLimits, State, Supervisor

MINUTE_NS = 60_000_000_000
OPERATOR = "the operator"


class Holds:
    """Counts holds and decides when one may end. ``waits_for`` says in words what the hold waits for."""

    def __init__(self, limits: SafetyLimits, supervisor: Supervisor) -> None:
        self.waits_for = ""
        self._limits = limits
        self._supervisor = supervisor
        self._good_since_ns = 0
        self._last_ready_ns = 0
        self._is_ready = False
        self._asked = False

    @property
    def current(self) -> Hold | None:
        """The hold that lasts, if one does."""
        return self._supervisor.holds[-1] if self._supervisor.is_holding else None

    def within_a_minute(self, now_ns: int) -> int:
        """How many holds began within the last minute."""
        return sum(now_ns - hold.t_ns < MINUTE_NS for hold in self._supervisor.holds)

    def interrupt(self, now_ns: int, why: str) -> None:
        """Something was not good: the time begins anew."""
        self._good_since_ns, self.waits_for = now_ns, why
        self._is_ready = self._asked = False

    def good_ms(self, now_ns: int) -> float:
        """For how long nothing has been wrong."""
        return (now_ns - self._good_since_ns) * 1e-6

    def may_end(self, now_ns: int) -> bool:
        """Whether the outputs may move again; called once per pass of the loop while the outputs are at neutral."""
        self._is_ready = self.good_ms(now_ns) >= self._limits.hold_ms
        if not self._is_ready:
            return False
        self._last_ready_ns = now_ns
        self.waits_for = OPERATOR
        return self._asked or self._limits.rearm == "automatic"

    @property
    def is_ready(self) -> bool:
        """The cause has passed; what is still missing, if anything, is the operator."""
        return self._is_ready

    def ask(self) -> bool:
        """The operator wants the outputs to move again. False: there is nothing to end yet, and it is not kept."""
        self._asked = self._is_ready and self._supervisor.state is State.HOLD
        return self._asked

    def wait_out_host(self, now_ns: int, reason: str) -> None:
        """The host stands still within a hold: that time is not the cause's, and a hold that the host began tells how
        long it was in all."""
        self._last_ready_ns = now_ns
        hold = self.current
        if hold is not None and hold.finding is Finding.HOST_OVERSLEPT:
            hold.reason = reason

    def wait_for(self, now_ns: int, what: str) -> None:
        """``what`` is on its way and has a limit of its own: the hold waits for it and does not grow too long."""
        self.interrupt(now_ns, what)
        self._last_ready_ns = now_ns

    def is_too_long(self, now_ns: int) -> bool:
        """The hold has not become good within its limit."""
        hold = self.current
        if hold is None or self._is_ready:
            return False
        return (now_ns - max(hold.t_ns, self._last_ready_ns)) * 1e-6 >= self._limits.hold_limit_ms

    def end(self, now_ns: int) -> Hold:
        """The outputs move again."""
        hold = self._supervisor.holds[-1]
        hold.end_ns, hold.resumed = now_ns, True
        self._is_ready = self._asked = False
        self.waits_for = ""
        return hold

    def as_status(self, now_ns: int) -> dict[str, Any] | None:
        """The hold that lasts, for page and terminal; ``None`` while there is none."""
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
        """All holds as the run's JSON has them; ``t_s`` counts from ``started_ns``, as a recording's time does. What
        ended a hold that was not ``resumed`` is the end of the run."""
        return [
            {
                "t_s": (hold.t_ns - started_ns) * 1e-9,
                "cause": hold.reason,
                "class": hold.cause.value,
                "length_s": ((now_ns if hold.end_ns is None else hold.end_ns) - hold.t_ns) * 1e-9,
                "finding": hold.finding.name.lower(),
                "t_ns": hold.t_ns,
                "resumed": hold.resumed,
            }
            for hold in self._supervisor.holds
        ]
