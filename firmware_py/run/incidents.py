"""Handles every finding and remarkable event in one place: counts it, records it, and acts as the table states."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_py.run.findings import CauseClass, Finding
from firmware_py.run.holds import Holds
from firmware_py.run.safety import SafetyLimits, State, Supervisor
from firmware_py.scheduler.histogram import DurationHistogram
from hal.contracts import Clock
from hal.errors import HalError


class Recorder(Protocol):
    """Receives finished frames and events without blocking. Both methods return False for a row or event that is
    dropped for want of room, and count it."""

    def push(self, row: NDArray[np.float64]) -> bool: ...
    def event(self, event: dict[str, object]) -> bool: ...


@dataclass
class LoopCounts:
    """Holds the loop's own counters, beside the scheduler's figures.

    ``lost``: scans known to be missing; ``unread``: scans that were due after the last one read, when the loop stopped.
    ``commands``: commands sent to the amplifier; ``superseded``: ticks whose values a slow amplifier passed over for
    newer ones. ``clipped``: ticks whose command ran into a limit (yielding does not count). ``latency``: time from the
    sample (its due time) to the end of ``write``, of the commands sent. ``noticed``: bench time (ns) at which a
    condition that does not end a run was first seen.
    """

    expected: int = 0
    received: int = 0
    lost: int = 0
    unread: int = 0
    commands: int = 0
    superseded: int = 0
    clipped: int = 0
    magnetometer_errors: int = 0
    noticed: dict[str, int] = field(default_factory=dict[str, int])
    latency: DurationHistogram = field(default_factory=DurationHistogram)


class Incidents:
    """Turns every finding into the consequence that ``findings.Finding`` states. The loop sets ``tick``, the number of
    the tick under way; ``error`` is the first hardware error that ended the run."""

    def __init__(
        self,
        supervisor: Supervisor,
        counts: LoopCounts,
        clock: Clock,
        recorder: Recorder | None,
        limits: SafetyLimits | None = None,
        *,
        allows_host_stalls: bool = False,
    ) -> None:
        self._limits = limits or SafetyLimits()
        self._supervisor = supervisor
        self._counts = counts
        self._clock = clock
        self._recorder = recorder
        self._bad_since: dict[Finding, int] = {}
        self.holds = Holds(self._limits, supervisor, allows_host_stalls=allows_host_stalls)
        self.tick = -1
        self.error: HalError | None = None

    def note(self, event: dict[str, object]) -> None:
        """Write ``event`` into the recording, with the bench time (``t_ns``) and the tick."""
        if self._recorder is not None:
            self._recorder.event({"t_ns": self._clock.now_ns(), "tick": self.tick, **event})

    def notice(self, what: str) -> None:
        """Keep the time at which ``what``, which does not end the run, was first seen."""
        self._counts.noticed.setdefault(what, self._clock.now_ns())

    def report(self, finding: Finding, **words: object) -> None:
        """Start the consequence of ``finding``; ``words`` fill the fields of its message.

        A latched finding ends the run: the outputs ramp to the safe state and stay there. A recoverable one depends on
        the supervisor's state:

        - RUNNING: the outputs ramp to neutral and hold. The run ends instead if this is one hold more within a minute
          than ``holds_per_minute``.
        - SELF_TEST, HOLD_RAMP, HOLD: the self-test or hold goes on, and the time that must be good without
          interruption begins again. The finding is counted in ``LoopCounts.noticed``.
        - BOOT, SENSING_ONLY: the run ends, as with a latched finding. Readings are reported by ``report_reading`` and
          ``report_after``, which only notice them there.
        - SAFE_RAMP, SAFE: nothing happens, and a latched finding changes nothing either: the first reason wins.
        """
        self._answer(finding, finding.value.says.format(**words))

    def report_reading(self, finding: Finding, **words: object) -> None:
        """Report a reading that must not move the outputs. In the state SENSING_ONLY it is only noticed."""
        if self._supervisor.state is State.SENSING_ONLY:
            self.notice(finding.value.title)
        else:
            self.report(finding, **words)

    def report_error(self, finding: Finding, device: str, error: HalError, **words: object) -> None:
        """Report ``error`` with the bench's name of ``device`` in front, because a port knows only its path. Keep it in
        ``error`` if it ended the run."""
        text = f"{error}" if str(error).startswith(device) else f"{device}: {error}"
        self.report(finding, error=text, **words)
        if self._supervisor.trip_cause is not None and self.error is None:
            self.error = error

    def report_after(self, finding: Finding, bad: bool, t_ns: int, patience_ms: float, **words: object) -> None:
        """Report ``finding`` once ``bad`` has been True for ``patience_ms``, in every further call as well. ``t_ns`` is
        the time of the reading (bench clock). In the state SENSING_ONLY the finding is only noticed."""
        if not bad:
            if self._bad_since:
                self._bad_since.pop(finding, None)
        elif (t_ns - self._bad_since.setdefault(finding, t_ns)) * 1e-6 >= patience_ms:
            if self._supervisor.state is State.SENSING_ONLY:
                self.notice(f"{finding.value.title}: beyond its limit")
            else:
                self.report(finding, **words)

    def _answer(self, finding: Finding, reason: str) -> None:
        supervisor, now_ns = self._supervisor, self._clock.now_ns()
        if supervisor.trip_cause is not None:
            return
        if not finding.value.recoverable:
            self._trip(finding, reason)
        elif supervisor.is_holding or supervisor.state is State.SELF_TEST:
            self.holds.interrupt(now_ns, reason)
            self.notice(finding.value.title)
            if finding is Finding.HOST_OVERSLEPT:
                self.holds.exclude_host_stall(now_ns, reason)
        elif supervisor.state is not State.RUNNING or self._limits.holds_per_minute == 0:
            self._trip(finding, reason)
        elif (
            self.holds.counts(finding.value.cause)
            and (count := self.holds.count_within_a_minute(now_ns) + 1) > self._limits.holds_per_minute
        ):
            text = Finding.TOO_MANY_HOLDS.value.says.format(
                count=count, limit=self._limits.holds_per_minute, what=reason
            )
            self._trip(Finding.TOO_MANY_HOLDS, text, finding.value.cause)
        else:
            supervisor.hold(finding, reason, tick=self.tick, t_ns=now_ns)
            self.holds.interrupt(now_ns, reason)
            cause = finding.value.cause.value
            self.note({"event": "hold begins", "reason": reason, "finding": finding.name.lower(), "class": cause})

    def abandon_hold(self) -> None:
        """End the run because the hold has lasted too long."""
        hold = self.holds.current
        if hold is None:
            return
        waits_for = self.holds.waits_for
        text = Finding.HOLD_TOO_LONG.value.says.format(
            what=hold.reason if waits_for == hold.reason else f"{hold.reason}; then {waits_for}",
            limit_ms=self._limits.hold_limit_ms,
        )
        self._trip(Finding.HOLD_TOO_LONG, text, hold.cause)

    def end_hold(self) -> None:
        """End the hold, because the outputs move again, and record its length."""
        hold = self.holds.end(self._clock.now_ns())
        assert hold.end_ns is not None
        self.note({"event": "hold ends", "reason": hold.reason, "length_s": (hold.end_ns - hold.t_ns) * 1e-9})

    def _trip(self, finding: Finding, reason: str, cause: CauseClass | None = None) -> None:
        self._supervisor.trip(finding, reason, tick=self.tick, t_ns=self._clock.now_ns(), cause=cause)
        self.note({"event": "safe state", "reason": reason})
