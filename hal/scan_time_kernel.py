"""The arithmetic of ``hal.scan_time`` as a compiled kernel on a record, for Python and for compiled loops alike.

Importing this module imports numba; ``hal.scan_time`` does so only when a scan is about to start.
"""

from __future__ import annotations

from typing import Any

from hal.compiled import kernel
from hal.scan_time_state import SHIFT, SHIFT_ALIKE, SHIFT_ARRIVALS, SHIFT_SPREAD

Record = Any


@kernel
def stamp_kernel(timeline: Record, n: int, arrival_ns: int) -> tuple[int, int, int]:
    """Stamp ``n`` scans that have just arrived. Return the time of the first (ns), its number, and the scans
    lost before. ``timeline`` (1,) is of ``hal.scan_time_state.TIMELINE``.
    """
    t = timeline[0]
    nominal_ns = (t.next + n - 1) * t.dt_ns
    if t.arrivals == 0:
        t.origin_ns = arrival_ns
        t.offset_ns = -nominal_ns
    late_ns = (arrival_ns - t.origin_ns) - nominal_ns - t.offset_ns
    if t.in_window == 0 or late_ns < t.least_ns:
        t.least_ns = late_ns
    if t.arrivals < t.window and late_ns < 0.0:
        # while starting, an earlier arrival corrects the start at once
        t.offset_ns += late_ns
        late_ns = 0.0
        t.least_ns = 0.0
    if abs(late_ns) > SHIFT * t.dt_ns:
        t.off_ns[t.off % SHIFT_ARRIVALS] = late_ns
        t.off += 1
    else:
        t.off = 0
    t.arrivals += n
    t.in_window += n
    lost = 0
    if t.in_window >= t.window:
        lost = _close_window(timeline)
    t.next += lost
    t_last_ns = min(t.origin_ns + int((t.next + n - 1) * t.dt_ns + t.offset_ns), arrival_ns)
    first = t.next
    t.next += n
    t.offset_ns += n * t.skew_ns
    return t_last_ns - int((n - 1) * t.dt_ns), first, lost


@kernel
def _close_window(timeline: Record) -> int:
    t = timeline[0]
    scans = t.in_window
    t.in_window = 0
    if t.least_ns > 0.75 * t.dt_ns:
        return round(t.least_ns / t.dt_ns)
    t.offset_ns += 0.25 * t.least_ns
    t.skew_ns += t.least_ns / (32.0 * scans)
    return 0


@kernel
def shifted_kernel(timeline: Record) -> bool:
    """Return True if the last arrivals were all off the line, most of them by the same amount."""
    t = timeline[0]
    if t.off < SHIFT_ARRIVALS:
        return False
    least_ns = t.off_ns[0]
    for i in range(1, SHIFT_ARRIVALS):
        least_ns = min(least_ns, t.off_ns[i])
    alike = 0
    for i in range(SHIFT_ARRIVALS):
        alike += t.off_ns[i] <= least_ns + SHIFT_SPREAD * t.dt_ns
    return alike >= SHIFT_ALIKE
