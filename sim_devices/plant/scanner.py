"""Moves the body of the endoscope bench: it rests, turns on a table, falls, is led through poses or is held.

The scenarios are functions of time, so the motion does not depend on how often it is sampled. The exception is "led",
where a caller sets the rotation of the body from time to time. World frame: z up, x to magnetic north. The specific
force is that at the body's origin; the ``Mount`` of a sensor gives the force elsewhere.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from sim_devices.config import EmulationConfig, EndoscopeConfig
from sim_devices.plant.body_motion import BodyMotion
from sim_devices.plant.rigid_body import attitude, body_rates, quaternion
from sim_devices.plant.streams import stream

Pose = tuple[Array, Array, Array, Array]
"""Angles (roll, pitch, yaw) rad with first and second derivative, and acceleration of the origin in the world."""

TRUTH_STEP_NS = 10_000_000
IMPACT_S = 4e-3
LED_S = 0.05
STACK_M_PER_V = 0.15e-6
"""Stroke of an ideal stack of 15 um at 100 V, for an amplifier with a position sensor that is emulated alone."""
_LEVEL = np.eye(3)


class Scanner:
    """Simulates the plant of an endoscope bench, with the interface that ``sim_devices.world`` needs."""

    def __init__(self, config: EmulationConfig) -> None:
        self._config = config.endoscope or EndoscopeConfig()
        environment = config.environment
        self._gravity = environment.gravity_m_s2
        dip = math.radians(environment.dip_deg)
        self._field_uT = environment.field_uT * np.array([math.cos(dip), 0.0, -math.sin(dip)])
        self._level = np.radians(self._config.attitude_deg)
        self._paths: dict[str, Callable[[float], Pose]] = {
            "rest": self._rest,
            "turntable": self._turntable,
            "fall": self._rest,
            "poses": self._poses,
            "hand": self._hand,
            "led": self._led,
        }
        self._led_ns: list[int] = [0]
        self._led_states: list[tuple[Array, Array, Array]] = [(self._level, np.zeros(3), np.zeros(3))]
        self._waves = _waves(self._config, config.seed)
        self.now_ns = 0
        self.analog_V, self.magnetometer_V, self.stack_V = np.zeros(8), np.full(3, 2.5), np.zeros(3)

    # ------------------------------------------------------------------ what the world needs

    def advance_to(self, t_ns: int) -> None:
        self.now_ns = max(self.now_ns, t_ns)

    def set_demand_V(self, channel: int, volts: float, t_ns: int) -> None:
        """There is no manipulator on this bench: an amplifier drives ideal stacks that move nothing."""
        if channel < 3:
            self.stack_V[channel] = volts

    def sag_supply(self, part: float) -> None:
        """The IMU regulates its own supply."""

    def strap(self, pulse: Literal["set", "reset"]) -> None:
        """There is no bridge magnetometer on this bench."""

    def truth_row(self) -> Mapping[str, Array]:
        motion = self.motion()
        q = np.zeros(4)
        quaternion(motion.attitude, q)
        return {
            "quaternion": q,
            "rate_rad_s": motion.rate_rad_s,
            "specific_force_m_s2": motion.specific_force_m_s2,
            "temperature_C": np.array([motion.temperature_C]),
            "stroke_m": self.stack_V * STACK_M_PER_V,
        }

    def truth(self) -> dict[str, NDArray]:
        """Return columns with one row per 10 ms: ``t_ns``, ``quaternion`` (n, 4), ``rate_rad_s`` (n, 3),
        ``specific_force_m_s2`` (n, 3), ``temperature_C`` (n,)."""
        t_ns = np.arange(0, self.now_ns + 1, TRUTH_STEP_NS, dtype=np.int64)
        q, rate, force, warm = np.zeros((len(t_ns), 4)), np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3)), t_ns * 0.0
        for i, t in enumerate(t_ns):
            motion = self.motion_at(int(t))
            quaternion(motion.attitude, q[i])
            rate[i], force[i], warm[i] = motion.rate_rad_s, motion.specific_force_m_s2, motion.temperature_C
        columns = {"quaternion": q, "rate_rad_s": rate, "specific_force_m_s2": force, "temperature_C": warm}
        return {"t_ns": t_ns, **columns}

    def motion(self) -> BodyMotion:
        """Return the motion of the body now."""
        return self.motion_at(self.now_ns)

    # ------------------------------------------------------------------ the motion itself

    def motion_at(self, t_ns: int) -> BodyMotion:
        """Return the motion of the body at plant time ``t_ns``; times may be asked for in any order."""
        t_s = t_ns * 1e-9
        angles, rates, accelerations, a = self._paths[self._config.scenario](t_s)
        c, omega, alpha = np.empty((3, 3)), np.empty(3), np.empty(3)
        attitude(_LEVEL, angles, c)
        body_rates(angles, rates, accelerations, omega, alpha)
        weight = a + np.array([0.0, 0.0, self._gravity])
        if self._config.scenario == "fall":
            weight = weight * self._carried(t_s)
        return BodyMotion(c, omega, weight @ c, alpha, np.zeros(3), self._field_uT, self._temperature_C(t_s))

    def _temperature_C(self, t_s: float) -> float:
        warm = self._config
        return warm.end_C + (warm.start_C - warm.end_C) * math.exp(-t_s / warm.thermal_s)

    def _carried(self, t_s: float) -> float:
        """Part of the weight that something carries: none while falling, the whole fall's momentum at the impact."""
        since_s = t_s - self._config.fall_at_s
        falls_s = math.sqrt(2.0 * self._config.fall_m / self._gravity)
        if since_s < 0.0 or since_s >= falls_s + IMPACT_S:
            return 1.0
        if since_s < falls_s:
            return 0.0
        return 1.0 + 0.5 * math.pi * falls_s / IMPACT_S * math.sin(math.pi * (since_s - falls_s) / IMPACT_S)

    def _rest(self, t_s: float) -> Pose:
        return self._level, np.zeros(3), np.zeros(3), np.zeros(3)

    def _turntable(self, t_s: float) -> Pose:
        """Turn about the world's z: constant angular acceleration up to the rate, the body ``radius_m`` from the
        axis."""
        c = self._config
        full, since_s = math.radians(c.rate_dps), max(0.0, t_s - c.start_s)
        if since_s < c.ramp_s:
            alpha = full / c.ramp_s if since_s > 0.0 else 0.0
            omega, turned = alpha * since_s, 0.5 * alpha * since_s**2
        else:
            alpha, omega, turned = 0.0, full, full * (since_s - 0.5 * c.ramp_s)
        yaw = self._level[2] + turned
        co, si = math.cos(turned), math.sin(turned)
        a = c.radius_m * (alpha * np.array([-si, co, 0.0]) - omega**2 * np.array([co, si, 0.0]))
        angles = np.array([self._level[0], self._level[1], yaw])
        return angles, np.array([0.0, 0.0, omega]), np.array([0.0, 0.0, alpha]), a

    def _poses(self, t_s: float) -> Pose:
        """Rows (start s, roll, pitch, yaw deg, duration s): minimum-jerk moves from pose to pose, standing between."""
        angles = self._level
        for start_s, roll, pitch, yaw, lasts_s in self._config.poses:
            target = np.radians((roll, pitch, yaw))
            if t_s >= start_s + lasts_s:
                angles = target
            elif t_s >= start_s:
                x, step = (t_s - start_s) / lasts_s, target - angles
                go = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
                speed = 30.0 * x**2 * (1.0 - 2.0 * x + x * x) / lasts_s
                rise = 60.0 * x * (1.0 - 3.0 * x + 2.0 * x * x) / lasts_s**2
                return angles + go * step, speed * step, rise * step, np.zeros(3)
        return angles, np.zeros(3), np.zeros(3), np.zeros(3)

    def lead(self, t_ns: int, angles: Array, rates: Array, accelerations: Array) -> None:
        """Set the rotation of the body from plant time ``t_ns`` on: roll, pitch, yaw in rad and their derivatives.

        The angles are extrapolated as a parabola; the body stands still from 50 ms after ``t_ns`` until the next call.
        Raises ``ValueError`` if ``t_ns`` is before that of the last call.
        """
        if t_ns < self._led_ns[-1]:
            raise ValueError(f"led at {t_ns} ns after {self._led_ns[-1]} ns: time runs forwards")
        self._led_ns.append(t_ns)
        self._led_states.append((np.array(angles), np.array(rates), np.array(accelerations)))

    def _led(self, t_s: float) -> Pose:
        i = max(0, bisect_right(self._led_ns, round(t_s * 1e9)) - 1)
        angles, rates, accelerations = self._led_states[i]
        since_s = t_s - self._led_ns[i] * 1e-9
        if since_s > LED_S:
            end = angles + rates * LED_S + 0.5 * accelerations * LED_S**2
            return end, np.zeros(3), np.zeros(3), np.zeros(3)
        turned = angles + rates * since_s + 0.5 * accelerations * since_s**2
        return turned, rates + accelerations * since_s, accelerations, np.zeros(3)

    def _hand(self, t_s: float) -> Pose:
        """Return slow voluntary sweeps and tremor: sums of sines that depend on the seed alone."""
        total = np.zeros((4, 3))
        for axis, omega, phase, radians, metres in self._waves:
            s, c = math.sin(omega * t_s + phase), math.cos(omega * t_s + phase)
            total[0, axis] += radians * s
            total[1, axis] += radians * omega * c
            total[2, axis] -= radians * omega * omega * s
            total[3, axis] -= metres * omega * omega * c
        return self._level + total[0], total[1], total[2], total[3]


def _waves(config: EndoscopeConfig, seed: int) -> list[tuple[int, float, float, float, float]]:
    """Return waves (axis, rad/s, phase, angle rad, displacement m): four slow ones and two of tremor for each axis."""
    rng = stream(seed, "scanner.hand")
    waves: list[tuple[int, float, float, float, float]] = []
    for axis in range(3):
        for _ in range(4):
            share = math.radians(config.sweep_deg) / 2.0
            omega = 2.0 * math.pi * float(rng.uniform(0.05, 0.6))
            waves.append((axis, omega, float(rng.uniform(0.0, 6.28)), share, 2e-3))
        for _ in range(2):
            omega = 2.0 * math.pi * float(rng.uniform(8.5, 11.0))
            shake = math.radians(config.tremor_deg) / math.sqrt(2.0)
            waves.append((axis, omega, float(rng.uniform(0.0, 6.28)), shake, config.tremor_um * 1e-6 / math.sqrt(2.0)))
    return waves
