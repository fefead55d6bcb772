"""Runs every attitude filter that a gyroscope drives over a whole recording in one compiled call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, new
from firmware_py.sensing.attitude import restart
from firmware_py.sensing.attitude_filter import Motion
from firmware_py.sensing.attitude_params import gyroscope_error_state
from firmware_py.sensing.fusion import ALIGN_S, Fusion, FusionConfig
from firmware_py.sensing.gyroscope_filter import GyroscopeMemory, begin_gyroscope, run_gyroscope
from firmware_py.sensing.quaternion import from_matrix
from firmware_py.sensing.triad import triad
from hal.compiled import kernel
from tools.research.attitude.quaternion_kalman import (
    QuaternionKalmanAttitude,
    QuaternionKalmanNumbers,
    begin_quaternion_kalman,
    gyroscope_quaternion_kalman,
    quaternion_kalman_step,
)


@kernel
def run_kernel(
    rate: NDArray[np.float64],
    force: NDArray[np.float64],
    field: NDArray[np.float64],
    align: int,
    params: Record,
    state: Record,
    out: NDArray[np.float64],
) -> None:
    """The quaternion filter: ``out`` (n, 4) from rate rad/s, force m/s^2, field (any unit; a row of nan: no
    conversion), all (n, 3)."""
    s, p = state[0], params[0]
    restart(s)
    motion = np.zeros(6)
    sums = np.zeros((2, 3))
    for k in range(align):
        for i in range(3):
            sums[0, i] += force[k, i]
            if np.isfinite(field[k, 0]):
                sums[1, i] += field[k, i]
    triad(sums[0], sums[1], s.matrix)
    from_matrix(s.matrix, s.quaternion)
    for i in range(3):
        s.field[i] = sums[1, i]
        s.rate[i] = rate[0, i]
    begin_quaternion_kalman(s.field, s, p)
    for k in range(len(rate)):
        for i in range(3):
            motion[i] = force[k, i]
            change = (rate[k, i] - rate[max(k - 1, 0), i]) / p.dt_s
            motion[3 + i] = change
            s.previous[i] = change
        if np.isfinite(field[k, 0]):
            s.field[:] = field[k]
        quaternion_kalman_step(Motion(motion[:3], motion[3:], True, p.dt_s), s, p)
        for i in range(4):
            out[k, i] = s.quaternion[i]


def gyroscope_attitude(
    rate: NDArray[np.float64],
    force: NDArray[np.float64],
    field: NDArray[np.float64],
    rate_hz: float,
    method: str = "error-state",
    gravity_m_s2: float = 9.81,
    setting: Record | None = None,
) -> NDArray[np.float64]:
    """(n, 4) quaternions, body to world (x magnetic north, z up), starting from TRIAD over the first 0.1 s.

    ``setting``: other numbers for the error-state filter than ``gyroscope_error_state`` (``ErrorStateParams``).
    """
    if not len(rate) == len(force) == len(field) or len(rate) < 2:
        raise ValueError(f"rate, force and field have {len(rate)}, {len(force)} and {len(field)} rows")
    if method != "error-state" and method != "quaternion-kalman":
        return Fusion(FusionConfig(method=method), rate_hz).run(rate, force, field)
    out = np.empty((len(rate), 4))
    w, f, b = (np.ascontiguousarray(a, dtype=np.float64) for a in (rate, force, field))
    align = max(1, min(len(rate), round(ALIGN_S * rate_hz)))
    if method == "error-state":
        memory = new(GyroscopeMemory)
        memory["params"]["error_state"] = gyroscope_error_state(gravity_m_s2) if setting is None else setting
        memory["params"]["align_samples"] = align
        begin_gyroscope(memory)
        run_gyroscope(memory, w, f, b, np.full(len(w), 1.0 / rate_hz), out)
        return out
    params = new(
        QuaternionKalmanNumbers,
        dt_s=1.0 / rate_hz,
        own=gyroscope_quaternion_kalman(gravity_m_s2),
    )
    state = new(QuaternionKalmanAttitude)
    run_kernel(w, f, b, align, params, state, out)
    return out
