"""Attitude without gyroscopes: angular acceleration integrated twice, held by gravity and the magnetic field.

A third-order observer (attitude, rate, bias of the angular acceleration) with its three poles at one
frequency, about the tool axis a higher one: there the placement (Ang 2004 (2.54)) makes angular acceleration eight
times as noisy. The accelerations of the hand enter the gravity reference, so the corner sits far below the tremor
band and the error passes a further low-pass: in the tremor band attitude is the double integral of alpha
alone, behind the same RC filter as the specific force, so that the tilt part of gravity cancels with the right
phase (it equals a lever of g / omega^2 = 2.5 mm at 10 Hz). The corner starts high and falls as 1/t, which
shortens the start the way a Kalman gain would.

Without a magnetometer the last known field stays where it was in the body: heading is then held on average,
which keeps the rate about the vertical bounded.
"""

from __future__ import annotations

from math import asin, atan2, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, new_record
from firmware_py.sensing.attitude_params import (
    ERROR_STATE_METHOD,
    METHODS,
    OBSERVER,
    error_state_params,
    quaternion_kalman_params,
)
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.error_state import error_state_step, start_errors
from firmware_py.sensing.error_state_records import ERROR_STATE, ERROR_STATE_STATE
from firmware_py.sensing.quaternion import from_matrix, rotate_by, to_matrix
from firmware_py.sensing.quaternion_kalman import (
    QUATERNION_KALMAN,
    QUATERNION_KALMAN_STATE,
    quaternion_kalman_step,
    start_quaternion_kalman,
)
from firmware_py.sensing.triad import triad
from hal.compiled import kernel
from hal.scratch import scratch

# closer to the corner the low-pass would eat the observer's phase margin
LOWPASS_PER_CORNER = 6.0

ATTITUDE = np.dtype(
    [
        ("start_rad_s", "f8"),
        ("corner_rad_s", "f8", (3,)),  # about each body axis
        ("lowpass_rad_s", "f8"),
        ("align_samples", "f8"),
        ("dt_s", "f8"),
        ("method", "i8"),
        ("error_state", ERROR_STATE),
        ("quaternion_kalman", QUATERNION_KALMAN),
    ]
)
ATTITUDE_STATE = np.dtype(
    [
        ("quaternion", "f8", (4,)),
        ("matrix", "f8", (3, 3)),  # C_WB of the quaternion
        ("rate", "f8", (3,)),
        ("bias", "f8", (3,)),  # of the angular acceleration
        ("error", "f8", (3,)),  # low-passed attitude error, body frame, rad
        ("previous", "f8", (3,)),  # angular acceleration of the last tick
        ("field", "f8", (3,)),  # last magnetic field, body frame
        ("time_s", "f8"),  # since the start of alignment
        ("aligned", "i8"),
        ("samples", "f8"),
        ("sums", "f8", (3, 3)),  # force, angular acceleration and field while aligning
        ("error_state", ERROR_STATE_STATE),
        ("quaternion_kalman", QUATERNION_KALMAN_STATE),
    ]
)


def attitude_params(config: SensingConfig) -> Record:
    """The observer's numbers (dtype ``ATTITUDE``)."""
    return new_record(
        ATTITUDE,
        start_rad_s=2.0 * pi * config.attitude_start_hz,
        corner_rad_s=2.0 * pi * np.array(config.attitude_hz),
        lowpass_rad_s=2.0 * pi * config.attitude_lowpass_hz,
        align_samples=max(1.0, round(config.align_s * config.tick_hz)),
        dt_s=1.0 / config.tick_hz,
        method=METHODS[config.attitude_method],
        error_state=error_state_params(config),
        quaternion_kalman=quaternion_kalman_params(config),
    )


@kernel
def restart(state: Record) -> None:
    """Forget everything; the next samples align anew."""
    state.quaternion[:] = 0.0
    state.quaternion[0] = 1.0
    state.rate[:] = 0.0
    state.bias[:] = 0.0
    state.error[:] = 0.0
    state.previous[:] = 0.0
    state.field[:] = 0.0
    state.time_s = 0.0
    state.aligned = 0
    state.samples = 0.0
    state.sums[:, :] = 0.0
    to_matrix(state.quaternion, state.matrix)


