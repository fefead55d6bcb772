"""Estimate when scan k was taken. The device clock counts scans; the host sees them arrive late and unevenly.

The earliest arrivals carry the least transport delay, so the line through them is the device clock on the
host's time base (the idea of NTP's minimum filter). What remains is the constant minimum delay of the
transport: a scan is stamped late by that much, never early.

After a step of the clock all arrivals are off the line, most of them by the same amount; those of a busy host are late
by varying amounts. A constant increase of the transport delay cannot be distinguished from a step, and a step of a
tenth of a period cannot be distinguished from the jitter of the arrivals.
"""

from __future__ import annotations

from collections import deque

SHIFT = 0.15
"""Distance of an arrival from the line that may indicate a clock step, as a fraction of the period.

USB is polled every 125 us, so arrivals that are all off the line by this much are not explained by jitter."""
SHIFT_ARRIVALS = 12
"""Number of successive arrivals that must be off the line; it exceeds the 10 ticks after which the tasks repeat."""
SHIFT_ALIKE = 8
"""Number of those arrivals that must agree within ``SHIFT_SPREAD``."""
SHIFT_SPREAD = 0.05
"""Largest spread of agreeing arrivals above the least late one, as a fraction of the period; a busy host has more."""


class ScanTimeline:
    """Maps scan numbers to bench time: ``start + k * dt``, start and dt slowly corrected.

    Per window of scans the smallest lateness moves the start (gain 1/4) and the period (gain 1/32), which
    settles within about 20 windows for clocks that differ by 100 ppm. A whole window that is late by more
    than 3/4 of a period means scans that never came.
    """

    def __init__(self, dt_ns: float, window: int = 128) -> None:
        self.dt_ns = dt_ns
        self._window = window
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next arrival begins a new count."""
        self._next = 0
        self._arrivals = 0
        self._origin_ns = 0
        self._offset_ns = 0.0
        self._skew_ns = 0.0
        self._least_ns = 0.0
        self._in_window = 0
        self._off = deque[float](maxlen=SHIFT_ARRIVALS)  # lateness of arrivals in a row that are off the line

    @property
    def shifted(self) -> bool:
        """Return True if the last arrivals were all off the line, most of them by the same amount."""
        if len(self._off) < SHIFT_ARRIVALS:
            return False
        near_ns = min(self._off) + SHIFT_SPREAD * self.dt_ns
        return sum(late_ns <= near_ns for late_ns in self._off) >= SHIFT_ALIKE

    @property
    def next_seq(self) -> int:
        """Number that the next scan will get."""
        return self._next

    @property
    def skew_ppm(self) -> float:
        """Return the frequency error of the device clock in ppm; positive if it runs slower than the bench clock."""
        return self._skew_ns / self.dt_ns * 1e6

    def stamp(self, n: int, arrival_ns: int) -> tuple[int, int, int]:
        """``n`` scans have just arrived: their first time in ns, their first number, how many were lost before."""
        last = self._next + n - 1
        nominal_ns = last * self.dt_ns
        if self._arrivals == 0:
            self._origin_ns = arrival_ns
            self._offset_ns = -nominal_ns
        late_ns = (arrival_ns - self._origin_ns) - nominal_ns - self._offset_ns
        if self._in_window == 0 or late_ns < self._least_ns:
            self._least_ns = late_ns
        if self._arrivals < self._window and late_ns < 0.0:
            # while starting, an earlier arrival corrects the start at once
            self._offset_ns += late_ns
            self._least_ns = late_ns = 0.0
        if abs(late_ns) > SHIFT * self.dt_ns:
            self._off.append(late_ns)
        elif self._off:
            self._off.clear()
        self._arrivals += n
        self._in_window += n
        lost = 0
        if self._in_window >= self._window:
            lost = self._close_window()
        self._next += lost
        t_last_ns = self._origin_ns + int((self._next + n - 1) * self.dt_ns + self._offset_ns)
        t_last_ns = min(t_last_ns, arrival_ns)
        first_seq = self._next
        self._next += n
        self._offset_ns += n * self._skew_ns
        return t_last_ns - int((n - 1) * self.dt_ns), first_seq, lost

    def due_by(self, now_ns: int) -> int:
        """Return the number of scans that the device should have taken by ``now_ns`` and that are not stamped yet."""
        if self._arrivals == 0:
            return 0
        last_ns = self._origin_ns + (self._next - 1) * self.dt_ns + self._offset_ns
        return max(0, int((now_ns - last_ns) / self.dt_ns))

    def _close_window(self) -> int:
        least_ns = self._least_ns
        scans = self._in_window
        self._in_window = 0
        if least_ns > 0.75 * self.dt_ns:
            return round(least_ns / self.dt_ns)
        self._offset_ns += 0.25 * least_ns
        self._skew_ns += least_ns / (32.0 * scans)
        return 0
