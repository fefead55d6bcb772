"""Accelerometer axes beyond the six of the instrument, on DAQ inputs that supply and temperature give up.

Specific force at the place of the axis from the body's motion, ratiometric output, RC, noise: as ``sensors.py``, but of
the plainest specimen (bias and scale, no cross terms), in steps from one look to the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hal.arrays import Array
from sim_devices.config import MoreAxis, SensorConfig
from sim_devices.plant.body_motion import BodyMotion
from sim_devices.plant.sensors import STANDARD_GRAVITY, rc_weights
from sim_devices.plant.streams import stream

SUPPLY_INPUT = 6  # half the supply, before that input is given up


class MoreAxes:
    """``volts`` (8,) at the DAQ with the axes in place, once per look."""

    def __init__(self, axes: Sequence[MoreAxis], config: SensorConfig, seed: int) -> None:
        self._axes = tuple(axes)
        directions = np.array([axis.direction for axis in axes], dtype=np.float64)
        self._directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self._places = np.array([axis.position_mm for axis in axes]) * 1e-3
        self._tau_s = config.rc_ohm * config.rc_farad
        self._density = config.noise_ug_per_rtHz * 1e-6
        self._rng = stream(seed, "more_axes")
        self._t_ns = -1
        self._before_V, self._rc_V = np.zeros(len(axes)), np.zeros(len(axes))

    def volts(self, volts: Array, motion: BodyMotion, t_ns: int) -> Array:
        """Return a copy of ``volts`` (n,) with the further axes. Times may not go back."""
        out = volts.copy()
        if t_ns > self._t_ns:
            self._look(2.0 * float(volts[SUPPLY_INPUT]), motion, t_ns)
        for axis, value in zip(self._axes, self._rc_V, strict=True):
            out[axis.input] = value
        return out

    def _look(self, supply_V: float, motion: BodyMotion, t_ns: int) -> None:
        along_g = np.array([d @ _felt(motion, r) for d, r in zip(self._directions, self._places, strict=True)])
        along_g /= STANDARD_GRAVITY
        scales, biases = (np.array([getattr(a, n) for a in self._axes]) for n in ("scale_V_per_g", "bias_V"))
        now_V = supply_V / 5.0 * (2.5 + biases + scales * along_g)
        if self._t_ns < 0:
            self._rc_V[:] = now_V
        else:
            dt_s = (t_ns - self._t_ns) * 1e-9
            keep, early, late = rc_weights(self._tau_s, dt_s)
            hiss_V = self._density / math.sqrt(2.0 * dt_s) * self._rng.standard_normal(len(now_V))
            self._rc_V[:] = keep * self._rc_V + early * self._before_V + late * now_V + (1.0 - keep) * hiss_V
        self._before_V, self._t_ns = now_V, t_ns


def _felt(motion: BodyMotion, place_m: Array) -> Array:
    """Return the specific force (3,) in m/s^2 at ``place_m``: f + alpha x r + omega x (omega x r), body frame (Ang 2004
    (2.3), erratum 2)."""
    r, w = place_m - motion.origin_m, motion.rate_rad_s
    return motion.specific_force_m_s2 + np.cross(motion.angular_acceleration_rad_s2, r) + np.cross(w, np.cross(w, r))
