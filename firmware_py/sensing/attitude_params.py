"""Computes the covariances of the attitude filters from the sensors' noise and the hand's motion."""

from __future__ import annotations

from math import radians
from typing import cast

import numpy as np
from numpy.typing import NDArray

from firmware_py.designs import design
from firmware_py.records import Records, new
from firmware_py.sensing.config import DRIFT_S, SensingConfig
from firmware_py.sensing.error_state_records import ErrorStateParams
from firmware_py.sensing.magnet import MagnetParams
from hal.types import STANDARD_GRAVITY

TREMOR_RAD_S2 = 0.5
GYRO_WHITE = 0.006
"""deg/s/sqrt(Hz): Allan deviation of the gyroscope of BROAD at rest, 0.1 to 1 s (one-sided, as a turn's growth)."""
GYRO_WALK = 0.0005
"""deg/s/sqrt(s): random walk of its bias, from the bias at rest before and after a trial."""
GYRO_SCALE_ERROR = 0.002
"""Share of the rate by which scale and alignment of a calibrated consumer gyroscope are off."""


def motion_densities(config: SensingConfig) -> NDArray[np.float64]:
    """(6, 6) two-sided densities of (f, alpha) from the axes' noise: what a random walk grows by per second.

    The RC filter leaves the density at low frequency as it is, which is the factor 21.1 of errata 21, 44.
    """
    sigma = np.array(config.noise_ug_per_rtHz) * 1e-6 * STANDARD_GRAVITY / np.sqrt(2.0)
    solve = cast("NDArray[np.float64]", np.linalg.pinv(config.observation() / sigma[:, None]))
    return solve @ solve.T


def alpha_drift_densities(config: SensingConfig) -> NDArray[np.float64]:
    """(3,) (rad/s^2)^2/s: random walk of the solved angular acceleration's bias.

    The drift of the axes at rest, carried through the geometry, and what moves with the hand (``alpha_drift_rad_s2``).
    """
    sigma = np.array(config.noise_ug_per_rtHz)
    solve = (np.linalg.pinv(config.observation() / sigma[:, None]) / sigma)[3:]
    return (solve**2 @ np.array(config.axis_drift_m_s2) ** 2 + config.alpha_drift_rad_s2**2) / DRIFT_S


def heading_density(config: SensingConfig) -> float:
    """rad^2 s of the magnetometer's heading: its surroundings and its own noise."""
    return config.heading_noise_rad**2 + (config.magnetometer_noise_uT / config.horizontal_field_uT) ** 2


