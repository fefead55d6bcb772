"""Steps the error-state Kalman filter with the samples of a gyroscope, one by one and over a whole recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record
from firmware_py.sensing.attitude import ATTITUDE, ATTITUDE_STATE, begin_filter, restart
from firmware_py.sensing.error_state import error_state_step
from firmware_py.sensing.quaternion import from_matrix
from firmware_py.sensing.triad import triad
from hal.compiled import kernel

KALMAN_MEMORY = np.dtype(
    [
        ("state", ATTITUDE_STATE, (1,)),
        ("params", ATTITUDE, (1,)),
        ("last_rate", "f8", (3,)),
        ("rate", "f8", (3,)),
        ("force", "f8", (3,)),
        ("field", "f8", (3,)),
        ("dt_s", "f8", (1,)),
    ]
)
"""The filter and one sample. ``params.align_samples``: samples whose mean is the start attitude; below 1: level."""


@kernel
def begin_gyroscope(memory: Record) -> None:
    """Forget everything; the next samples align anew."""
    m = memory[0]
    s, p = m.state[0], m.params[0]
    restart(s)
    m.last_rate[:] = np.nan
    if p.align_samples < 1.0:
        begin_filter(s, p, s.field)
        s.aligned = 1


@kernel
def step_gyroscope(memory: Record) -> None:
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
                begin_filter(s, p, s.sums[2])
                s.aligned = 1
        m.last_rate[:] = m.rate
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
    error_state_step(s, p.error_state, m.force, s.previous, s.field, seen, m.dt_s[0])


@kernel
def run_gyroscope(
    memory: Record,
    rate: NDArray[np.float64],
    force: NDArray[np.float64],
    field: NDArray[np.float64],
    dt_s: NDArray[np.float64],
    out: NDArray[np.float64],
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
