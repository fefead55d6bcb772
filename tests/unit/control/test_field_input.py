"""Readings of the magnetometer out of line with their neighbours: a flipped bit is noticed, a slow turn is not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from firmware_py.control.field_input import FieldInput
from firmware_py.scheduler.task import TickInfo
from tests.unit.control.stand import StandRun

OUTLIER_V = 0.01
CURVATURE_V_PER_S2 = 80.0  # second difference 8 mV at 10 ms


class Magnetometer:
    name = "mag"

    def __init__(self, interval_ns: int, broken: int) -> None:
        self.volts, self.t_ns = np.zeros(3), 0
        self._interval_ns, self._broken, self._n = interval_ns, broken, 0

    def poll(self) -> bool:
        self._n += 1
        self.t_ns = self._n * self._interval_ns
        t_s = self.t_ns * 1e-9
        self.volts[:] = 2.5 + np.array([0.1, 0.2, 0.3]) + 0.5 * CURVATURE_V_PER_S2 * t_s**2
        if self._n == self._broken:
            self.volts[1] += 2.0
        return True


@pytest.mark.parametrize("interval_ms", [8, 10, 40, 80])
@pytest.mark.parametrize("broken", [0, 6])
def test_what_is_out_of_line_depends_on_the_time_between_readings(interval_ms: int, broken: int):
    run = StandRun()
    magnetometer: Any = Magnetometer(interval_ms * 1_000_000, broken)
    field = FieldInput(magnetometer, run, OUTLIER_V)
    for k in range(10):
        field.poll(TickInfo(k, 0, 0, 0))
    assert bool(run.counts.noticed) == bool(broken)