def quiet_point(config: SensingConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the point of the body (3,) m where the solved specific force has the least noise, and the noise densities
    (3, 3) there.

    At the origin the noise of alpha correlates with f through its lever, and a filter that takes the two for
    independent would believe it. With f(r) = f + alpha x r the trace of the covariance is quadratic in r.
    """
    p = motion_densities(config)
    crosses = np.array([np.cross(axis, np.eye(3)).T for axis in np.eye(3)])  # crosses[i] @ v = e_i x v
    a = np.array([[np.trace(u @ p[3:, 3:] @ w.T) for w in crosses] for u in crosses])
    b = np.array([np.trace(u @ p[3:, :3]) for u in crosses])
    r = np.linalg.lstsq(a, b, rcond=None)[0]
    carry = np.hstack([np.eye(3), -np.einsum("i,ijk->jk", r, crosses)])
    return r, carry @ p @ carry.T


def tip_lever(config: SensingConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the arm (3,) m from the quiet point to the tip, and the one-sided noise densities (6, 6) of the tip's
    specific force and of alpha.
    """
    arm = np.asarray(config.tip_m) - quiet_point(config)[0]
    arm[np.abs(arm) < 1e-6] = 0.0
    carry = np.eye(6)
    carry[:3, 3:] = _cross(np.asarray(config.tip_m))
    return arm, 2.0 * carry @ motion_densities(config) @ carry.T


def _cross(r: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3): alpha x r = _cross(r) @ alpha."""
    x, y, z = r
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def tremor_notch(tick_hz: float, middle_hz: float, width_hz: float) -> NDArray[np.float64]:
    """(5,) b0 b1 b2 a1 a2 of a band stop, -3 dB ``width_hz`` apart; none where the band is beyond the sampling."""
    if width_hz == 0.0 or middle_hz >= 0.45 * tick_hz:
        return np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    b, a = design("iirnotch", middle_hz, middle_hz / width_hz, tick_hz)
    return np.array([*b, a[1], a[2]])


def error_state_params(config: SensingConfig) -> Records[ErrorStateParams]:
    """Numbers of the error-state filter driven by accelerometers."""
    density = np.diag(motion_densities(config))
    return new(
        ErrorStateParams,
        turn_density=1e-12,
        lead=0.5,
        velocity_gate=config.velocity_gate,
        moving_s=0.5,
        notch=tremor_notch(config.tick_hz, *config.tremor_notch_hz),
        rate_density=density[3:],
        bias_density=alpha_drift_densities(config),
        force_density=float(np.diag(quiet_point(config)[1]).max()),
        still_density=config.hand_velocity_m_s**2 * config.hand_velocity_s,
        swing_s=config.hand_swing_s,
        swing_mean_s=2.0,
        heading_density=heading_density(config),
        heading_tilts=int(config.heading_tilts),
        held_density=0.01**2,
        disturbance_rad=radians(config.heading_disturbance_deg),
        disturbance_s=3.0,
        start_variance=np.array([0.01**2, 0.02**2, 0.02**2, 0.002**2]),
        # the bias is the mean over the alignment, the tremor's own angular acceleration included
        start_bias_variance=density[3:] / config.align_s + TREMOR_RAD_S2**2,
        field_tolerance=0.2,
        dip_tolerance_rad=radians(15.0),
        field_learn_s=5.0,
        field_accept_s=10.0,
        gravity=config.gravity_m_s2,
    )


def gyroscope_error_state(gravity_m_s2: float = 9.81) -> Records[ErrorStateParams]:
    """The same filter for a consumer gyroscope, accelerometer and magnetometer on a moving person (BROAD).

    A sample of such a gyroscope is the mean over the interval before it, so it turns the whole interval (``lead`` 1).
    Noise and bias are the Allan deviation of the gyroscope at rest. Its scale and alignment turn the attitude by a
    share of the rate; the error changes sign as the body turns, about once a radian, so the variance grows by
    2 share^2 x 1 rad x rate. Without that term the heading becomes too certain on a body that keeps turning.
    The field in a room differs by about 1 % of its size between places that a hand passes in 1 to 3 s: 2 degrees of
    heading at a dip of 70 degrees (``disturbance``). The heading's white noise and the magnet's price were chosen on
    ten BROAD trials, where the best is flat: half or twice as much changes the mean error by at most a tenth.
    A believed field is followed with 20 s, a new one accepted after 20 s above 20 deg/s: the defaults of VQF (Laidig
    and Seel 2023; magRefTau, magNewTime, magNewMinGyr of the package vqf 2.1).
    """
    deg = radians(1.0)
    return new(
        ErrorStateParams,
        turn_density=(GYRO_WHITE * deg) ** 2,
        lead=1.0,
        turn_per_rate=2.0 * GYRO_SCALE_ERROR**2,
        notch=np.array([1.0, 0.0, 0.0, 0.0, 0.0]),
        rate_density=(GYRO_WALK * deg) ** 2,
        force_density=0.01**2,
        still_density=0.1**2,
        rest_density=(0.03 * deg) ** 2,
        heading_density=deg**2,
        disturbance_rad=2.0 * deg,
        disturbance_s=3.0,
        # TRIAD on a body that may be moving: 1 m/s^2 is 6 degrees
        start_variance=np.array([(5.0 * deg) ** 2, (10.0 * deg) ** 2, (0.5 * deg) ** 2, 0.1**2]),
        field_tolerance=0.1,
        dip_tolerance_rad=10.0 * deg,
        field_learn_s=20.0,
        field_accept_s=20.0,
        field_turn_rad_s=20.0 * deg,
        rest_rate_rad_s=2.0 * deg,
        rest_force_m_s2=0.5,
        rest_s=1.5,
        gravity=gravity_m_s2,
        magnet=new(
            MagnetParams,
            room_density=0.022**2,  # 1.6 % from place to place for a second
            room_walk=0.005**2,  # 5 % in 100 s: another table, another corner of the room
            magnet_walk=0.0022**2,
            magnet_start=0.22,  # as strong as a small magnet 2 cm from the chip
            window_s=10.0,
            independent_s=1.0,
            price=10.0,
            mean_s=0.03,
        ),
    )
