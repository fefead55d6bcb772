"""Defines the records of the error-state filter's parameters and state. ``error_state.py`` defines the errors."""

from __future__ import annotations

from firmware_py.records import field, record
from firmware_py.sensing.attitude_filter import AttitudeParams, AttitudeState
from firmware_py.sensing.magnet import Magnet, MagnetParams
from hal.arrays import Array

ERRORS = 13
TURN, RATE, BIAS, VELOCITY, DISTURBANCE = 0, 3, 6, 9, 12


@record
class ErrorStateParams:
    """Densities and limits of the filter, body axes where there are three."""

    turn_density: Array = field("rad^2/s", 3)  # white noise of the rate
    lead: float = field("1")  # where in the interval the rate is taken, in intervals: 1/2 its middle, 1 its end
    turn_per_rate: float = field("rad")  # the same grows by this times the rate (scale and alignment of the source)
    rate_density: Array = field("(rad/s)^2/s", 3)  # white noise of alpha
    bias_density: Array = field("(rad/s^2)^2/s", 3)
    force_density: float = field("(m/s)^2/s")  # white noise of the specific force
    still_density: float = field("(m/s)^2 s")  # how far the velocity of a hand is from zero, at least
    swing_s: float = field("s")  # density of the velocity that is seen, over its variance; 0: ``still_density`` alone
    swing_mean_s: float = field("s")  # time over which that variance is averaged
    velocity_gate: float = field(
        "1"
    )  # standard deviations beyond which a velocity is a movement, not an error; 0: none
    moving_s: float = field("s")  # a movement that lasts longer is the filter's own error
    notch: Array = field("1", 5)  # biquad b0 b1 b2 a1 a2 through which the velocity is compared; 1 0 0 0 0: none
    rest_density: float = field("(rad/s)^2 s")  # how far the rate is from zero at rest; 0: rest is not looked for
    heading_density: float = field("rad^2 s")  # of the magnetometer's heading
    heading_tilts: int = field("1")  # 1: a tilt about north is known to turn the heading that the field shows
    held_density: float = field("rad^2 s")  # of the heading held without a magnetometer; 0: not held
    disturbance_rad: float = field("rad")  # rms of the slow part of its error
    disturbance_s: float = field("s")
    start_variance: Array = field("rad^2, rad^2, (rad/s)^2, (m/s)^2", 4)  # of tilt, heading, rate, velocity
    start_bias_variance: Array = field("(rad/s^2)^2", 3)
    field_tolerance: float = field("1")  # relative deviation of the field's size that is still used
    dip_tolerance_rad: float = field("rad")
    field_learn_s: float = field("s")  # time constant with which a believed field's size and dip are followed
    field_accept_s: float = field("s")  # a new field that stays this long is accepted as the environment
    field_turn_rad_s: float = field("rad/s")  # least rate of the body at which that time counts; 0: always
    rest_rate_rad_s: float = field("rad/s")
    rest_force_m_s2: float = field("m/s^2")
    rest_s: float = field("s")
    gravity: float = field("m/s^2")
    magnet: MagnetParams = field("")


@record
class ErrorState:
    """The filter's own state. The order of the errors is that of ``TURN`` to ``DISTURBANCE``."""

    covariance: Array = field("products of the errors' units", ERRORS, ERRORS)
    work: Array = field("products of the errors' units", ERRORS, ERRORS)
    velocity: Array = field("m/s", 3)
    notch: Array = field("m/s", 3, 2)  # memory of the biquad
    sway: Array = field("m/s", 3)  # slow mean of the velocity that is compared with zero
    swing: Array = field("(m/s)^2", 3)  # mean square of that velocity about its slow mean
    moving_s: float = field("s")
    regained_s: float = field("s")  # since a field was last refused
    trusted: Array = field("uT", 3)  # the last field that was believed, body frame
    gated: int = field("1")  # ticks in which the hand moved too fast to say anything of gravity
    disturbance: float = field("rad")
    field_size: float = field("uT")
    field_dip: float = field("rad")
    field_wait_s: float = field("s")  # since a field was last trusted
    field_fresh_s: float = field("s")  # since the last conversion
    candidate_size: float = field("uT")
    candidate_dip: float = field("rad")
    candidate_s: float = field("s")
    slow_rate: Array = field("rad/s", 3)  # low-passed, for the detection of rest
    slow_force: Array = field("m/s^2", 3)
    still_s: float = field("s")
    rejected: int = field("1")  # magnetic fields that were not used
    magnet: Magnet = field("")


@record
class ErrorStateAttitude(AttitudeState):
    """The attitude's state with the error-state filter's."""

    error_state: ErrorState = field("")


@record
class ErrorStateNumbers(AttitudeParams):
    """The attitude's parameters with the error-state filter's."""

    error_state: ErrorStateParams = field("")
