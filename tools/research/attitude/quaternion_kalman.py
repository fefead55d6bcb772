"""Runs a quaternion Kalman filter with state x = [q, b], b the error of the rate (Ang 2004 sec. 4.4, Ang 2004b; errata
36-48).

The bias-corrected rate stands in the transition of q; F = [[Phi_Q, -T/2 Phi_Q Q~], [0, I]] carries P (errata 38, 39).
The measurement is TRIAD's quaternion with Shuster's covariance; that has rank three, so the same again along q
itself is added (erratum 47). Joseph form, q normalised after each step, sign of the measurement nearest the state.
Measurements while the specific force is not g, or the field not the learned one, are left out.
"""

# numpy does not state the type of what np.linalg.solve returns, and a kernel cannot cast
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

from math import radians, sqrt

import numpy as np

from firmware_py.records import Records, field, new, record
from firmware_py.sensing.attitude_filter import AttitudeFilter, AttitudeParams, AttitudeState, Motion, OwnEntries
from firmware_py.sensing.attitude_params import alpha_drift_densities, heading_density, motion_densities
from firmware_py.sensing.config import DRIFT_S, SensingConfig
from firmware_py.sensing.quaternion import from_matrix, rotate_by, to_matrix
from firmware_py.sensing.triad import triad
from hal.arrays import Array
from hal.compiled import kernel


@record
class QuaternionKalmanParams(OwnEntries):
    """Densities and limits of the filter, body axes where there are three."""

    turn_density: Array = field("rad^2/s", 3)  # white noise of the rate
    rate_density: Array = field("(rad/s)^2/s", 3)  # random walk of its error (Xi_alpha for accelerometers, erratum 44)
    lead: float = field("1")
    up_density: float = field("rad^2 s")  # of the direction of gravity, the hand's accelerations included
    field_density: float = field("rad^2 s")  # of the direction of the field
    start_variance: Array = field("rad^2, rad^2, (rad/s)^2", 3)  # of tilt, heading, rate
    gravity: float = field("m/s^2")
    force_gate_m_s2: float = field("m/s^2")
    field_gate: float = field("1")  # relative


@record
class QuaternionKalman:
    """The filter's own state."""

    covariance: Array = field("products of 1 and rad/s", 7, 7)
    field_size: float = field("uT")
    rejected: int = field("1")


@record
class QuaternionKalmanAttitude(AttitudeState):
    """The attitude's state with the quaternion filter's."""

    own: QuaternionKalman = field("")


@record
class QuaternionKalmanNumbers(AttitudeParams):
    """The attitude's parameters with the quaternion filter's."""

    own: QuaternionKalmanParams = field("")


def _params(config: SensingConfig) -> Records[QuaternionKalmanParams]:
    """Numbers of the quaternion filter driven by accelerometers."""
    density = np.diag(motion_densities(config))
    return new(
        QuaternionKalmanParams,
        turn_density=1e-12,
        # no state for the bias of alpha here: its drift is rate drift
        rate_density=density[3:] + DRIFT_S * alpha_drift_densities(config),
        lead=0.5,
        up_density=(config.hand_acceleration_m_s2 / config.gravity_m_s2) ** 2,
        field_density=heading_density(config),
        start_variance=np.array([0.01**2, 0.02**2, 0.02**2]),
        gravity=config.gravity_m_s2,
        force_gate_m_s2=3.0,
        field_gate=0.2,
    )


def gyroscope_quaternion_kalman(gravity_m_s2: float = 9.81) -> Records[QuaternionKalmanParams]:
    """The quaternion filter for a consumer gyroscope."""
    deg = radians(1.0)
    return new(
        QuaternionKalmanParams,
        turn_density=(0.02 * deg) ** 2,
        rate_density=(0.003 * deg) ** 2,
        lead=1.0,
        up_density=0.03**2,
        field_density=deg**2,
        start_variance=np.array([deg**2, (2.0 * deg) ** 2, (0.5 * deg) ** 2]),
        gravity=gravity_m_s2,
        force_gate_m_s2=1.0,
        field_gate=0.15,
    )


@kernel
def triad_covariance(
    up: Array,
    field: Array,
    up_variance: float,
    field_variance: float,
    out: Array,
) -> None:
    """``out`` (3, 3) rad^2: covariance of TRIAD's error angles, body frame, anchored on up (Ang 2004 (4.34), Shuster
    1981).

    ``up`` and ``field`` (3,) are unit vectors in the body frame, the variances those of their directions (rad^2, each
    of two angles).
    """
    dot = up[0] * field[0] + up[1] * field[1] + up[2] * field[2]
    sine2 = max(1.0 - dot * dot, 1e-6)
    for i in range(3):
        for j in range(3):
            value = up_variance * dot * (up[i] * field[j] + field[i] * up[j])
            value += (field_variance - up_variance) * up[i] * up[j]
            out[i, j] = value / sine2
        out[i, i] += up_variance


@kernel
def tilde(q: Array, out: Array) -> None:
    """Set ``out`` (4, 3) to Q~, which satisfies Q~ B = q x (0, B) (Ang 2004 (4.13), erratum 37)."""
    out[0, 0], out[0, 1], out[0, 2] = -q[1], -q[2], -q[3]
    out[1, 0], out[1, 1], out[1, 2] = q[0], -q[3], q[2]
    out[2, 0], out[2, 1], out[2, 2] = q[3], q[0], -q[1]
    out[3, 0], out[3, 1], out[3, 2] = -q[2], q[1], q[0]


