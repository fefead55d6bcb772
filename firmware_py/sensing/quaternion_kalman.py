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

from math import sqrt

import numpy as np

from firmware_py.records import Array
from firmware_py.sensing.attitude_filter import AttitudeFilter, Motion
from firmware_py.sensing.attitude_params import quaternion_kalman_params
from firmware_py.sensing.quaternion import from_matrix, rotate_by, to_matrix
from firmware_py.sensing.quaternion_kalman_records import QuaternionKalmanAttitude, QuaternionKalmanNumbers
from firmware_py.sensing.triad import triad, triad_covariance
from hal.compiled import kernel


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
    k, numbers = state.quaternion_kalman, params.quaternion_kalman
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
    k, numbers = state.quaternion_kalman, params.quaternion_kalman
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


QUATERNION_KALMAN_FILTER = AttitudeFilter(
    QuaternionKalmanNumbers,
    QuaternionKalmanAttitude,
    quaternion_kalman_params,
    begin_quaternion_kalman,
    quaternion_kalman_step,
)
