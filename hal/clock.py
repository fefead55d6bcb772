"""Provides the clocks of a bench: the machine's monotonic clock, and exact emulated time, paced or unpaced."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Pace = Literal["paced", "virtual", "realtime"]
"""The way in which bench time passes. ``paced`` and ``virtual`` are emulated time and give the same bits; a paced
second takes a second of wall-clock time where the host can keep up. ``realtime`` is the wall clock itself."""

PACE_NS = 2_000_000
"""Emulated time between two looks at the wall clock. A page that draws 60 times a second sees no steps."""
STALL_NS = 5_000_000
"""A shorter pause of the host is not counted as a stall: a 1 kHz loop in real time survives it."""


class MonotonicClock:
    """Reads CLOCK_MONOTONIC, which all processes of one machine share."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> int:
        while True:
            wait_ns = t_ns - time.monotonic_ns()
            if wait_ns <= 0:
                return -wait_ns
            time.sleep(wait_ns * 1e-9)


class VirtualClock:
    """Time that moves only when somebody moves it.

    Callbacks registered with ``at`` run in order of time (then of registration) while the clock moves past
    them, each seeing its own due time as ``now_ns()``. That is how an emulated world runs in lockstep with
    the firmware: who waits, moves time. ``burn_ns`` models execution or bus time.
    """

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._order = 0
        self._due: list[tuple[int, int, Callable[[int], None]]] = []

    def now_ns(self) -> int:
        return self._now_ns

    def at(self, t_ns: int, callback: Callable[[int], None]) -> None:
        """Run ``callback(t_ns)`` when the clock reaches ``t_ns`` (at once on the next move if that has passed)."""
        heapq.heappush(self._due, (t_ns, self._order, callback))
        self._order += 1

    def next_event_ns(self) -> int | None:
        """Return the time at which the next callback is due, or ``None`` if none is scheduled."""
        return self._due[0][0] if self._due else None

    def advance_to(self, t_ns: int) -> None:
        """Move to ``t_ns``, running what is due on the way. A time in the past moves nothing."""
        due = self._due
        while due and due[0][0] <= t_ns:
            due_ns, _, callback = heapq.heappop(due)
            if due_ns > self._now_ns:
                self._now_ns = due_ns
            callback(due_ns)
        if t_ns > self._now_ns:
            self._now_ns = t_ns

    def burn_ns(self, dt_ns: int) -> None:
        """Let ``dt_ns`` pass, as if something had taken that long."""
        self.advance_to(self._now_ns + dt_ns)

    def sleep_until_ns(self, t_ns: int) -> int:
        late_ns = max(0, self._now_ns - t_ns)
        self.advance_to(t_ns)
        return late_ns


@dataclass(frozen=True)
class PaceReport:
    """Holds the emulated and wall-clock seconds of a paced clock, and the number and the longest of its stalls.

    A stall is a pause of at least ``STALL_NS`` in which the host did not run this thread."""

    emulated_s: float
    wall_s: float
    stalls: int
    longest_stall_ms: float


class PacedClock(VirtualClock):
    """Virtual time that passes no faster than the wall clock.

    Callbacks run in the same order and see the same times as under ``VirtualClock``: this clock only sleeps after it
    has moved. When the host stands still, emulated time stands still with it, and the lost time is not made up for.
    The keyword arguments are the host's clock, sleep and thread time, for tests.
    """

    def __init__(
        self,
        start_ns: int = 0,
        *,
        wall_ns: Callable[[], int] = time.monotonic_ns,
        sleep_s: Callable[[float], None] = time.sleep,
        cpu_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        super().__init__(start_ns)
        self._wall_ns, self._sleep_s, self._cpu_ns = wall_ns, sleep_s, cpu_ns
        self.begin()

    def begin(self) -> None:
        """Pace from here on, and forget what was counted before: opening a bench is not part of its run."""
        self._stalls = self._longest_ns = 0
        self._begin_ns = self._now_ns
        self._begin_wall_ns = self._last_wall_ns = self._wall_ns()
        self._last_cpu_ns = self._cpu_ns()
        self._ahead_ns = self._now_ns - self._begin_wall_ns  # emulated time minus wall time while on pace
        self._look_ns = self._now_ns + PACE_NS

    def advance_to(self, t_ns: int) -> None:
        super().advance_to(t_ns)
        if self._now_ns >= self._look_ns:
            self._keep_pace()

    def report(self) -> PaceReport:
        """Return the figures since ``begin``."""
        emulated_ns, wall_ns = self._now_ns - self._begin_ns, self._wall_ns() - self._begin_wall_ns
        return PaceReport(emulated_ns * 1e-9, wall_ns * 1e-9, self._stalls, self._longest_ns * 1e-6)

    def _keep_pace(self) -> None:
        wall_ns, cpu_ns = self._wall_ns(), self._cpu_ns()
        self._note_pause(wall_ns - self._last_wall_ns - (cpu_ns - self._last_cpu_ns))
        due_ns = self._now_ns - self._ahead_ns
        if due_ns > wall_ns:
            self._sleep_s((due_ns - wall_ns) * 1e-9)
            wall_ns = self._wall_ns()
            self._note_pause(wall_ns - due_ns)
        if wall_ns - due_ns > PACE_NS:
            self._ahead_ns = self._now_ns - wall_ns
        self._last_wall_ns, self._last_cpu_ns = wall_ns, self._cpu_ns()
        self._look_ns = self._now_ns + PACE_NS

    def _note_pause(self, pause_ns: int) -> None:
        if pause_ns >= STALL_NS:
            self._stalls += 1
            self._longest_ns = max(self._longest_ns, pause_ns)
