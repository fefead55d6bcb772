"""Estimates attitude, rate and velocity by a multiplicative error-state Kalman filter, for any source of alpha.

The rate comes as angular acceleration alpha: solved from accelerometers, or the difference of a gyroscope's samples
(the error of the rate is then the gyroscope's bias). Errors, world frame unless said: turn theta (3,), rate (3, body),
bias of alpha (3, body), velocity (3,), heading of the magnetic disturbance m:

    C = exp(theta) C^,  theta' = C d_omega,  d_omega' = -d_bias,  d_v' = theta x (C f),  m' = -m / T

Gravity is not measured as a direction: the specific force is integrated to a velocity, and what is known is that a hand
does not travel, so v = 0 with a noise density. Accelerations of the hand thereby average out before they turn the
attitude, where a direct comparison of f with gravity would follow each of them. The velocity of a tremor is far larger
than that noise but in a known band: a notch takes it out of the comparison, which lets gravity be trusted much more.
A hand that moves more than that noise says, below the tremor band, is trusted less (accelerometers only): the velocity
that is seen, its own uncertainty taken off, is the noise of the comparison, too.

The magnetic field shows the heading; its disturbance has a state of its own with time constant T. Accelerometers: a
tilt about north turns what the field shows by the tangent of the dip, and the filter knows it. Without that, an error
about a leaning axis is corrected with the wrong sign where the dip is steep, and the rate about it runs away once a
moving hand leaves the tilt to the field. Gyroscopes: the field turns the heading only, because a room's field is off
by degrees. A magnet that moves with the body is found and taken off the field (gyroscope only, ``magnet.py``). A field
whose size or dip is then off what was learned is not used. At rest (gyroscope only) the rate is measured as zero.
Accelerometers without a field to believe: the last one stays where it was in the body, which holds the heading on
average and keeps the rate about the vertical bounded.
Sequential scalar updates in Joseph form, each gated at ``gate`` standard deviations where that is said.
"""

from __future__ import annotations

from math import asin, atan2, exp, sqrt
from typing import NamedTuple

from firmware_py.sensing.attitude_filter import AttitudeFilter, Motion
from firmware_py.sensing.attitude_params import error_state_params
from firmware_py.sensing.error_state_records import (
    BIAS,
    DISTURBANCE,
    ERRORS,
    RATE,
    TURN,
    VELOCITY,
    ErrorState,
    ErrorStateAttitude,
    ErrorStateNumbers,
    ErrorStateParams,
)
from firmware_py.sensing.magnet import begin_magnet, find_magnet, heading_spread
from firmware_py.sensing.quaternion import rotate_by, to_matrix
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch

FIELD_REGAIN_S = 0.5
"""After a refused field: a body that turns near a magnet passes through attitudes where all looks well."""
SWAY_S = 0.3
"""Time constant of the mean about which a hand swings: what is slower is the filter's own error, or a movement."""
REST_SMOOTHING_S = 0.5
HELD_AFTER_S = 0.2


@kernel
def begin_errors(field: Array, state: ErrorStateAttitude, params: ErrorStateNumbers) -> None:
    """Set the covariance and the start values of a filter that has just been aligned."""
    e, numbers = state.error_state, params.error_state
    c = state.matrix
    up = c[2, 0] * field[0] + c[2, 1] * field[1] + c[2, 2] * field[2]
    size = sqrt(field[0] ** 2 + field[1] ** 2 + field[2] ** 2)
    p = e.covariance
    p[:, :] = 0.0
    variances = numbers.start_variance
    for i in range(3):
        p[TURN + i, TURN + i] = variances[0] if i < 2 else variances[1]
        p[RATE + i, RATE + i] = variances[2]
        p[BIAS + i, BIAS + i] = numbers.start_bias_variance[i]
        p[VELOCITY + i, VELOCITY + i] = variances[3]
        e.velocity[i] = 0.0
        e.notch[i, 0] = 0.0
        e.notch[i, 1] = 0.0
        e.sway[i] = 0.0
        e.swing[i] = 0.0
        e.trusted[i] = state.field[i]
        for j in range(3):
            state.corrected[i, j] = 0.0
        e.slow_rate[i] = state.rate[i]
        e.slow_force[i] = 0.0
    p[DISTURBANCE, DISTURBANCE] = numbers.disturbance_rad**2
    e.disturbance = 0.0
    e.field_size = 0.0
    e.field_dip = asin(max(-1.0, min(1.0, -up / size))) if size > 0.0 else 0.0
    e.field_wait_s = 0.0
    e.field_fresh_s = 0.0
    e.candidate_size = 0.0
    e.candidate_dip = 0.0
    e.candidate_s = 0.0
    e.still_s = 0.0
    e.rejected = 0
    e.moving_s = 0.0
    e.gated = 0
    e.regained_s = FIELD_REGAIN_S
    begin_magnet(e.magnet)


