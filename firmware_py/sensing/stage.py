"""Runs the sensing stage: raw counts -> readings -> motion -> attitude -> acceleration and displacement of the tip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import (
    ALIGNING,
    ANGULAR_ACCELERATION,
    FALLBACK,
    INVALID,
    MAGNETOMETER,
    MAGNETOMETER_FRESH,
    PARITIES,
    PARITY,
    QUATERNION,
    RATE,
    RESTARTED,
    SPECIFIC_FORCE,
    STATUS,
    TICK,
    TIP_ACCELERATION,
    TIP_DISPLACEMENT,
)
from firmware_py.records import Records, copy_record, field, new, record
from firmware_py.sensing.attitude import align, attitude_params, attitude_state, restart, step_attitude
from firmware_py.sensing.attitude_filter import AttitudeParams, AttitudeState
from firmware_py.sensing.attitude_params import quiet_point
from firmware_py.sensing.calibration import Calibration, calibrate, calibrate_magnetometer, calibration_params
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import Kinematics, kinematic_params, plausible_rate, solve_motion
from firmware_py.sensing.leave_out import leave_out
from firmware_py.sensing.numeric_kinematics import solve_guarded, solve_numeric
from firmware_py.sensing.redundant_rate import parity, parity_rows
from firmware_py.sensing.translation import (
    Translation,
    integrate_band,
    integrator_sections,
    point_force,
    tip_acceleration,
    translation_params,
)
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch
from hal.types import STANDARD_GRAVITY

GUARD = 0.1
"""Largest change of a centripetal part that the analytic solution may leave out, in units of a sample's noise."""
N_PARITIES = len(PARITIES)
LEAN_CORNER_HZ = 0.3
"""Corrections of the attitude slower than this reach the tip's gravity."""


@record
class SenseParams:
    """Holds the parameters of the stage with ``n`` axes. ``attitude`` is the record of the chosen filter."""

    calibration: Calibration = field("")
    kinematics: Kinematics = field("")
    attitude: AttitudeParams = field("")
    translation: Translation = field("")
    quiet_point: Array = field("m", 3)  # where gravity is felt with the least noise
    lean_sections: Array = field("1", 2, 5)
    max_gap_ticks: float = field("1")
    numeric: int = field("1")  # kinematics: 1 numeric, 0 analytic
    guard_m_s2: float = field("m/s^2")  # largest change of a centripetal part for the analytic kinematics; inf: any
    parities: int = field("1")
    null: Array = field("s^2/m", N_PARITIES, "n")  # combinations of readings free of f and alpha; zeros beyond N - 6


@record
class SenseState:
    """Holds the state of the stage with ``n`` axes. ``attitude`` is the record of the chosen filter."""

    attitude: AttitudeState = field("")
    smoothed: Array = field("V, degC", 2)  # supply, temperature
    readings: Array = field("m/s^2", "n")
    motion: Array = field("m/s^2, rad/s^2", 6)  # specific force and angular acceleration of the origin
    memory: Array = field("m", 3, 2, 2)  # band integrator
    lean: Array = field("rad", 3, 2, 2)  # the same for the attitude's corrections
    turned: Array = field("rad", 3)  # correction of the last tick
    last_tick: float = field("1")
    fallbacks: int = field("1")  # ticks that the chosen kinematics left to the other one


def sense_params(config: SensingConfig) -> Records[SenseParams]:
    """Return all parameters of the stage."""
    places, axes, n = config.axis_positions(), np.array(config.axes), len(config.channels)
    # rms of a sample behind the RC: density times the root of its noise bandwidth, a quarter of the corner in rad/s
    noise = 1e-6 * STANDARD_GRAVITY * np.array(config.noise_ug_per_rtHz) * (0.25 * config.cutoff_rad_s) ** 0.5
    null = np.zeros((len(PARITIES), n))
    null[: n - 6] = parity_rows(places, axes, noise)
    return new(
        SenseParams,
        parities=n - 6,
        null=null,
        calibration=calibration_params(config),
        kinematics=kinematic_params(places, axes, np.array(config.noise_ug_per_rtHz)),
        attitude=attitude_params(config),
        translation=translation_params(config),
        quiet_point=quiet_point(config)[0],
        lean_sections=integrator_sections(config.tick_hz, LEAN_CORNER_HZ),
        max_gap_ticks=float(config.max_gap_ticks),
        numeric=config.kinematics_method == "numeric",
        guard_m_s2=GUARD * float(noise.min()) if config.kinematics_guard else np.inf,
    )


def sense_state(config: SensingConfig) -> Records[SenseState]:
    """Return the state before the first sample."""
    n = len(config.channels)
    return new(SenseState, {"n": n}, attitude=attitude_state(config), smoothed=np.nan, last_tick=np.nan)


