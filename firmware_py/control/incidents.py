"""What went wrong or was remarkable, in one place: counted, written to the recording, made the reason of a trip."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.safety import State, Supervisor
from firmware_py.scheduler.histogram import DurationHistogram
from hal.contracts import Clock
from hal.errors import HalError


class Recorder(Protocol):
    """Where finished frames go; never blocks, counts what it drops."""

    def push(self, row: NDArray[np.float64]) -> bool: ...
    def event(self, event: dict[str, object]) -> bool: ...


@dataclass
class LoopCounts:
    """What the loop counted besides the scheduler's figures.

    ``lost``: scans known to be missing; ``unread``: scans that were due after the last one read, when the loop stopped.
    ``commands``: those that left for the amplifier; ``superseded``: ticks whose values a slow one passed over for
    newer ones. ``clipped``: ticks whose command ran into a limit (yielding is none). ``latency``: of those that left.
    ``noticed``: bench time at which something that does not end a run was first seen.
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
    """The one way from a finding to its consequence. ``tick`` is kept by the loop; ``error`` is the first hardware
    error that ended a run."""

    def __init__(self, supervisor: Supervisor, counts: LoopCounts, clock: Clock, recorder: Recorder | None) -> None:
        self._supervisor = supervisor
        self._counts = counts
        self._clock = clock
        self._recorder = recorder
        self._bad_since: dict[str, int] = {}
        self.tick = -1
        self.error: HalError | None = None

    def note(self, event: dict[str, object]) -> None:
        """Into the recording, with time and tick."""
        if self._recorder is not None:
            self._recorder.event({"t_ns": self._clock.now_ns(), "tick": self.tick, **event})

    def notice(self, what: str) -> None:
        """Something that does not end the run: when it was first seen is kept."""
        self._counts.noticed.setdefault(what, self._clock.now_ns())

    def trip(self, reason: str, *, normal: bool = False) -> None:
        """Decide for the safe state; the first reason is the one that is told."""
        if self._supervisor.trip_cause is not None:
            return
        self._supervisor.trip(reason, tick=self.tick, t_ns=self._clock.now_ns(), normal=normal)
        self.note({"event": "safe state", "reason": reason})

    def doubt(self, what: str, reason: str) -> None:
        """A reading that nothing may be moved by: ``reason`` of a trip; where nothing is armed, ``what`` is noticed."""
        if self._supervisor.state is State.SENSING_ONLY:
            self.notice(what)
        else:
            self.trip(reason)

    def trip_for(self, device: str, error: HalError) -> None:
        """Trip with the bench's name of the device in front: a port knows only its path."""
        self.trip(f"{error}" if str(error).startswith(device) else f"{device}: {error}")

    def bad_for(self, what: str, bad: bool, t_ns: int, limit_ms: float, reason: str) -> None:
        """Doubt when ``bad`` has held for ``limit_ms``."""
        if not bad:
            self._bad_since.pop(what, None)
        elif (t_ns - self._bad_since.setdefault(what, t_ns)) * 1e-6 >= limit_ms:
            self.doubt(f"{what}: beyond its limit", reason)
