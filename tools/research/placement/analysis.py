"""Error variance of a whole configuration, all-accelerometer or 3G-3A: what Ang 2004 Table 2.4 compares, done in one
band.

In a band about omega an attitude error leans gravity into the acceleration as a lever of g / omega^2 does: tip error =
(df + dalpha x (r - g / omega^2 up)) / omega^2 for accelerometers alone; with gyroscopes dalpha is j omega times theirs
and df that of three axes at one point. Noise is white before the sensors' RC filter, whose response is undone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np

from hal.arrays import Array
from hal.types import STANDARD_GRAVITY
from tools.research.placement.configurations import Placement
from tools.research.placement.variance import (
    angular_noise,
    motion_covariance,
    point_noise,
    rate_covariance_linear,
    rate_covariance_unscented,
)

BAND_HZ = (8.0, 12.0)
RC_RAD_S = 1.0 / (32e3 * 0.33e-6)
DOWN_40 = (0.643, 0.0, -0.766)
"""Up in the body frame of an instrument held like a pen, 40 degrees from straight down."""


@dataclass(frozen=True)
class Conditions:
    """``up`` (3,) body frame, ``tip_m`` (3,), rms of a gyroscope (rad/s), body rate (3,), sampling."""

    tip_m: Array
    up: Array
    gyroscope_rad_s: float
    rate_rad_s: Array
    dt_s: float = 1e-3


@dataclass(frozen=True)
class Analysis:
    """Rms by body axis, SI. ``rate_*`` of one sample's increment; None: 3G-3A measures the rate itself."""

    name: str
    axes: int
    alpha: Array | None
    rate_linear: Array | None
    rate_unscented: Array | None
    rate_band: Array
    force_centre: Array
    force_tip: Array
    tip_band_m: Array


def cross(v: Array) -> Array:
    """(3, 3) matrix of v x."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _band(variance: Callable[[float], Array]) -> Array:
    """(3,) rms over the band from a one-sided density (3,) per Hz at a circular frequency."""
    f = np.linspace(*BAND_HZ, 81)
    return np.sqrt(np.trapezoid([variance(2.0 * pi * v) for v in f], f, axis=0))


def all_accelerometers(placement: Placement, noise: Array, conditions: Conditions) -> Analysis:
    """``noise`` (N,) rms of each axis behind its RC filter, m/s^2. ValueError for a singular placement."""
    density = motion_covariance(placement, noise * np.sqrt(4.0 / RC_RAD_S))  # one-sided, per Hz

    def tip(w: float) -> Array:
        lever = conditions.tip_m - STANDARD_GRAVITY / w**2 * conditions.up
        carry = np.hstack([np.eye(3), -cross(lever)])
        return np.diag(carry @ density @ carry.T) / w**4

    dt = conditions.dt_s
    return Analysis(
        placement.name,
        len(placement.axes),
        angular_noise(placement, noise),
        np.sqrt(np.diag(rate_covariance_linear(placement, noise, dt))),
        np.sqrt(np.diag(rate_covariance_unscented(placement, noise, dt, conditions.rate_rad_s))),
        _band(lambda w: np.diag(density)[3:] / w**2),
        point_noise(placement, noise, placement.positions.mean(axis=0)),
        point_noise(placement, noise, conditions.tip_m),
        _band(tip),
    )


def conventional(place_m: Array, noise: float, conditions: Conditions) -> Analysis:
    """Three gyroscopes and three accelerometers at ``place_m`` (3,), all of one size."""
    force, rate = (4.0 / RC_RAD_S) * noise**2, (4.0 / RC_RAD_S) * conditions.gyroscope_rad_s**2
    arm = conditions.tip_m - place_m

    def tip(w: float) -> Array:
        lever = cross(arm - STANDARD_GRAVITY / w**2 * conditions.up)
        return force / w**4 * np.ones(3) + rate / w**2 * np.diag(lever @ lever.T)

    # at the tip the rate must be differentiated: its noise grows with frequency, within the filter's bandwidth
    f = np.linspace(0.0, 0.5 / conditions.dt_s, 4001)
    w = 2.0 * pi * f
    alpha = rate * np.trapezoid(w**2 / (1.0 + (w / RC_RAD_S) ** 2), f)
    return Analysis(
        "3G-3A, conventional",
        3,
        None,
        None,
        None,
        _band(lambda _: rate * np.ones(3)),
        noise * np.ones(3),
        np.sqrt(noise**2 + alpha * np.diag(cross(arm) @ cross(arm).T)),
        _band(tip),
    )
