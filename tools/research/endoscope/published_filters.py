"""Offers the attitude filters of Erat 2018, chapter 3, as plug-ins: one compiled step each, gyroscope and gravity.

Attitude is body to world, z up. ``field`` is optional: with a magnetometer, Madgwick's and Mahony's filters also hold
the heading (Madgwick, Harrison, Vaidyanathan 2011; Mahony, Hamel, Pflimlin 2008); without one nothing turns it back.
"""

from __future__ import annotations

from math import acos, atan2, sqrt
from typing import Any, NamedTuple

import numpy as np

from firmware_py.records import Record, Records, field, new, record
from firmware_py.sensing.fusion import FusionConfig, FusionFilter
from firmware_py.sensing.quaternion import from_matrix, rotate_by, to_matrix
from firmware_py.sensing.triad import triad
from hal.arrays import Array
from hal.compiled import kernel

TILT, GYROSCOPE, COMPLEMENTARY, MADGWICK, MAHONY = 0, 1, 2, 3, 4


class FusionSample(NamedTuple):
    """A sample, or all of a recording, body frame: rate rad/s, force and field of any unit (nan: none), and the time
    since the sample before, s."""

    rate: Array
    force: Array
    field: Array
    dt_s: Any


@record
class FusionParams:
    """Numbers of all filters; ``method`` selects one."""

    method: int = field("1")
    tau_s: float = field("s")  # complementary filter (3.30)
    beta: float = field("rad/s")  # Madgwick (3.73)
    field_scale: float = field("1")  # Madgwick: predicted field over measured one
    kp: float = field("1/s")  # Mahony (3.78)
    ki: float = field("1/s^2")
    align_samples: float = field("1")


@record
class FusionState:
    """The attitude, and what the filters and the alignment remember."""

    quaternion: Array = field("1", 4)
    matrix: Array = field("1", 3, 3)
    integral: Array = field("rad/s", 3)  # K_I times the integral of Mahony's error
    sums: Array = field("any", 2, 3)  # force and field while aligning
    samples: float = field("1")
    aligned: int = field("1")


@kernel
def begin_fusion(state: FusionState, params: FusionParams) -> None:
    """Forget everything. With ``align_samples`` 0 the attitude starts at (1, 0, 0, 0), as the document's filters do."""
    state.quaternion[:] = 0.0
    state.quaternion[0] = 1.0
    state.integral[:] = 0.0
    state.sums[:, :] = 0.0
    state.samples = 0.0
    state.aligned = 1 if params.align_samples < 1.0 else 0
    to_matrix(state.quaternion, state.matrix)


@kernel
def step_fusion(sample: FusionSample, state: FusionState, params: FusionParams) -> None:
    """Filter one sample."""
    rate, force, field, dt_s = sample
    if state.aligned == 0:
        _align(state, params, force, field)
        return
    q = state.quaternion
    method = params.method
    if method == MADGWICK:
        _madgwick(sample, state, params)
        return
    if method == MAHONY:
        _mahony(sample, state, params)
        return
    if method != TILT:
        rotate_by(q, rate[0] * dt_s, rate[1] * dt_s, rate[2] * dt_s)
    if method != GYROSCOPE:
        # (3.28)-(3.30), about the axis between predicted and measured up instead of angle by angle (erratum 101)
        share = dt_s / (params.tau_s + dt_s) if method == COMPLEMENTARY else 1.0
        _lean(state, force, share)


@kernel
def _align(state: FusionState, params: FusionParams, force: Array, field: Array) -> None:
    """Mean force and field, then TRIAD; without a field the heading of the body's x axis is zero."""
    for i in range(3):
        state.sums[0, i] += force[i]
        if np.isfinite(field[0]):
            state.sums[1, i] += field[i]
    state.samples += 1.0
    if state.sums[0, 0] == 0.0 and state.sums[0, 1] == 0.0 and state.sums[0, 2] == 0.0:
        return
    triad(state.sums[0], state.sums[1], state.matrix)
    from_matrix(state.matrix, state.quaternion)
    if state.samples >= params.align_samples:
        state.aligned = 1