@kernel
def begin_quaternion_kalman(field: Array, state: QuaternionKalmanAttitude, params: QuaternionKalmanNumbers) -> None:
    """Set the covariance and the start values after alignment."""
    k, numbers = state.own, params.own
    q = np.empty((4, 3))
    tilde(state.quaternion, q)
    angles = np.zeros((3, 3))
    for i in range(3):
        angles[i, i] = numbers.start_variance[0] if i < 2 else numbers.start_variance[1]
    body = state.matrix.T.copy() @ angles @ state.matrix.copy()
    k.covariance[:, :] = 0.0
    k.covariance[:4, :4] = 0.25 * q @ body @ q.T
    for i in range(3):
        k.covariance[4 + i, 4 + i] = numbers.start_variance[2]
    k.field_size = 0.0
    k.rejected = 0


@kernel
def quaternion_kalman_step(motion: Motion, state: QuaternionKalmanAttitude, params: QuaternionKalmanNumbers) -> None:
    """Run one step; the field in the state is the last one known (body frame)."""
    k, numbers = state.own, params.own
    force, alpha, field, dt = motion.force, motion.alpha, state.field, motion.dt_s
    turn = np.empty(3)
    for i in range(3):
        now = alpha[i] - state.bias[i]
        before = state.rate[i]
        state.rate[i] += 0.5 * (now + state.previous[i]) * dt
        state.previous[i] = now
        turn[i] = (before + numbers.lead * (state.rate[i] - before)) * dt
    # --- prediction: columns of Phi_Q are the turned unit quaternions
    f = np.eye(7)
    unit = np.empty(4)
    for j in range(4):
        unit[:] = 0.0
        unit[j] = 1.0
        rotate_by(unit, turn[0], turn[1], turn[2])
        if unit[j] < 0.0:  # rotate_by reports w >= 0; a column of Phi_Q keeps its sign
            for i in range(4):
                unit[i] = -unit[i]
        for i in range(4):
            f[i, j] = unit[i]
    q = np.empty((4, 3))
    tilde(state.quaternion, q)
    f[:4, 4:] = -0.5 * dt * f[:4, :4].copy() @ q
    carried = f[:4, :4].copy() @ state.quaternion.copy()
    rotate_by(state.quaternion, turn[0], turn[1], turn[2])
    tilde(state.quaternion, q)
    p = f @ k.covariance @ f.T
    if (
        carried[0] * state.quaternion[0]
        + carried[1] * state.quaternion[1]
        + carried[2] * state.quaternion[2]
        + carried[3] * state.quaternion[3]
    ) < 0.0:
        # -q is reported: what is correlated with q changes sign with it
        p[:4, 4:] *= -1.0
        p[4:, :4] *= -1.0
    for n in range(3):
        p[4 + n, 4 + n] += numbers.rate_density[n] * dt
        for i in range(4):
            for j in range(4):
                p[i, j] += 0.25 * dt * q[i, n] * numbers.turn_density[n] * q[j, n]
    # --- measurement
    size = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    strength = sqrt(field[0] ** 2 + field[1] ** 2 + field[2] ** 2)
    if k.field_size == 0.0:
        k.field_size = strength
    known = abs(strength - k.field_size) <= numbers.field_gate * k.field_size
    if abs(size - numbers.gravity) > numbers.force_gate_m_s2 or strength == 0.0 or not known:
        k.rejected += 1
        k.covariance[:, :] = p
        to_matrix(state.quaternion, state.matrix)
        return
    found = triad(force, field, state.matrix)
    z = np.empty(4)
    from_matrix(state.matrix, z)
    angles = np.empty((3, 3))
    if found:
        triad_covariance(force / size, field / strength, numbers.up_density / dt, numbers.field_density / dt, angles)
        side = z[0] * state.quaternion[0] + z[1] * state.quaternion[1]
        side += z[2] * state.quaternion[2] + z[3] * state.quaternion[3]
        residual = np.empty(4)
        for i in range(4):
            residual[i] = (z[i] if side >= 0.0 else -z[i]) - state.quaternion[i]
        v = 0.25 * q @ angles @ q.T
        trace = v[0, 0] + v[1, 1] + v[2, 2] + v[3, 3]
        for i in range(4):
            for j in range(4):
                v[i, j] += trace / 3.0 * state.quaternion[i] * state.quaternion[j]
        gain = np.linalg.solve(p[:4, :4].copy() + v, p[:4, :].copy()).T
        x = gain @ residual
        keep = np.eye(7)
        keep[:, :4] -= gain
        p = keep @ p @ keep.T + gain @ v @ gain.T
        norm = 0.0
        for i in range(4):
            state.quaternion[i] += x[i]
            norm += state.quaternion[i] ** 2
        norm = sqrt(norm)
        if state.quaternion[0] < 0.0:
            norm = -norm
        for i in range(4):
            state.quaternion[i] /= norm
        if norm < 0.0:
            p[:4, 4:] *= -1.0
            p[4:, :4] *= -1.0
        for i in range(3):
            state.rate[i] -= x[4 + i]
    k.covariance[:, :] = 0.5 * (p + p.T)
    to_matrix(state.quaternion, state.matrix)


FILTER = AttitudeFilter(
    QuaternionKalmanNumbers, QuaternionKalmanAttitude, _params, begin_quaternion_kalman, quaternion_kalman_step
)
