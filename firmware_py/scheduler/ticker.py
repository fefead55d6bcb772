"""Delivers ticks from the DAQ's scans or, while no scans come, from the host clock. All times are on the bench clock.

For scans that arrived late in one block, the ``catch_up`` tasks run for every scan, so that filters
see all data; everything else runs once, for the newest. See ``Scheduler.run``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from hal.contracts import Clock
from hal.types import ScanBlock, TimeSource

ROUNDING_NS = 1000
"""Time by which a timeout may end early, because it is given in float seconds."""


class Ticks(NamedTuple):
    """Holds ``n`` >= 1 consecutive ticks that are due now, ``dt_ns`` apart; ``k0`` is the first, due at ``due_ns``.

    Both times are bench time (ns), also with ``source`` DEVICE_CLOCK: the device's clock numbers the scans, and
    ``hal.scan_time`` maps the numbers to bench time. ``source`` HOST means that no scan came with the ticks.
    """

    k0: int
    n: int
    due_ns: int
    dt_ns: int
    source: TimeSource


class Ticker(Protocol):
    """Defines a time base: ``wait`` returns when at least one tick is due. Tick numbers grow; a gap is a skip."""

    def wait(self) -> Ticks: ...


class HostTicker:
    """Delivers ticks at ``t0_ns + k * period_ns`` of the host clock. When whole periods have passed, the newest due
    tick is delivered and the others are skipped: the phase is kept and nothing is made up for."""

    def __init__(self, clock: Clock, period_ns: int, t0_ns: int, k0: int = 0) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self._t0_ns = t0_ns  # when tick 0 is due, whatever the first tick is
        self._next = k0

    def wait(self) -> Ticks:
        """Sleep until the next tick is due, and return it; return at once when it is due already."""
        self._clock.sleep_until_ns(self._t0_ns + self._next * self._period_ns)
        newest = (self._clock.now_ns() - self._t0_ns) // self._period_ns
        self._next = newest + 1
        return Ticks(newest, 1, self._t0_ns + newest * self._period_ns, self._period_ns, TimeSource.HOST)


def silent_at_ns(last_due_ns: int, patience_ns: int, now_ns: int) -> int:
    """Return the time (bench clock, ns) at which a device counts as silent whose last scan was due at ``last_due_ns``.
    A host that itself did not run for longer than ``patience_ns`` waits for that long from ``now_ns`` on. A compiled
    loop runs the same function."""
    return (last_due_ns if last_due_ns + patience_ns > now_ns else now_ns) + patience_ns


class ScanTicker:
    """Delivers the scans of a device as ticks: tick number = its sequence number, counted from the first scan.

    ``read(timeout_s)`` fills the owner's buffer and returns the block (row i of the buffer belongs to tick
    ``k0 + i``). When no scan has come for ``silent_after_ns``, ticks come from the host clock, one per
    period and numbered on, so that supervision goes on; scans that arrive afterwards for numbers already used
    are numbered on as well (``rebased`` counts that) and carry their own sequence number in the data.
    """

    def __init__(self, read: Callable[[float], ScanBlock], clock: Clock, period_ns: int, silent_after_ns: int) -> None:
        self._read = read
        self._clock = clock
        self._period_ns = period_ns
        self._silent_after_ns = silent_after_ns
        self._last_k = -1
        self._last_due_ns: int | None = None
        self._seq_of_tick0: int | None = None
        self._silent = False
        self.silent_at_ns: int | None = None
        """Replaces the limit of the next ``wait``: a compiled loop has waited for the device already."""
        self.host_ticks = 0
        self.rebased = 0

    def wait(self) -> Ticks:
        """Return the next block of scans, or a host tick when the device stays silent. Errors of ``read`` propagate."""
        if self._last_due_ns is None:
            self._last_due_ns = self._clock.now_ns()
        patience_ns = self._period_ns if self._silent else self._silent_after_ns
        given_ns, self.silent_at_ns = self.silent_at_ns, None
        limit_ns = given_ns or silent_at_ns(self._last_due_ns, patience_ns, self._clock.now_ns())
        while True:
            left_ns = limit_ns - self._clock.now_ns()
            block = self._read(max(0, left_ns) * 1e-9)
            if block.n:
                return self._scans(block)
            if self._clock.now_ns() + ROUNDING_NS >= limit_ns:
                return self._host_tick(self._last_due_ns)

    def poll(self) -> Ticks | None:
        """Return the block of scans that has come, ``None`` if there is none. Errors of ``read`` propagate."""
        block = self._read(0.0)
        return self._scans(block) if block.n else None

    @property
    def place(self) -> tuple[int, int, int] | None:
        """Return the sequence number of tick 0, the last tick and its due time (ns), for a compiled loop to go on from;
        None while no scans come."""
        if self._seq_of_tick0 is None or self._last_due_ns is None or self._silent:
            return None
        return self._seq_of_tick0, self._last_k, self._last_due_ns

    def go_on_from(self, last_k: int, last_due_ns: int) -> None:
        """Note that a compiled loop has run the ticks up to ``last_k``."""
        self._last_k, self._last_due_ns = last_k, last_due_ns

    def tick_without_scan(self) -> Ticks:
        """Return a host tick now, because reading failed and supervision goes on without waiting."""
        now_ns = self._clock.now_ns()
        return self._host_tick(now_ns - self._period_ns if self._last_due_ns is None else self._last_due_ns)

    def _scans(self, block: ScanBlock) -> Ticks:
        if self._seq_of_tick0 is None:
            self._seq_of_tick0 = block.seq0 - (self._last_k + 1)
        k0 = block.seq0 - self._seq_of_tick0
        if k0 <= self._last_k:
            self._seq_of_tick0 = block.seq0 - (self._last_k + 1)
            self.rebased += 1
            k0 = self._last_k + 1
        self._last_k = k0 + block.n - 1
        self._last_due_ns = block.t0_ns + (block.n - 1) * block.dt_ns
        self._silent = False
        return Ticks(k0, block.n, block.t0_ns, block.dt_ns, block.source)

    def _host_tick(self, last_due_ns: int) -> Ticks:
        periods = max(1, (self._clock.now_ns() + ROUNDING_NS - last_due_ns) // self._period_ns)
        self._last_k += periods
        self._last_due_ns = last_due_ns + periods * self._period_ns
        self._silent = True
        self.host_ticks += 1
        return Ticks(self._last_k, 1, self._last_due_ns, self._period_ns, TimeSource.HOST)
