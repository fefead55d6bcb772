"""Polls the magnetometer one channel at a time, and hands a reading to sensing when all three axes are fresh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.hmc2003 import Hmc2003
from firmware_py.control.fresh_field import fill_field
from firmware_py.run.context import Run
from firmware_py.run.findings import Finding
from firmware_py.scheduler.task import TickInfo
from hal.errors import HalError

USUAL_NS = 11_000_000
"""Time between readings for which ``outlier_V`` is meant, with some reserve."""


class FieldInput:
    """Polls the magnetometer and checks its readings.

    The outputs hold after a field that was missing or stood still for ``magnetometer_ms``. ``outlier_V``: a second
    difference of an axis' readings beyond it is noticed; a hand turns and trembles too slowly for it.
    """

    def __init__(self, magnetometer: Hmc2003, run: Run, outlier_V: float) -> None:
        self._magnetometer = magnetometer
        self._incidents = run.incidents
        self._counts = run.counts
        self._limit_ms = run.limits.magnetometer_ms
        self._outlier_V = outlier_V
        self.volts, self.fresh = np.zeros(3), np.zeros(1, np.int64)
        """Hold the newest reading, and 1 in ``fresh`` until it has been taken."""
        self._before, self._slope = np.full(3, np.nan), np.full(3, np.nan)
        self._before_ns = 0
        self._hangs = False

    def fill(self, frame: NDArray[np.float64]) -> None:
        """Write a fresh reading into the frame's columns, once per reading, and mark whether there was one."""
        fill_field(frame, self.volts, self.fresh)

    def poll(self, info: TickInfo) -> None:
        """Run the magnetometer's task: one transfer on the bus, and the checks of a completed reading."""
        magnetometer, incidents = self._magnetometer, self._incidents
        try:
            if magnetometer.poll():
                volts = magnetometer.volts
                # three axes never read the same value twice; a converter that hangs repeats its last one for all
                hangs = bool(volts[0] == volts[1] == volts[2])
                if hangs and self._hangs:
                    incidents.notice("magnetometer's converter hangs")
                self._hangs = hangs
                self._look_for_outliers(volts, magnetometer.t_ns)
                self.volts[:] = volts
                self.fresh[0] = not hangs
            incidents.report_after(Finding.MAGNETOMETER_SILENT, False, info.due_ns, self._limit_ms, error="")
            incidents.report_after(
                Finding.MAGNETOMETER_HANGS, self._hangs, info.due_ns, self._limit_ms, device=magnetometer.name
            )
        except HalError as error:
            self._counts.magnetometer_errors += 1
            incidents.notice("magnetometer does not answer")
            incidents.report_after(Finding.MAGNETOMETER_SILENT, True, info.due_ns, self._limit_ms, error=error)

    def _look_for_outliers(self, volts: NDArray[np.float64], t_ns: int) -> None:
        """Notice a reading out of line with its neighbours: the I2C bus has no checksum, so a flipped bit looks like
        that. The second difference of a turn grows with the square of the time between readings, and so does the
        limit."""
        slope = volts - self._before
        allowed_V = self._outlier_V * max(1.0, ((t_ns - self._before_ns) / USUAL_NS) ** 2)
        self._before_ns = t_ns
        if np.any(np.abs(slope - self._slope) > allowed_V):  # never true for the first two: NaN
            self._incidents.notice(f"{self._magnetometer.name} read a value out of line with its neighbours")
        self._slope, self._before = slope, volts.copy()
