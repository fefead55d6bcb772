"""The two clocks of a bench: the machine's monotonic clock, and virtual time for exact tests."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable


class MonotonicClock:
    """CLOCK_MONOTONIC: common to all processes of one machine."""

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
        """When the next callback is due, ``None`` without one."""
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
