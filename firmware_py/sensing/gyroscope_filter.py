"""Steps the error-state Kalman filter with the samples of a gyroscope, one by one and over a whole recording."""

from __future__ import annotations

import numpy as np

from firmware_py.records import Records, field, record
from firmware_py.sensing.attitude import restart
from firmware_py.sensing.attitude_filter import Motion
from firmware_py.sensing.error_state import begin_errors, error_state_step
from firmware_py.sensing.error_state_records import ErrorStateAttitude, ErrorStateNumbers
from firmware_py.sensing.quaternion import from_matrix
from firmware_py.sensing.triad import triad
from hal.arrays import Array
from hal.compiled import kernel


@record
class GyroscopeMemory:
    """The filter and one sample. ``params.align_samples``: samples whose mean is the start attitude; below 1: level."""

    state: Records[ErrorStateAttitude] = field("", 1)
    params: Records[ErrorStateNumbers] = field("", 1)
    last_rate: Array = field("rad/s", 3)
    rate: Array = field("rad/s", 3)
    force: Array = field("m/s^2", 3)
    dt_s: Array = field("s", 1)
    field: Array = field("any", 3)


@kernel
def begin_gyroscope(memory: Records[GyroscopeMemory]) -> None:
    """Forget everything; the next samples align anew."""
    m = memory[0]
    s, p = m.state[0], m.params[0]
    restart(s)
    m.last_rate[:] = np.nan
    if p.align_samples < 1.0:
        begin_errors(s.field, s, p)
        s.aligned = 1


@kernel
def step_gyroscope(memory: Records[GyroscopeMemory]) -> None:
    """Filter one sample, ``dt_s`` after the last: rate rad/s, force m/s^2, field of any unit (nan: none), body frame.

    The difference of two samples of the rate stands for the angular acceleration. Without a field the heading of the
    body's x axis is zero at the start, and only rest keeps the rate about the vertical.
    """
    m = memory[0]
    s, p = m.state[0], m.params[0]
    seen = np.isfinite(m.field[0])
    if s.aligned == 0:
        for i in range(3):
            s.sums[0, i] += m.force[i]
            if seen:
                s.sums[2, i] += m.field[i]
            s.rate[i] = m.rate[i]
        s.samples += 1.0
        if s.sums[0, 0] != 0.0 or s.sums[0, 1] != 0.0 or s.sums[0, 2] != 0.0:
            triad(s.sums[0], s.sums[2], s.matrix)
            from_matrix(s.matrix, s.quaternion)
            if s.samples >= p.align_samples:
                begin_errors(s.sums[2], s, p)
                s.aligned = 1
        for i in range(3):
            m.last_rate[i] = m.rate[i]
        return
    if not m.dt_s[0] > 0.0:
        return
    for i in range(3):
        if not np.isfinite(m.last_rate[i]):
            s.rate[i] = m.rate[i]
            m.last_rate[i] = m.rate[i]
        s.previous[i] = (m.rate[i] - m.last_rate[i]) / m.dt_s[0]
        m.last_rate[i] = m.rate[i]
        if seen:
            s.field[i] = m.field[i]
    error_state_step(Motion(m.force, s.previous, seen, m.dt_s[0]), s, p)


@kernel
def run_gyroscope(
    memory: Records[GyroscopeMemory],
    rate: Array,
    force: Array,
    field: Array,
    dt_s: Array,
    out: Array,
) -> None:
    """A recording: rate, force, field (n, 3), dt_s (n,) into the attitudes ``out`` (n, 4)."""
    m = memory[0]
    for k in range(len(rate)):
        for i in range(3):
            m.rate[i], m.force[i], m.field[i] = rate[k, i], force[k, i], field[k, i]
        m.dt_s[0] = dt_s[k]
        step_gyroscope(memory)
        for i in range(4):
            out[k, i] = m.state[0].quaternion[i]