@kernel
def align(
    state: Record,
    params: Record,
    motion: NDArray[np.float64],
    field: NDArray[np.float64],
    fresh: bool,
) -> bool:
    """Average (f, alpha) and the field; after enough samples start from TRIAD. True once started."""
    for i in range(3):
        state.sums[0, i] += motion[i]
        state.sums[1, i] += motion[3 + i]
        if fresh:
            state.sums[2, i] += field[i]
    state.samples += 1.0
    if state.samples < params.align_samples:
        return False
    found = triad(state.sums[0], state.sums[2], state.matrix)
    from_matrix(state.matrix, state.quaternion)
    for i in range(3):
        state.field[i] = state.sums[2, i] if found else state.matrix[0, i]
    for i in range(3):
        # at rest on average, so the mean angular acceleration is bias
        state.bias[i] = state.sums[1, i] / state.samples
        state.previous[i] = motion[3 + i] - state.bias[i]
    if params.method != OBSERVER:
        begin_filter(state, params, state.field)
    state.aligned = 1
    state.time_s = state.samples * params.dt_s
    return True


@kernel
def begin_filter(state: Record, params: Record, field: NDArray[np.float64]) -> None:
    """Start both Kalman filters from the aligned attitude; ``field`` (3,) body frame, summed over the alignment."""
    c = state.matrix
    up = c[2, 0] * field[0] + c[2, 1] * field[1] + c[2, 2] * field[2]
    size = sqrt(field[0] ** 2 + field[1] ** 2 + field[2] ** 2)
    dip = asin(max(-1.0, min(1.0, -up / size))) if size > 0.0 else 0.0
    start_errors(state, params.error_state, 0.0, dip)
    start_quaternion_kalman(state, params.quaternion_kalman, 0.0)


@kernel
def step_attitude(
    state: Record,
    params: Record,
    motion: NDArray[np.float64],
    field: NDArray[np.float64],
    fresh: bool,
    steps: int,
) -> None:
    """Compute one tick of the chosen method. The arguments are those of ``propagate``.

    A gyroscope drives the same filters: its samples' difference over dt stands in ``motion[3:6]``, with
    ``lead`` = 1 and no bias of alpha.
    """
    if params.method == OBSERVER:
        propagate(state, params, motion, field, fresh, steps)
        return
    dt = params.dt_s * steps
    if fresh:
        state.field[:] = field
    state.time_s += dt
    if params.method == ERROR_STATE_METHOD:
        error_state_step(state, params.error_state, motion[:3], motion[3:6], field, fresh, dt)
    else:
        quaternion_kalman_step(state, params.quaternion_kalman, motion[:3], motion[3:6], state.field, dt)


@kernel
def propagate(
    state: Record,
    params: Record,
    motion: NDArray[np.float64],
    field: NDArray[np.float64],
    fresh: bool,
    steps: int,
) -> None:
    """Compute one tick (``steps`` > 1 after lost scans): predict with alpha, correct with gravity and field.

    ``motion`` is (f, alpha); updates quaternion, rate, bias and the matrix C_WB in ``state``.
    """
    dt = params.dt_s * steps
    # --- error of the present attitude, body frame: measured up x predicted up, and heading about up
    c = state.matrix
    fx, fy, fz = motion[0], motion[1], motion[2]
    norm = sqrt(fx * fx + fy * fy + fz * fz)
    ux, uy, uz = c[2, 0], c[2, 1], c[2, 2]
    ex = (fy * uz - fz * uy) / norm
    ey = (fz * ux - fx * uz) / norm
    ez = (fx * uy - fy * ux) / norm
    if fresh:
        state.field[:] = field
    b = state.field
    north = c[0, 0] * b[0] + c[0, 1] * b[1] + c[0, 2] * b[2]
    west = c[1, 0] * b[0] + c[1, 1] * b[1] + c[1, 2] * b[2]
    heading = -atan2(west, north)
    ex += heading * ux
    ey += heading * uy
    ez += heading * uz
    state.time_s += dt
    # --- observer with three poles at -corner
    present = (ex, ey, ez)
    turn = scratch(3)
    for i in range(3):
        corner = max(params.corner_rad_s[i], min(params.start_rad_s, 3.0 / state.time_s))
        lowpass = max(params.lowpass_rad_s, LOWPASS_PER_CORNER * corner)
        state.error[i] += (1.0 - exp(-lowpass * dt)) * (present[i] - state.error[i])
        alpha = motion[3 + i] - state.bias[i]
        before = state.rate[i]
        state.rate[i] += 0.5 * (alpha + state.previous[i]) * dt + 3.0 * corner * corner * state.error[i] * dt
        state.previous[i] = alpha
        state.bias[i] -= corner * corner * corner * state.error[i] * dt
        # mean rate of the interval (erratum 42)
        turn[i] = (0.5 * (before + state.rate[i]) + 3.0 * corner * state.error[i]) * dt
    rotate_by(state.quaternion, turn[0], turn[1], turn[2])
    to_matrix(state.quaternion, state.matrix)