@kernel
def _lean(state: FusionState, force: Array, share: float) -> None:
    """Turn by ``share`` of the angle that takes the predicted up to the measured one; heading stays."""
    q, c = state.quaternion, state.matrix
    norm = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if norm == 0.0:
        return
    to_matrix(q, c)
    ax, ay, az = force[0] / norm, force[1] / norm, force[2] / norm
    ex, ey, ez = ay * c[2, 2] - az * c[2, 1], az * c[2, 0] - ax * c[2, 2], ax * c[2, 1] - ay * c[2, 0]
    sine = sqrt(ex * ex + ey * ey + ez * ez)
    cosine = max(-1.0, min(1.0, ax * c[2, 0] + ay * c[2, 1] + az * c[2, 2]))
    if sine < 1e-12:
        if cosine > 0.0:
            return
        # upside down: any horizontal axis is as good
        ex, ey, ez, sine = c[0, 0], c[0, 1], c[0, 2], 1.0
    scale = share * (atan2(sine, cosine) if cosine > -1.0 else acos(-1.0)) / sine
    rotate_by(q, ex * scale, ey * scale, ez * scale)


@kernel
def _horizontal_field(q: Array, mx: float, my: float, mz: float) -> tuple[float, float]:
    """(b_x, b_z): length of the field's horizontal part and its vertical part, in the world of ``q``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    hx = mx * (1.0 - 2.0 * (y * y + z * z)) + my * 2.0 * (x * y - w * z) + mz * 2.0 * (x * z + w * y)
    hy = mx * 2.0 * (x * y + w * z) + my * (1.0 - 2.0 * (x * x + z * z)) + mz * 2.0 * (y * z - w * x)
    hz = mx * 2.0 * (x * z - w * y) + my * 2.0 * (y * z + w * x) + mz * (1.0 - 2.0 * (x * x + y * y))
    return sqrt(hx * hx + hy * hy), hz


@kernel
def _madgwick(sample: FusionSample, state: FusionState, params: FusionParams) -> None:
    """(3.65)-(3.74) with errata 105, 107; the field's rows as in Madgwick 2011."""
    rate, force, field, dt_s = sample
    q, beta, field_scale = state.quaternion, params.beta, params.field_scale
    w, x, y, z = q[0], q[1], q[2], q[3]
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    norm = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if norm > 0.0:
        # f = predicted minus measured (3.68), s = J^T f (3.70), (3.72)
        f1 = 2.0 * (x * z - w * y) - force[0] / norm
        f2 = 2.0 * (w * x + y * z) - force[1] / norm
        f3 = 1.0 - 2.0 * (x * x + y * y) - force[2] / norm
        s0 = -2.0 * y * f1 + 2.0 * x * f2
        s1 = 2.0 * z * f1 + 2.0 * w * f2 - 4.0 * x * f3
        s2 = -2.0 * w * f1 + 2.0 * z * f2 - 4.0 * y * f3
        s3 = 2.0 * x * f1 + 2.0 * y * f2
        size = sqrt(field[0] ** 2 + field[1] ** 2 + field[2] ** 2)
        if np.isfinite(size) and size > 0.0:
            mx, my, mz = field[0] / size, field[1] / size, field[2] / size
            bx, bz = _horizontal_field(q, mx, my, mz)
            bx, bz = 2.0 * field_scale * bx, 2.0 * field_scale * bz
            g1 = bx * (0.5 - y * y - z * z) + bz * (x * z - w * y) - mx
            g2 = bx * (x * y - w * z) + bz * (w * x + y * z) - my
            g3 = bx * (w * y + x * z) + bz * (0.5 - x * x - y * y) - mz
            s0 += -bz * y * g1 + (-bx * z + bz * x) * g2 + bx * y * g3
            s1 += bz * z * g1 + (bx * y + bz * w) * g2 + (bx * z - 2.0 * bz * x) * g3
            s2 += (-2.0 * bx * y - bz * w) * g1 + (bx * x + bz * z) * g2 + (bx * w - 2.0 * bz * y) * g3
            s3 += (-2.0 * bx * z + bz * x) * g1 + (-bx * w + bz * y) * g2 + bx * x * g3
    steep = sqrt(s0 * s0 + s1 * s1 + s2 * s2 + s3 * s3)
    push = beta / steep if steep > 0.0 else 0.0
    _integrate(q, rate[0], rate[1], rate[2], (push * s0, push * s1, push * s2, push * s3), dt_s)


