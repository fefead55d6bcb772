"""Holds what every part of a running instrument uses: clock, limits, counters, supervisor, recorder and page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.guardian.lifecycle import GuardianLifecycle
from firmware_py.live.link import LiveLink
from firmware_py.run.findings import Finding
from firmware_py.run.host_gaps import HostGaps
from firmware_py.run.incidents import Incidents, LoopCounts, Recorder
from firmware_py.run.safety import SafetyLimits, State, Supervisor, ramp_ticks_at
from firmware_py.run.signals import Signals
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.ticker import Ticks
from hal.contracts import AnalogOutput, Clock
from hal.errors import HalError

StatusSink = Callable[[dict[str, Any]], None]


@dataclass(eq=False)
class Run:
    """Holds one run. The instrument and the loop share it; the loop fills the fields that are not arguments.

    ``period_ns`` is the tick period. ``output`` moves the actuators, ``None`` for an instrument without outputs;
    ``guardian`` looks after its guardian process. ``limits`` are ``[firmware.safety]`` of the bench file.
    ``on_status`` gets a small dict now and then and must not block. ``sense_only``: nothing is armed, and a reading
    that would end a run is only noticed. ``other_stall_ms(now_ns, within_ms)`` returns for how long another process of
    this host, which emulates devices, has stood still (ms), 0 if it has not. ``allows_host_stalls``: holds that pauses
    of this host cause do not count towards ``holds_per_minute``, because no device is real.
    """

    clock: Clock
    period_ns: int
    output: AnalogOutput | None = None
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    recorder: Recorder | None = None
    live: LiveLink | None = None
    on_status: StatusSink | None = None
    guardian: GuardianLifecycle | None = None
    sense_only: bool = False
    other_stall_ms: Callable[[int, float], float] | None = None
    allows_host_stalls: bool = False

    counts: LoopCounts = field(init=False, default_factory=LoopCounts)
    signals: Signals = field(init=False, default_factory=Signals)
    supervisor: Supervisor = field(init=False)
    incidents: Incidents = field(init=False)
    host_gaps: HostGaps = field(init=False)
    scheduler: Scheduler = field(init=False)
    ticks: Ticks | None = field(init=False, default=None)
    """The ticks under way: number, due time and distance (bench time, ns) of the scans that have arrived."""
    started_ns: int = field(init=False, default=0)
    """Bench time (ns) at which a recording's time begins."""
    end_ns: int | None = field(init=False, default=None)
    """Bench time at which the run has lasted as long as it was asked to; ``None`` before it is armed."""
    armed_ns: int | None = field(init=False, default=None)
    """Bench time of the first arming; ``None`` before it, and in a run that arms nothing."""
    asked_safe_ns: int | None = field(init=False, default=None)
    """Bench time at which the page asked for the safe state."""
    safe_reached_ns: int | None = field(init=False, default=None)
    """Bench time at which the ramp to the safe state reached neutral; ``None`` when it has not."""
    ramp_given_up: bool = field(init=False, default=False)
    """True once the operator has interrupted a ramp that is retried."""

    def __post_init__(self) -> None:
        self.supervisor = Supervisor(self.output, ramp_ticks_at(self.period_ns))
        self.incidents = Incidents(
            self.supervisor,
            self.counts,
            self.clock,
            self.recorder,
            self.limits,
            allows_host_stalls=self.allows_host_stalls,
        )
        self.host_gaps = HostGaps(self.limits.stale_ms)

    def publish(self, frame: NDArray[np.float64]) -> None:
        """Hand a finished frame to the page and to the recorder, where there are any."""
        if self.live is not None:
            self.live.publish(frame)
        if self.recorder is not None:
            self.recorder.push(frame)

    def host_stalled_ms(self) -> float:
        """Return how long (ms) this loop or another process of this host has just stood still, 0 if neither has."""
        now_ns, within_ms = self.clock.now_ns(), 2.0 * self.limits.stale_ms
        others_ms = self.other_stall_ms(now_ns, within_ms) if self.other_stall_ms is not None else 0.0
        return max(self.host_gaps.recent_ms(now_ns, within_ms), others_ms)

    def check_guardian(self) -> None:
        """Report a guardian that is lost, so that the outputs do not move without a process that would take them to
        neutral if this one died."""
        if self.guardian is not None and self.supervisor.is_active and (why := self.guardian.check()):
            self.incidents.report(Finding.GUARDIAN_LOST, what=why)

    def restore_guardian(self) -> None:
        """Replace a guardian that is lost; called once per pass of the loop while the outputs rest at neutral."""
        if self.guardian is None:
            return
        now_ns = self.clock.now_ns()
        try:
            if waits_for := self.guardian.restore(now_ns):
                self.incidents.holds.wait_for(now_ns, waits_for)
        except HalError as error:
            self.incidents.report(Finding.GUARDIAN_FAILED, error=error)

    def step_ramp(self) -> None:
        """Run one step of the outputs' ramp to neutral, and note the bench time at which neutral is reached. The task
        that actuates calls this in every tick; ``finish_ramp`` does once the ticks have ended."""
        supervisor = self.supervisor
        was_holding = supervisor.is_holding
        if supervisor.step(may_retry=self._may_retry()) and self.safe_reached_ns is None:
            self.safe_reached_ns = self.clock.now_ns()
        trip = supervisor.trip_cause
        if supervisor.state is State.HOLD and supervisor.holds[-1].neutral_ns is None:
            supervisor.holds[-1].neutral_ns = self.clock.now_ns()
        if was_holding and trip is not None:
            self.incidents.note({"event": "safe state", "reason": trip.reason})

    def _may_retry(self) -> bool:
        """Return True while a failing ramp is retried: for ``neutral_retry_s``, unless the operator interrupts it."""
        trip = self.supervisor.trip_cause
        since_ns = 0 if trip is None else self.clock.now_ns() - trip.t_ns
        return not self.ramp_given_up and since_ns < self.limits.neutral_retry_s * 1e9
