"""Observes the attitude with three poles at one frequency, about the tool axis a higher one.

There the placement (Ang 2004 (2.54)) makes angular acceleration eight times as noisy. The accelerations of the hand
enter the gravity reference, so the corner sits far below the tremor band and the error passes a further low-pass: in
the tremor band attitude is the double integral of alpha alone, behind the same RC filter as the specific force, so that
the tilt part of gravity cancels with the right phase (it equals a lever of g / omega^2 = 2.5 mm at 10 Hz). The corner
starts high and falls as 1/t, which shortens the start the way a Kalman gain would.

Without a magnetometer the last known field stays where it was in the body: heading is then held on average, which keeps
the rate about the vertical bounded.
"""

from __future__ import annotations

from math import atan2, exp, pi, sqrt

import numpy as np

from firmware_py.records import Records, field, new, record
from firmware_py.sensing.attitude_filter import AttitudeFilter, AttitudeParams, AttitudeState, Motion, OwnEntries
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.quaternion import rotate_by, to_matrix
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch

# closer to the corner the low-pass would eat the observer's phase margin
LOWPASS_PER_CORNER = 6.0


@record
class ObserverParams(OwnEntries):
    """Corners of the observer; ``corner_rad_s`` about each body axis."""

    start_rad_s: float = field("rad/s")
    corner_rad_s: Array = field("rad/s", 3)
    lowpass_rad_s: float = field("rad/s")


@record
class ObserverState:
    """The observer's memory."""

    error: Array = field("rad", 3)  # low-passed attitude error, body frame


@record
class ObservedAttitude(AttitudeState):
    """The attitude's state with the observer's."""

    own: ObserverState = field("")


@record
class ObserverNumbers(AttitudeParams):
    """The attitude's parameters with the observer's."""

    own: ObserverParams = field("")


def _params(config: SensingConfig) -> Records[ObserverParams]:
    """Return the observer's numbers."""
    return new(
        ObserverParams,
        start_rad_s=2.0 * pi * config.attitude_start_hz,
        corner_rad_s=2.0 * pi * np.array(config.attitude_hz),
        lowpass_rad_s=2.0 * pi * config.attitude_lowpass_hz,
    )


@kernel
def begin_observer(north: Array, state: ObservedAttitude, params: ObserverNumbers) -> None:
    """Start without an error."""
    for i in range(3):
        state.own.error[i] = 0.0


@kernel
def step_observer(motion: Motion, state: ObservedAttitude, params: ObserverNumbers) -> None:
    """Predict with alpha, correct with gravity and field."""
    own, numbers, dt = state.own, params.own, motion.dt_s
    # --- error of the present attitude, body frame: measured up x predicted up, and heading about up
    c = state.matrix
    fx, fy, fz = motion.force[0], motion.force[1], motion.force[2]
    norm = sqrt(fx * fx + fy * fy + fz * fz)
    ux, uy, uz = c[2, 0], c[2, 1], c[2, 2]
    ex = (fy * uz - fz * uy) / norm
    ey = (fz * ux - fx * uz) / norm
    ez = (fx * uy - fy * ux) / norm
    b = state.field
    north = c[0, 0] * b[0] + c[0, 1] * b[1] + c[0, 2] * b[2]
    west = c[1, 0] * b[0] + c[1, 1] * b[1] + c[1, 2] * b[2]
    heading = -atan2(west, north)
    ex += heading * ux
    ey += heading * uy
    ez += heading * uz
    # --- observer with three poles at -corner
    present = (ex, ey, ez)
    turn = scratch(3)
    for i in range(3):
        corner = max(numbers.corner_rad_s[i], min(numbers.start_rad_s, 3.0 / state.time_s))
        lowpass = max(numbers.lowpass_rad_s, LOWPASS_PER_CORNER * corner)
        own.error[i] += (1.0 - exp(-lowpass * dt)) * (present[i] - own.error[i])
        alpha = motion.alpha[i] - state.bias[i]
        before = state.rate[i]
        state.rate[i] += 0.5 * (alpha + state.previous[i]) * dt + 3.0 * corner * corner * own.error[i] * dt
        state.previous[i] = alpha
        state.bias[i] -= corner * corner * corner * own.error[i] * dt
        # mean rate of the interval (erratum 42)
        turn[i] = (0.5 * (before + state.rate[i]) + 3.0 * corner * own.error[i]) * dt
    rotate_by(state.quaternion, turn[0], turn[1], turn[2])
    to_matrix(state.quaternion, state.matrix)


FILTER = AttitudeFilter(ObserverNumbers, ObservedAttitude, _params, begin_observer, step_observer)