@kernel
def propagate_errors(
    e: ErrorState,
    params: ErrorStateParams,
    c: Array,
    up: Array,
    rate: Array,
    dt: float,
) -> None:
    """Propagate P <- F P F^T + Q over ``dt`` s; ``c`` = C_WB, ``up`` (3,) = C f. F is sparse, so its products are
    written out."""
    p, w = e.covariance, e.work
    fade = exp(-dt / params.disturbance_s)
    # row by row, so that the inner loops run along memory
    for k in range(3):
        ck0, ck1, ck2 = dt * c[k, 0], dt * c[k, 1], dt * c[k, 2]
        u0, u1 = dt * up[(k + 2) % 3], dt * up[(k + 1) % 3]
        first, second = (k + 1) % 3, (k + 2) % 3
        for j in range(ERRORS):
            w[TURN + k, j] = p[TURN + k, j] + (ck0 * p[RATE, j] + ck1 * p[RATE + 1, j] + ck2 * p[RATE + 2, j])
            w[RATE + k, j] = p[RATE + k, j] - dt * p[BIAS + k, j]
            w[BIAS + k, j] = p[BIAS + k, j]
            # theta x up
            w[VELOCITY + k, j] = p[VELOCITY + k, j] + (u0 * p[first, j] - u1 * p[second, j])
    for j in range(ERRORS):
        w[DISTURBANCE, j] = fade * p[DISTURBANCE, j]
    for i in range(ERRORS):
        for k in range(3):
            p[i, TURN + k] = w[i, TURN + k] + dt * (
                c[k, 0] * w[i, RATE] + c[k, 1] * w[i, RATE + 1] + c[k, 2] * w[i, RATE + 2]
            )
            p[i, RATE + k] = w[i, RATE + k] - dt * w[i, BIAS + k]
            p[i, BIAS + k] = w[i, BIAS + k]
        x, y, z = w[i, 0], w[i, 1], w[i, 2]
        p[i, VELOCITY] = w[i, VELOCITY] + dt * (y * up[2] - z * up[1])
        p[i, VELOCITY + 1] = w[i, VELOCITY + 1] + dt * (z * up[0] - x * up[2])
        p[i, VELOCITY + 2] = w[i, VELOCITY + 2] + dt * (x * up[1] - y * up[0])
        p[i, DISTURBANCE] = fade * w[i, DISTURBANCE]
        for j in range(i):  # symmetric to the last bit, whatever rounding did
            p[j, i] = p[i, j]
    spin = params.turn_per_rate * sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    for i in range(3):
        for k in range(3):
            turned = 0.0
            for n in range(3):
                turned += c[i, n] * params.turn_density[n] * c[k, n]
            p[TURN + i, TURN + k] += turned * dt
        p[TURN + i, TURN + i] += spin * dt
        p[RATE + i, RATE + i] += params.rate_density[i] * dt
        p[BIAS + i, BIAS + i] += params.bias_density[i] * dt
        p[VELOCITY + i, VELOCITY + i] += params.force_density * dt
    p[DISTURBANCE, DISTURBANCE] += params.disturbance_rad**2 * (1.0 - fade * fade)


class Measurement(NamedTuple):
    """A scalar measurement of error ``first`` (minus error ``second``, if >= 0), not used beyond ``gate`` standard
    deviations. The turn about north is in it ``lean`` times."""

    first: int
    second: int
    residual: float
    variance: float
    gate: float
    lean: float


@kernel
def correct(measured: Measurement, e: ErrorState, gain: Array) -> bool:
    """Process one measurement, in Joseph form.

    ``gain`` (ERRORS,) gathers the correction, which the caller applies with ``apply_correction``. False when the
    residual, what ``gain`` already explains taken off, is beyond the gate.
    """
    first, second, residual, variance, gate, lean = measured
    p = e.covariance
    column = scratch(ERRORS)
    for i in range(ERRORS):
        column[i] = p[first, i] + lean * p[TURN, i]
    if second >= 0:
        for i in range(ERRORS):
            column[i] -= p[second, i]
    innovation = column[first] + lean * column[TURN] + variance
    rest = residual - gain[first] - lean * gain[TURN]
    if second >= 0:
        innovation -= column[second]
        rest += gain[second]
    if rest * rest > gate * gate * innovation:
        return False
    root = 1.0 / sqrt(innovation)
    for i in range(ERRORS):
        gain[i] += column[i] * (rest / innovation)
        column[i] *= root
    # (I - k h) P (I - k h)^T + k r k^T with h P = innovation k^T: symmetric by construction
    for i in range(ERRORS):
        own = column[i]
        for j in range(ERRORS):
            p[i, j] -= own * column[j]
    return True