@kernel
def _smooth_up(state: SenseState, param: SenseParams, up: NDArray[np.float64]) -> None:
    """``up`` (3,), body frame, without what corrections of the attitude do in the tremor band.

    There the attitude shall be the double integral of alpha alone, which has the phase of the specific force. The
    corrections are one more angular acceleration; its band integral is the turn to take back.
    """
    attitude = state.attitude
    corrected = attitude.corrected
    dt = param.attitude.dt_s
    sudden, turn = scratch(3), scratch(3)
    for i in range(3):
        sudden[i] = (corrected[0, i] - state.turned[i]) / (dt * dt) + corrected[1, i] / dt - corrected[2, i]
        state.turned[i] = corrected[0, i]
    integrate_band(sudden, state.lean, param.lean_sections, turn)
    z = attitude.matrix[2]
    up[0] = z[0] + turn[1] * z[2] - turn[2] * z[1]
    up[1] = z[1] + turn[2] * z[0] - turn[0] * z[2]
    up[2] = z[2] + turn[0] * z[1] - turn[1] * z[0]


@kernel
def _redundancy(state: SenseState, param: SenseParams, frame: NDArray[np.float64]) -> None:
    """Write the parity residuals of the axes beyond six into the frame."""
    left = scratch(N_PARITIES)
    parity(state.readings, state.attitude.rate, param, left)
    for m in range(param.parities):
        frame[PARITY + m] = left[m]


@kernel
def sense_kernel(frame: NDArray[np.float64], states: Records[SenseState], params: Records[SenseParams]) -> None:
    """Fill the columns from ``volts`` to ``tip_displacement`` and add the stage's bits to ``status``.

    A sample that is not finite leaves estimates as they were and sets INVALID. After lost scans the attitude coasts
    over the gap; after more than ``max_gap_ticks``, or with an impossible rate, it aligns anew.
    """
    state = states[0]
    param = params[0]
    status = int(frame[STATUS])
    readings = state.readings
    bits = calibrate(frame, state.smoothed, param.calibration, readings)
    if bits < 0:
        frame[STATUS] = status | INVALID
        return
    status |= bits
    steps = 1
    tick = frame[TICK]
    if not np.isnan(state.last_tick):
        steps = max(1, int(tick - state.last_tick))
    state.last_tick = tick
    if steps > param.max_gap_ticks or not plausible_rate(state.attitude.rate):
        restart(state.attitude)
        state.memory[:, :, :] = 0.0
        state.lean[:, :, :] = 0.0
        state.turned[:] = 0.0
        status |= RESTARTED
        steps = 1
    fresh = frame[MAGNETOMETER_FRESH] != 0.0 and calibrate_magnetometer(frame, param.calibration)
    attitude = state.attitude
    motion = state.motion
    if param.parities > 0:
        _redundancy(state, param, frame)
    dt = steps * param.attitude.dt_s
    if attitude.aligned == 0:
        solve_motion(readings, attitude.rate, param.kinematics, motion)
    elif param.numeric == 0:
        if solve_guarded(readings, attitude.rate, dt, param.guard_m_s2, param.kinematics, motion):
            state.fallbacks += 1
            status |= FALLBACK
    elif solve_numeric(readings, attitude.rate, dt, param.kinematics, motion) < 0:
        state.fallbacks += 1
        status |= FALLBACK
    field = frame[MAGNETOMETER : MAGNETOMETER + 3]
    if attitude.aligned == 0.0:
        status |= ALIGNING
        align(attitude, param.attitude, motion, field, fresh)
    else:
        felt = scratch(6)
        point_force(motion, attitude.bias, attitude.rate, param.quiet_point, felt[:3])
        for i in range(3, 6):
            felt[i] = motion[i]
        step_attitude(attitude, param.attitude, felt, field, fresh, steps)
    tip = frame[TIP_ACCELERATION : TIP_ACCELERATION + 3]
    if status & ALIGNING:
        tip[:] = 0.0
    else:
        up = scratch(3)
        _smooth_up(state, param, up)
        tip_acceleration(motion, attitude.bias, attitude.rate, up, param.translation, tip)
    integrate_band(tip, state.memory, param.translation.sections, frame[TIP_DISPLACEMENT : TIP_DISPLACEMENT + 3])
    for i in range(3):
        frame[SPECIFIC_FORCE + i] = motion[i]
        frame[ANGULAR_ACCELERATION + i] = motion[3 + i] - attitude.bias[i]
        frame[RATE + i] = attitude.rate[i]
    for i in range(4):
        frame[QUATERNION + i] = attitude.quaternion[i]
    frame[STATUS] = status


class Sensing:
    """Holds the sensing stage with its state; ``step`` works on one frame."""

    def __init__(self, config: SensingConfig) -> None:
        self.config = config
        self.params = sense_params(config)
        self.state = sense_state(config)

    def step(self, frame: NDArray[np.float64]) -> None:
        sense_kernel(frame, self.state, self.params)

    @property
    def fallbacks(self) -> int:
        """Return the number of ticks in which the chosen kinematics could not be used and the other one stood in."""
        return int(np.ravel(self.state["fallbacks"])[0])

    def leave_out(self, axis: int, usual: NDArray[np.float64]) -> float:
        """Go on without ``axis``; see ``leave_out.leave_out``."""
        return leave_out(axis, usual, self.params, self.config)

    def reset(self) -> None:
        """Restore the state before the first sample."""
        copy_record(self.state, sense_state(self.config))