@kernel
def _mahony(sample: FusionSample, state: FusionState, params: FusionParams) -> None:
    """(3.75)-(3.80) with erratum 108."""
    rate, force, field, dt_s = sample
    q, kp, ki = state.quaternion, params.kp, params.ki
    w, x, y, z = q[0], q[1], q[2], q[3]
    ex, ey, ez = 0.0, 0.0, 0.0
    norm = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if norm > 0.0:
        ax, ay, az = force[0] / norm, force[1] / norm, force[2] / norm
        vx, vy, vz = 2.0 * (x * z - w * y), 2.0 * (w * x + y * z), w * w - x * x - y * y + z * z
        ex, ey, ez = ay * vz - az * vy, az * vx - ax * vz, ax * vy - ay * vx
        size = sqrt(field[0] ** 2 + field[1] ** 2 + field[2] ** 2)
        if np.isfinite(size) and size > 0.0:
            mx, my, mz = field[0] / size, field[1] / size, field[2] / size
            bx, bz = _horizontal_field(q, mx, my, mz)
            ux = bx * (1.0 - 2.0 * (y * y + z * z)) + bz * vx
            uy = bx * 2.0 * (x * y - w * z) + bz * vy
            uz = bx * 2.0 * (w * y + x * z) + bz * vz
            ex += my * uz - mz * uy
            ey += mz * ux - mx * uz
            ez += mx * uy - my * ux
    integral = state.integral
    integral[0] += ki * ex * dt_s
    integral[1] += ki * ey * dt_s
    integral[2] += ki * ez * dt_s
    _integrate(
        q,
        rate[0] + kp * ex + integral[0],
        rate[1] + kp * ey + integral[1],
        rate[2] + kp * ez + integral[2],
        (0.0, 0.0, 0.0, 0.0),
        dt_s,
    )


@kernel
def _integrate(q: Array, gx: float, gy: float, gz: float, push: tuple[float, float, float, float], dt_s: float) -> None:
    """q + (q x (0, w) / 2 - push) dt and normalised: first order, as (3.59), (3.60), (3.73) have it."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] += (0.5 * (-x * gx - y * gy - z * gz) - push[0]) * dt_s
    q[1] += (0.5 * (w * gx + y * gz - z * gy) - push[1]) * dt_s
    q[2] += (0.5 * (w * gy - x * gz + z * gx) - push[2]) * dt_s
    q[3] += (0.5 * (w * gz + x * gy - y * gx) - push[3]) * dt_s
    norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] /= norm


@record
class FusionMemory:
    """The filter and one sample: each array handed to a kernel costs about 0.35 us a call, so a sample hands over
    one."""

    state: Records[FusionState] = field("", 1)
    params: Records[FusionParams] = field("", 1)
    rate: Array = field("rad/s", 3)
    force: Array = field("any", 3)
    dt_s: Array = field("s", 1)
    field: Array = field("any", 3)


@kernel
def _begin(memory: Records[FusionMemory]) -> None:
    begin_fusion(memory[0].state[0], memory[0].params[0])


@kernel
def _step(memory: Records[FusionMemory]) -> None:
    m = memory[0]
    step_fusion(FusionSample(m.rate, m.force, m.field, m.dt_s[0]), m.state[0], m.params[0])


@kernel
def _run(memory: Records[FusionMemory], rate: Array, force: Array, field: Array, dt_s: Array, out: Array) -> None:
    """Filter a recording: attitudes ``out`` (n, 4) from (n, 3) arrays and times (n,)."""
    s, p = memory[0].state[0], memory[0].params[0]
    for k in range(len(rate)):
        step_fusion(FusionSample(rate[k], force[k], field[k], dt_s[k]), s, p)
        for i in range(4):
            out[k, i] = s.quaternion[i]


def _filter(method: int) -> FusionFilter:
    def memory(config: FusionConfig, rate_hz: float) -> Record:
        numbers = {name: getattr(config, name) for name in ("tau_s", "beta", "field_scale", "kp", "ki")}
        params = new(FusionParams, method=method, align_samples=round(config.align_s * rate_hz), **numbers)
        return new(FusionMemory, params=params)

    return FusionFilter(memory, _begin, _step, _run)


FILTERS = tuple(_filter(method) for method in (TILT, GYROSCOPE, COMPLEMENTARY, MADGWICK, MAHONY))
TILT_FILTER, GYROSCOPE_FILTER, COMPLEMENTARY_FILTER, MADGWICK_FILTER, MAHONY_FILTER = FILTERS
