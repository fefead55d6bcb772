"""Estimate when scan k was taken. The device clock counts scans; the host sees them arrive late and unevenly.

The earliest arrivals carry the least transport delay, so the line through them is the device clock on the
host's time base (the idea of NTP's minimum filter). What remains is the constant minimum delay of the
transport: a scan is stamped late by that much, never early.

After a step of the clock all arrivals are off the line, most of them by the same amount; those of a busy host are late
by varying amounts. A constant increase of the transport delay cannot be distinguished from a step, and a step of a
tenth of a period cannot be distinguished from the jitter of the arrivals.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.scan_time_state import TIMELINE


class ScanTimeline:
    """Maps scan numbers to bench time: ``start + k * dt``, start and dt slowly corrected.

    Per window of scans the smallest lateness moves the start (gain 1/4) and the period (gain 1/32), which
    settles within about 20 windows for clocks that differ by 100 ppm. A whole window that is late by more
    than 3/4 of a period means scans that never came.
    ``state`` (1,) of ``TIMELINE``: memory to use, for a driver whose kernels stamp scans themselves.
    """

    def __init__(self, dt_ns: float, window: int = 128, state: Any = None) -> None:
        self.state = np.zeros(1, TIMELINE) if state is None else state
        self.dt_ns = dt_ns
        self._window = window
        self._loaded: Any = None
        self.restart()

    def warm_up(self) -> None:
        """Load or compile the kernels, which the first stamp of a run must not wait for. The state does not change."""
        from hal import scan_time_kernel  # numba: seconds, which a command that never scans does not pay

        self._loaded = scan_time_kernel
        before = self.state.copy()
        scan_time_kernel.stamp_kernel(self.state, 1, 0)
        scan_time_kernel.shifted_kernel(self.state)
        self.state[:] = before

    @property
    def _kernels(self) -> Any:
        if self._loaded is None:
            self.warm_up()
        return self._loaded

    def restart(self) -> None:
        """Forget everything: the next arrival begins a new count."""
        self.state[:] = np.zeros(1, TIMELINE)
        self.state["dt_ns"], self.state["window"] = self.dt_ns, self._window

    @property
    def shifted(self) -> bool:
        """Return True if the last arrivals were all off the line, most of them by the same amount."""
        return bool(self._kernels.shifted_kernel(self.state))

    @property
    def next_seq(self) -> int:
        """Number that the next scan will get."""
        return int(self.state["next"][0])

    def stamp(self, n: int, arrival_ns: int) -> tuple[int, int, int]:
        """``n`` scans have just arrived: their first time in ns, their first number, how many were lost before."""
        return self._kernels.stamp_kernel(self.state, n, arrival_ns)

    def due_by(self, now_ns: int) -> int:
        """Return the number of scans that the device should have taken by ``now_ns`` and that are not stamped yet."""
        state = self.state[0]
        if state["arrivals"] == 0:
            return 0
        last_ns = int(state["origin_ns"]) + (int(state["next"]) - 1) * self.dt_ns + float(state["offset_ns"])
        return max(0, int((now_ns - last_ns) / self.dt_ns))
