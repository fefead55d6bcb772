"""A rigid body that moves, and what six accelerometers and a magnetometer on it would say.

Independent of the firmware's equations: sensor points are moved through space and differentiated twice,
nothing here knows of alpha x r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter
from scipy.spatial.transform import Rotation

from firmware_py.frame import COUNTS, LAYOUT, MAGNETOMETER_FRESH, MAGNETOMETER_RAW, TICK
from hal.arrays import Array

GRAVITY = 9.80131
POSITIONS = np.array([[0.0059, -0.0143, 0.0], [-0.0143, 0.0059, 0.0], [0.0, 0.0, 0.116]])[[0, 0, 1, 1, 2, 2]]
AXES = np.eye(3)[[0, 2, 1, 2, 0, 1]]
TIP = np.array([0.0, 0.0, 0.155])
FIELD_uT = np.array([20.0, 0.0, -45.0])  # world: magnetic north is x
RATE_HZ = 1000.0


@dataclass
class Motion:
    """Path of the origin (n, 3) m and attitude (n) of a body, ``rate_hz`` samples per second."""

    position: Array
    attitude: Rotation
    rate_hz: float = RATE_HZ

    def point(self, r: Array) -> Array:
        return self.position + self.attitude.apply(r)

    def acceleration(self, r: Array) -> Array:
        """World acceleration of a body point by central differences; the two ends repeat their neighbour."""
        p = self.point(r)
        a = np.empty_like(p)
        a[1:-1] = (p[2:] - 2.0 * p[1:-1] + p[:-2]) * self.rate_hz**2
        a[0], a[-1] = a[1], a[-2]
        return a

    def readings(self, positions: Array = POSITIONS, axes: Array = AXES) -> Array:
        """Specific force along each sensor's axis, (n, len(axes)) m/s^2."""
        up = np.array([0.0, 0.0, GRAVITY])
        rows = []
        for r, s in zip(positions, axes, strict=True):
            force = self.attitude.inv().apply(self.acceleration(r) + up)
            rows.append(force @ s)
        return np.stack(rows, axis=1)

    def rate(self) -> Array:
        """Body rates by central differences of the attitude."""
        step = (self.attitude[:-2].inv() * self.attitude[2:]).as_rotvec() * self.rate_hz / 2.0
        return np.vstack([step[:1], step, step[-1:]])


def hand_motion(seed: int, seconds: float, tremor: Array, turn: Array, tilt_deg: float = 135.0) -> Motion:
    """Tool held at ``tilt_deg`` from upright with a random heading; ``tremor`` (n, 3) m moves the origin in body
    axes, ``turn`` (n, 3) rad are small rotations about the body axes."""
    rng = np.random.default_rng(seed)
    start = Rotation.from_euler("zyx", [rng.uniform(0.0, 360.0), 0.0, tilt_deg], degrees=True)
    assert len(tremor) == round(seconds * RATE_HZ)
    return Motion(start.apply(tremor), start * Rotation.from_rotvec(turn))


def rc_filter(signal: Array, rate_hz: float = RATE_HZ) -> Array:
    """32 kOhm, 0.33 uF, exact for input that runs straight between samples; starts settled."""
    w = 1.0 / (32_000.0 * 0.33e-6)
    (b,), a, _ = cont2discrete(([w], [1.0, w]), 1.0 / rate_hz, "foh")
    return np.asarray(lfilter(b, a, signal - signal[0], axis=0)) + signal[0]


def frames_of(readings: Array, motion: Motion, *, seed: int | None = None, density_ug: float = 110.0) -> Array:
    """Frames with input columns filled: ideal sensors at 5 V and 25 degC behind the RC filter, a magnetometer at
    100 Hz. With a ``seed`` also sensor noise (ug/rtHz), converter noise and rounding to counts."""
    n = len(readings)
    volts = 2.5 + readings / GRAVITY
    rng = np.random.default_rng(seed)
    if seed is not None:
        volts = volts + density_ug * 1e-6 * np.sqrt(RATE_HZ / 2.0) * rng.standard_normal(volts.shape)
    counts = np.empty((n, 8))
    counts[:, :6] = rc_filter(volts) * 6553.6
    counts[:, 6] = 2.5 * 6553.6
    counts[:, 7] = 0.75 * 6553.6
    if seed is not None:
        counts = np.round(counts + 0.3 * rng.standard_normal(counts.shape))
    frames = np.zeros((n, LAYOUT.size))
    frames[:, TICK] = np.arange(n)
    frames[:, COUNTS : COUNTS + 8] = counts
    field = 2.5 + 0.01 * motion.attitude.inv().apply(FIELD_uT)
    every = np.arange(0, n, 10)
    frames[every, MAGNETOMETER_FRESH] = 1.0
    frames[:, MAGNETOMETER_RAW : MAGNETOMETER_RAW + 3] = np.repeat(field[every], 10, axis=0)[:n]
    return frames