@kernel
def apply_correction(state: ErrorStateAttitude, x: Array) -> None:
    """Fold the estimated errors ``x`` (ERRORS,) into the state and clear them."""
    c = state.matrix
    tx = c[0, 0] * x[0] + c[1, 0] * x[1] + c[2, 0] * x[2]
    ty = c[0, 1] * x[0] + c[1, 1] * x[1] + c[2, 1] * x[2]
    tz = c[0, 2] * x[0] + c[1, 2] * x[1] + c[2, 2] * x[2]
    rotate_by(state.quaternion, tx, ty, tz)
    to_matrix(state.quaternion, state.matrix)
    e = state.error_state
    state.corrected[0, 0], state.corrected[0, 1], state.corrected[0, 2] = tx, ty, tz
    for i in range(3):
        state.corrected[1, i] = x[RATE + i]
        state.corrected[2, i] += x[BIAS + i]
        state.rate[i] += x[RATE + i]
        state.bias[i] += x[BIAS + i]
        e.velocity[i] += x[VELOCITY + i]
    e.disturbance += x[DISTURBANCE]
    e.magnet.corrected_rad += x[TURN + 2]
    for i in range(ERRORS):
        x[i] = 0.0


@kernel
def error_state_step(motion: Motion, state: ErrorStateAttitude, param: ErrorStateNumbers) -> None:
    """Run one step. The state's field counts where the motion is ``fresh``."""
    params, dt = param.error_state, motion.dt_s
    force, alpha = motion.force, motion.alpha
    e = state.error_state
    c = state.matrix
    turn = scratch(3)
    for i in range(3):
        now = alpha[i] - state.bias[i]
        before = state.rate[i]
        state.rate[i] += 0.5 * (now + state.previous[i]) * dt
        state.previous[i] = now
        turn[i] = (before + params.lead * (state.rate[i] - before)) * dt  # mean rate of the interval: erratum 42
    rotate_by(state.quaternion, turn[0], turn[1], turn[2])
    to_matrix(state.quaternion, c)
    up = scratch(3)
    for i in range(3):
        up[i] = c[i, 0] * force[0] + c[i, 1] * force[1] + c[i, 2] * force[2]
        e.velocity[i] += up[i] * dt
    e.velocity[2] -= params.gravity * dt
    e.disturbance *= exp(-dt / params.disturbance_s)
    propagate_errors(e, params, c, up, state.rate, dt)

    x = scratch(ERRORS)
    for i in range(ERRORS):
        x[i] = 0.0
    resting = params.rest_density > 0.0 and _resting(state, params, force, dt)
    gate = params.velocity_gate if params.velocity_gate > 0.0 else 1e9
    moving = False
    for i in range(3):
        seen = params.notch[0] * e.velocity[i] + e.notch[i, 0]
        e.notch[i, 0] = params.notch[1] * e.velocity[i] - params.notch[3] * seen + e.notch[i, 1]
        e.notch[i, 1] = params.notch[2] * e.velocity[i] - params.notch[4] * seen
        density = params.still_density
        if params.swing_s > 0.0:
            fast = seen - e.sway[i]
            e.sway[i] += min(1.0, dt / SWAY_S) * fast
            e.swing[i] += min(1.0, dt / params.swing_mean_s) * (fast * fast - e.swing[i])
            density += params.swing_s * max(0.0, e.swing[i] - e.covariance[VELOCITY + i, VELOCITY + i])
        moving = not correct(Measurement(VELOCITY + i, -1, -seen, density / dt, gate, 0.0), e, x) or moving
    if moving:
        e.gated += 1
        e.moving_s += dt
        if e.moving_s > params.moving_s:
            _forget_velocity(e)
    else:
        e.moving_s = 0.0
    if resting:
        for i in range(3):
            correct(Measurement(RATE + i, -1, -state.rate[i], params.rest_density / dt, 1e9, 0.0), e, x)
    e.field_fresh_s += dt
    e.field_wait_s += dt
    if motion.fresh:
        _heading(state, params, x)
        e.field_fresh_s = 0.0
    if params.held_density > 0.0 and e.field_wait_s > HELD_AFTER_S:
        b = e.trusted
        north = c[0, 0] * b[0] + c[0, 1] * b[1] + c[0, 2] * b[2]
        west = c[1, 0] * b[0] + c[1, 1] * b[1] + c[1, 2] * b[2]
        correct(Measurement(TURN + 2, -1, -atan2(west, north), params.held_density / dt, 1e9, 0.0), e, x)
    apply_correction(state, x)


