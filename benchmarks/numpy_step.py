"""The step in plain numpy, as one would write it without a compiler: vectors over axes, sensors and plays.

A peer for ``benchmarks.step``, on the firmware's records. Same mathematics as ``control.chain`` in the regular way
(aligned, no gap, reachable tip), equal to rounding; checked before it is timed.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.numpy_actuation import AT, Array, NumpyActuation
from firmware_py.control.stages import Stages
from firmware_py.records import attributes
from firmware_py.sensing.error_state import SWAY_S
from firmware_py.sensing.error_state_records import BIAS, DISTURBANCE, ERRORS, RATE, TURN, VELOCITY


def skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def biquads(x: Array, memory: Array, sections: Array) -> Array:
    """``x`` (k,) through ``sections`` (n, 5); ``memory`` (k, n, 2)."""
    for j, (b0, b1, b2, a1, a2) in enumerate(sections):
        y = b0 * x + memory[:, j, 0]
        memory[:, j, 0] = b1 * x - a1 * y + memory[:, j, 1]
        memory[:, j, 1] = b2 * x - a2 * y
        x = y
    return x


class NumpyStep:
    """One tick at a time on ``stages.frame`` and the records of ``stages``."""

    def __init__(self, stages: Stages) -> None:
        self.frame = stages.frame
        records = [attributes(record)[0] for record in stages.arguments]
        self.s, self.sp, self.e, self.ep, self.d, self.dp, *actuation = records
        self.actuation = NumpyActuation(self.frame, *actuation)

    def step(self) -> None:
        self.sense()
        self.estimate()
        self.detect()
        self.actuation.step()

    # -- sensing ------------------------------------------------------------------------------------------

    def sense(self) -> None:
        f, s, p = self.frame, self.s, self.sp
        cal, att = p.calibration, s.attitude
        volts = f[AT["counts"]] * cal.lsb_V
        f[AT["volts"]] = volts
        supply = volts[cal.supply_channel] * cal.supply_divider
        warm = (volts[cal.temperature_channel] - cal.temperature_offset_V) * cal.temperature_C_per_V
        smoothing = np.array([cal.supply_smoothing, cal.temperature_smoothing])
        s.smoothed += smoothing * (np.array([supply, warm]) - s.smoothed)
        f[AT["supply"]], f[AT["temperature"]] = s.smoothed
        rise = s.smoothed[1] - cal.reference_C
        above = volts[cal.channel] * (cal.nominal_supply_V / s.smoothed[0]) - cal.bias_V - cal.bias_V_per_C * rise
        line = above / (cal.scale_V * (1.0 + cal.scale_per_C * rise))
        y, z = line[cal.in_plane], line[cal.out_of_plane]
        g, h, r = cal.bias_in_plane, cal.bias_out_of_plane, cal.scale_out_of_plane
        bias = y * (g[:, 0] + g[:, 1] * y) + z * (h[:, 0] + h[:, 1] * z)
        readings = (line - bias) / (1.0 + z * (r[:, 0] + r[:, 1] * z))
        f[AT["accelerometer"]] = readings
        fresh = f[AT["magnetometer_fresh"]] != 0.0
        if fresh:
            f[AT["magnetometer"]] = cal.magnetometer_uT_per_V @ (f[AT["magnetometer_raw"]] - cal.magnetometer_bias_V)
        kin, w = p.kinematics, att.rate.copy()
        along, square = kin.positions @ w, w @ w
        centripetal = np.einsum("ij,ij->i", kin.axes, along[:, None] * w - square * kin.positions)
        s.motion[:] = kin.solve @ (readings - centripetal)
        self.attitude(self.point_force(p.quiet_point, w), s.motion[3:], f[AT["magnetometer"]], fresh)
        s.last_tick = f[AT["tick"]]
        corrected, dt = att.corrected, p.attitude.dt_s
        sudden = (corrected[0] - s.turned) / dt**2 + corrected[1] / dt - corrected[2]
        s.turned[:] = corrected[0]
        up = att.matrix[2] + np.cross(biquads(sudden, s.lean, p.lean_sections), att.matrix[2])
        tip = self.point_force(p.translation.tip_m, att.rate) - p.translation.gravity * up
        f[AT["tip_acceleration"]] = tip
        f[AT["tip_displacement"]] = biquads(tip, s.memory, p.translation.sections)
        f[AT["specific_force"]], f[AT["angular_acceleration"]] = s.motion[:3], s.motion[3:] - att.bias
        f[AT["rate"]], f[AT["quaternion"]] = att.rate, att.quaternion

    def point_force(self, point: Array, w: Array) -> Array:
        m = self.s.motion
        return m[:3] + np.cross(m[3:] - self.s.attitude.bias, point) + w * (w @ point) - point * (w @ w)

    def turn(self, vector: Array) -> None:
        att = self.s.attitude
        x, y, z, w = (Rotation.from_quat(np.roll(att.quaternion, -1)) * Rotation.from_rotvec(vector)).as_quat()
        att.quaternion[:] = np.array([w, x, y, z]) * (1.0 if w >= 0.0 else -1.0)
        att.matrix[:] = Rotation.from_quat([x, y, z, w]).as_matrix()

    def attitude(self, force: Array, alpha: Array, field: Array, fresh: bool) -> None:
        att, p = self.s.attitude, self.sp.attitude.error_state
        e, dt = att.error_state, self.sp.attitude.dt_s
        if fresh:
            att.field[:] = field
        att.time_s += dt
        now, before = alpha - att.bias, att.rate.copy()
        att.rate += 0.5 * (now + att.previous) * dt
        att.previous[:] = now
        self.turn((before + p.lead * (att.rate - before)) * dt)
        c = att.matrix
        up = c @ force
        e.velocity += up * dt
        e.velocity[2] -= p.gravity * dt
        fade = np.exp(-dt / p.disturbance_s)
        e.disturbance *= fade
        transition = np.eye(ERRORS)
        transition[TURN : TURN + 3, RATE : RATE + 3] = dt * c
        transition[RATE : RATE + 3, BIAS : BIAS + 3] = -dt * np.eye(3)
        transition[VELOCITY : VELOCITY + 3, TURN : TURN + 3] = -dt * skew(up)
        transition[DISTURBANCE, DISTURBANCE] = fade
        noise = np.zeros((ERRORS, ERRORS))
        noise[:3, :3] = (c * p.turn_density) @ c.T + p.turn_per_rate * (att.rate @ att.rate) * np.eye(3)
        noise[RATE : RATE + 3, RATE : RATE + 3] = np.diag(p.rate_density)
        noise[BIAS : BIAS + 3, BIAS : BIAS + 3] = np.diag(p.bias_density)
        noise[VELOCITY : VELOCITY + 3, VELOCITY : VELOCITY + 3] = p.force_density * np.eye(3)
        noise[DISTURBANCE, DISTURBANCE] = p.disturbance_rad**2 * (1.0 - fade**2) / dt
        e.covariance[:] = transition @ e.covariance @ transition.T + noise * dt
        x = np.zeros(ERRORS)
        gate = p.velocity_gate if p.velocity_gate > 0.0 else 1e9
        seen = biquads(e.velocity, e.notch[:, None, :], p.notch[None, :])
        unit = np.eye(ERRORS)
        fast = seen - e.sway
        e.sway += min(1.0, dt / SWAY_S) * fast
        e.swing += min(1.0, dt / p.swing_mean_s) * (fast * fast - e.swing)
        believed: list[bool] = []
        for i in range(VELOCITY, VELOCITY + 3):
            swing = max(0.0, e.swing[i - VELOCITY] - e.covariance[i, i])
            density = p.still_density + p.swing_s * swing
            believed.append(self.correct(unit[i], -seen[i - VELOCITY], density / dt, gate, x))
        e.moving_s = 0.0 if all(believed) else e.moving_s + dt
        e.gated += not all(believed)
        if e.moving_s > p.moving_s:
            self.forget_velocity()
        e.field_fresh_s += dt
        e.field_wait_s += dt
        if fresh:
            self.heading(field, x)
            e.field_fresh_s = 0.0
        back = c.T @ x[:3]
        self.turn(back)
        att.corrected[0] = back
        att.corrected[1] = x[RATE : RATE + 3]
        att.corrected[2] += x[BIAS : BIAS + 3]
        att.rate += x[RATE : RATE + 3]
        att.bias += x[BIAS : BIAS + 3]
        e.velocity += x[VELOCITY : VELOCITY + 3]
        e.disturbance += x[DISTURBANCE]

    def correct(self, h: Array, residual: float, variance: float, gate: float, x: Array) -> bool:
        covariance = self.s.attitude.error_state.covariance
        column = covariance @ h
        innovation = h @ column + variance
        rest = residual - h @ x
        if rest * rest > gate * gate * innovation:
            return False
        x += column * (rest / innovation)
        covariance -= np.outer(column, column) / innovation
        return True

    def forget_velocity(self) -> None:
        e = self.s.attitude.error_state
        span = slice(VELOCITY, VELOCITY + 3)
        e.covariance[span, :] = 0.0
        e.covariance[:, span] = 0.0
        e.covariance[span, span] = np.diag(e.velocity**2 + 1e-6)
        e.velocity[:] = 0.0
        e.notch[:] = 0.0
        e.moving_s = 0.0

    def heading(self, field: Array, x: Array) -> None:
        p, e = self.sp.attitude.error_state, self.s.attitude.error_state
        north, west, up = self.s.attitude.matrix @ field
        level, since = np.hypot(north, west), e.field_fresh_s
        size, dip = np.hypot(level, up), np.arctan2(-up, level)
        e.regained_s += since
        if e.regained_s < 0.5:
            return
        learn = min(1.0, since / 5.0)
        e.field_size += learn * (size - e.field_size)
        e.field_dip += learn * (dip - e.field_dip)
        e.field_wait_s = e.candidate_s = 0.0
        e.trusted[:] = field
        h = np.zeros(ERRORS)
        h[TURN], h[TURN + 2], h[DISTURBANCE] = -up / level, 1.0, -1.0
        self.correct(h, e.disturbance - np.arctan2(west, north), p.heading_density / since, 1e9, x)

    # -- tremor -------------------------------------------------------------------------------------------

    def turned(self, bank: Array, sample: Array) -> Array:
        """``bank`` (3, m) one tick on, with the ``sample`` (3, channels) of that tick."""
        p = self.ep.adaptive
        n = len(p.pole_re)
        own, sample = bank.reshape(*sample.shape, -1), sample[..., None]
        poles = own[..., : 2 * n : 2] + 1j * own[..., 1 : 2 * n : 2]
        poles = poles * (p.pole_re + 1j * p.pole_im) + p.pole_gain * sample
        slow = p.slow * own[..., 2 * n : -1] + (1.0 - p.slow) * sample
        return np.concatenate([poles.view(np.float64), slow, sample], axis=2).reshape(3, -1)

    def estimate(self) -> None:
        f, e, p = self.frame, self.e, self.ep
        a, q = e.adaptive, p.adaptive
        e.last_tick = f[AT["tick"]]
        e.ticks += 1.0
        e.at = (e.at + 1) % e.predicted.shape[1]
        if a.running:
            self.learn()
            a.filter += q.ease * (a.solved - a.filter)
        a.running = 1
        sample = f[AT["tip_acceleration"]].copy()
        e.samples[:] = sample
        e.turned[:] = p.lever @ f[AT["angular_acceleration"]]
        w, x, y, z = f[AT["quaternion"]]
        a.up[:] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        a.pending[:] = np.column_stack([e.samples, e.turned])[:, : q.onward.shape[1]]
        a.bank[:] = self.turned(a.bank, a.pending)
        self.combine(sample)
        calm, burst = np.einsum("alom,am->loa", a.filter, a.bank)
        now, ahead, core = calm + a.burst * (burst - calm)
        missed = now - e.predicted[:, (e.at - p.delay_ticks) % e.predicted.shape[1]]
        e.predicted[:, e.at] = ahead
        e.power += p.smoothing * (now**2 - e.power)
        e.miss += p.smoothing * (missed**2 - e.miss)
        frequency = e.combiner["wflc"]["omega"] * p.combiner.sensor.tick_hz / (2.0 * np.pi)
        settled = e.ticks > p.settle_ticks
        trust = np.maximum(0.0, 1.0 - np.sqrt((e.miss + p.floor2) / (e.power + p.floor2))) if settled else np.zeros(3)
        out = np.stack([now, ahead, frequency, np.sqrt(2.0 * e.power), trust, core])
        e.out[:] = out
        names = ("tremor", "tremor_ahead", "tremor_frequency", "tremor_amplitude", "confidence", "tremor_core")
        for name, values in zip(names, out, strict=True):
            f[AT[name]] = values

    def learn(self) -> None:
        a, q = self.e.adaptive, self.ep.adaptive
        channels = range(a.pending.shape[1])
        lifted = [biquads(a.pending[:, c], a.weigh[:, c, None, :], q.weight[None, :]) for c in channels]
        a.weighted[:] = self.turned(a.weighted, np.stack(lifted, axis=1))
        a["sum"] += lifted[0]
        gated = biquads(a.pending[:, 0], a.gate[:, None, :], q.gate[None, :])
        a.gate_power += q.gate_smoothing * (gated**2 - a.gate_power)
        a.burst[:] = a.gate_power / (a.gate_power + q.gate_power)
        a.in_block += 1
        if a.in_block < q.block_ticks:
            return
        a.in_block = 0
        at = int(a.n_blocks)
        a.n_blocks += 1
        taps = q.taps.shape[1]
        lag = taps // 2
        a.blocks[:, at % taps] = a["sum"] / q.block_ticks
        a["sum"][:] = 0.0
        a.snapshots[:, at % (lag + 1)] = a.weighted
        a.bursts[:, at % (lag + 1)] = a.burst
        if at >= 2 * taps:
            self.regress(at, taps, lag)
            self.know_noise()
            self.solve(at % 3, at // 3 % 2)

    def know_noise(self) -> None:
        """Set the noise's share in learning for the present attitude; ``adaptive.py`` has the same for its other band,
        which these rows do not use."""
        a, q = self.e.adaptive, self.ep.adaptive
        linear = q.lean_by_up @ a.up  # (axis, channel)
        square = np.zeros_like(linear)
        square[:, 0] = np.einsum("k,ikn,n->i", a.up, q.lean_by_square, a.up)
        a.noise_power[:] = q.noise_power + linear[:, 0] * q.lean_power[0] + square[:, 0] * q.lean_power[1]
        more = np.einsum("ic,oj->iocj", linear, q.lean_cross[0]) + np.einsum("ic,oj->iocj", square, q.lean_cross[1])
        a.noise_cross[:] = q.noise_cross + more.reshape(q.noise_cross.shape)

    def regress(self, at: int, taps: int, lag: int) -> None:
        a, q = self.e.adaptive, self.ep.adaptive
        targets = a.blocks[:, (at - np.arange(taps)) % taps] @ q.taps.T  # (3, 3)
        now2 = targets[:, :1] ** 2
        typical = (q.prior_blocks * q.weighted_power + a.power) / (q.prior_blocks + a.count)  # (axis, level)
        burst = a.bursts[:, (at - lag) % (lag + 1), None]
        weight = np.minimum(1.0, q.outlier * typical / np.maximum(now2, 1e-300)) * np.hstack([1.0 - burst, burst])
        phi = a.snapshots[:, (at - lag) % (lag + 1)]
        a.count[:] = q.keep * a.count + weight
        a.power[:] = q.keep * a.power + weight * now2
        scaled = weight[:, :, None] * phi[:, None, :]  # (axis, level, m)
        a.normal[:] = q.keep * a.normal + np.tril(scaled[..., :, None] * phi[:, None, None, :])
        a.right[:] = q.keep * a.right + targets[:, None, :, None] * scaled[:, :, None, :]

    def solve(self, axis: int, level: int) -> None:
        a, q = self.e.adaptive, self.ep.adaptive
        count, n0 = a.count[axis, level], q.prior_blocks[level]
        known = a.power[axis, level] + n0 * q.weighted_power[level] - a.noise_power[axis] * count
        power = max(known / (count + n0), q.least_power)
        counts = sum(q.share[axis, other] * a.count[other, level] for other in range(3))
        matrix = n0 * (power * q.tremor[level] + q.rest[axis]) + (n0 + counts) * q.quiet[axis]
        right = n0 * power * q.cross[level]
        for other in range(3):
            rows, seen = a.count[other, level], a.power[other, level]
            if rows > 0.0 and seen > 0.0:
                share = q.share[axis, other]
                ratio = 1.0 if other == axis else min(1.0, power * rows / seen)
                matrix = matrix + share * (ratio * a.normal[other, level] + (1.0 - ratio) * rows * q.rest[other])
                right = right + share * ratio * (a.right[other, level] - rows * a.noise_cross[other])
        scale = 1.0 / np.sqrt(np.diag(matrix))
        lower = np.tril(matrix) * np.outer(scale, scale)
        whole = lower + np.tril(lower, -1).T + 1e-9 * np.eye(len(scale))
        a.solved[axis, level] = np.linalg.solve(whole, (right * scale).T).T * scale

    def combine(self, sample: Array) -> None:
        c, p = self.e.combiner.view(np.recarray), self.ep.combiner
        w, q = c["wflc"].view(np.recarray), p.wflc
        in_band = biquads(sample, c.memory, p.sections)
        w.phase[:] = (w.phase + w.omega) % (2.0 * np.pi)
        w.power += q.power_smoothing * (in_band**2 - w.power)
        sine, cosine = np.sin(w.phase), np.cos(w.phase)
        normal = np.clip(in_band / np.sqrt(w.power), -3.0, 3.0)
        error = normal - w.sine * sine - w.cosine * cosine
        w.miss += q.power_smoothing * (error**2 - w.miss)
        omega = w.omega + 2.0 * q.frequency_gain * error * (w.sine * cosine - w.cosine * sine)
        w.omega[:] = np.clip(omega, q.low, q.high)
        w.sine[:] = q.keep * w.sine + 2.0 * q.weight_gain * sine * error
        w.cosine[:] = q.keep * w.cosine + 2.0 * q.weight_gain * cosine * error
        c.fixed_phase[:] = (c.fixed_phase + q.start) % (2.0 * np.pi)
        v = c.weights
        error = sample - v[:, 0] * sine - v[:, 1] * cosine - v[:, 2]
        gains = np.array([p.trailing_gain, p.trailing_gain, p.bias_gain])
        v += 2.0 * gains * np.stack([sine, cosine, np.ones(3)], axis=1) * error[:, None]

    def detect(self) -> None:
        d, p, f = self.d, self.dp, self.frame
        x = f[AT["tip_acceleration"]]
        d.ticks += 1.0
        gain, slow = max(p.keep, 1.0 / d.ticks), max(p.slow, 1.0 / d.ticks)
        settled = d.ticks > p.settle
        learn = gain if d.held <= 0.0 else 0.1 * gain
        d.slow_mean += slow * (x - d.slow_mean)
        y = np.stack([biquads(x, d.memory[band], p.sections[band]) for band in range(2)])
        power, square = d.power + p.floor2, y**2
        d.statistic[:] = (square / power).sum(axis=1)
        if settled:
            square = np.minimum(square, p.limit**2 * power)
        d.power += learn * (square - d.power)
        if settled and np.any(d.statistic > p.chi2):
            d.held = p.hold
        elif d.held > 0.0:
            d.held -= 1.0
        excess = d.excess + (np.linalg.norm(d.slow_mean) - p.allowed) * p.dt
        d.excess = np.clip(excess, 0.0, 2.0 * p.drift_limit)
        f[AT["status"]] = int(f[AT["status"]]) | (512 if d.held > 0.0 else 0) | (1024 * int(d.excess > p.drift_limit))