@kernel
def _forget_velocity(e: ErrorState) -> None:
    """Start the velocity anew at zero, as uncertain as it was wrong, without correlation to the rest."""
    p = e.covariance
    for i in range(3):
        k = VELOCITY + i
        for j in range(ERRORS):
            p[k, j] = 0.0
            p[j, k] = 0.0
        p[k, k] = e.velocity[i] ** 2 + 1e-6
        e.velocity[i] = 0.0
        e.notch[i, 0] = 0.0
        e.notch[i, 1] = 0.0
    e.moving_s = 0.0


@kernel
def _heading(state: ErrorStateAttitude, params: ErrorStateParams, x: Array) -> None:
    """Correct the heading with a field that looks like the learned one, once a magnet on the body is taken off it."""
    e = state.error_state
    c = state.matrix
    field = scratch(3)
    for i in range(3):
        field[i] = state.field[i]
    if params.magnet.room_density > 0.0:
        find_magnet(e.magnet, params.magnet, c, state.field, e.field_fresh_s)
        for i in range(3):
            field[i] -= e.magnet.share * e.magnet.unit * e.magnet.pair[3 + i]
    north = c[0, 0] * field[0] + c[0, 1] * field[1] + c[0, 2] * field[2]
    west = c[1, 0] * field[0] + c[1, 1] * field[1] + c[1, 2] * field[2]
    up = c[2, 0] * field[0] + c[2, 1] * field[1] + c[2, 2] * field[2]
    level = sqrt(north * north + west * west)
    size = sqrt(level * level + up * up)
    if size == 0.0 or level < 0.02 * size:
        return
    dip = atan2(-up, level)
    since = e.field_fresh_s
    if e.field_size == 0.0:
        e.field_size = size
        e.field_dip = dip
    known = (
        abs(size - e.field_size) < params.field_tolerance * e.field_size
        and abs(dip - e.field_dip) < params.dip_tolerance_rad
    )
    e.regained_s = e.regained_s + since if known else 0.0
    if known and e.regained_s < FIELD_REGAIN_S:
        return
    if known:
        learn = min(1.0, since / params.field_learn_s)
        e.field_size += learn * (size - e.field_size)
        e.field_dip += learn * (dip - e.field_dip)
        e.field_wait_s = 0.0
        e.candidate_s = 0.0
        for i in range(3):
            e.trusted[i] = field[i]
        residual = e.disturbance - atan2(west, north)
        density = params.heading_density
        if params.magnet.room_density > 0.0:
            density += heading_spread(e.magnet, params.magnet, c) * (e.magnet.unit / level) ** 2
        # a tilt about north brings the field's vertical part into its west
        lean = -up / level if params.heading_tilts else 0.0
        correct(Measurement(TURN + 2, DISTURBANCE, residual, density / since, 1e9, lean), e, x)
        return
    e.rejected += 1
    # a field that has been steady elsewhere for long is the new environment
    alike = (
        abs(size - e.candidate_size) < params.field_tolerance * size
        and abs(dip - e.candidate_dip) < params.dip_tolerance_rad
    )
    if alike:
        turning = state.rate[0] ** 2 + state.rate[1] ** 2 + state.rate[2] ** 2
        if turning >= params.field_turn_rad_s**2:
            e.candidate_s += since
        learn = min(1.0, since / params.field_learn_s)
        e.candidate_size += learn * (size - e.candidate_size)
        e.candidate_dip += learn * (dip - e.candidate_dip)
        if e.candidate_s > params.field_accept_s:
            e.field_size = e.candidate_size
            e.field_dip = e.candidate_dip
    else:
        e.candidate_size = size
        e.candidate_dip = dip
        e.candidate_s = 0.0


@kernel
def _resting(state: ErrorStateAttitude, params: ErrorStateParams, force: Array, dt: float) -> bool:
    """Return True if rate and force have stayed at their slow means for ``rest_s``."""
    e = state.error_state
    smoothing = min(1.0, dt / REST_SMOOTHING_S)
    away_rate = 0.0
    away_force = 0.0
    for i in range(3):
        d = state.rate[i] - e.slow_rate[i]
        away_rate += d * d
        e.slow_rate[i] += smoothing * d
        d = force[i] - e.slow_force[i]
        away_force += d * d
        e.slow_force[i] += smoothing * d
    turning = state.rate[0] ** 2 + state.rate[1] ** 2 + state.rate[2] ** 2
    if (
        away_rate > params.rest_rate_rad_s**2
        or away_force > params.rest_force_m_s2**2
        or turning > (3.0 * params.rest_rate_rad_s) ** 2
    ):
        e.still_s = 0.0
    else:
        e.still_s += dt
    return e.still_s > params.rest_s


ERROR_STATE_FILTER = AttitudeFilter(
    ErrorStateNumbers, ErrorStateAttitude, error_state_params, begin_errors, error_state_step
)
