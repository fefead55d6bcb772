"""Defines the records of the error-state filter's parameters and state. ``error_state.py`` defines the errors."""

from __future__ import annotations

import numpy as np

ERRORS = 13
TURN, RATE, BIAS, VELOCITY, DISTURBANCE = 0, 3, 6, 9, 12

ERROR_STATE = np.dtype(
    [
        ("turn_density", "f8", (3,)),  # rad^2/s, body axes: white noise of the rate
        ("lead", "f8"),  # where in the interval the rate is taken, in intervals: 1/2 its middle, 1 its end
        ("turn_per_rate", "f8"),  # rad: the same grows by this times the rate (scale and alignment of the source)
        ("rate_density", "f8", (3,)),  # (rad/s)^2/s, body axes: white noise of alpha
        ("bias_density", "f8", (3,)),  # (rad/s^2)^2/s
        ("force_density", "f8"),  # (m/s)^2/s: white noise of the specific force
        ("still_density", "f8"),  # (m/s)^2 s: how far the velocity of a hand is from zero
        ("velocity_gate", "f8"),  # standard deviations beyond which a velocity is a movement, not an error; 0: none
        ("moving_s", "f8"),  # a movement that lasts longer is the filter's own error
        ("notch", "f8", (5,)),  # biquad b0 b1 b2 a1 a2 through which the velocity is compared; 1 0 0 0 0: none
        ("rest_density", "f8"),  # (rad/s)^2 s: how far the rate is from zero at rest; 0: rest is not looked for
        ("heading_density", "f8"),  # rad^2 s of the magnetometer's heading
        ("held_density", "f8"),  # rad^2 s of the heading held without a magnetometer; 0: not held
        ("disturbance_rad", "f8"),  # rms of the slow part of its error
        ("disturbance_s", "f8"),
        ("start_variance", "f8", (4,)),  # of tilt, heading, rate, velocity
        ("start_bias_variance", "f8", (3,)),
        ("field_tolerance", "f8"),  # relative deviation of the field's size that is still used
        ("dip_tolerance_rad", "f8"),
        ("field_learn_s", "f8"),  # time constant with which a believed field's size and dip are followed
        ("field_accept_s", "f8"),  # a new field that stays this long is accepted as the environment
        ("field_turn_rad_s", "f8"),  # least rate of the body at which that time counts; 0: always
        ("rest_rate_rad_s", "f8"),
        ("rest_force_m_s2", "f8"),
        ("rest_s", "f8"),
        ("gravity", "f8"),
    ]
)
ERROR_STATE_STATE = np.dtype(
    [
        ("covariance", "f8", (ERRORS, ERRORS)),
        ("work", "f8", (ERRORS, ERRORS)),
        ("velocity", "f8", (3,)),
        ("notch", "f8", (3, 2)),  # memory of the biquad
        ("moving_s", "f8"),
        ("regained_s", "f8"),  # since a field was last refused
        ("trusted", "f8", (3,)),  # the last field that was believed, body frame
        ("corrected", "f8", (3, 3)),  # body frame: turn and rate of this tick, bias since the start
        ("gated", "i8"),  # ticks in which the hand moved too fast to say anything of gravity
        ("disturbance", "f8"),
        ("field_size", "f8"),
        ("field_dip", "f8"),
        ("field_wait_s", "f8"),  # since a field was last trusted
        ("field_fresh_s", "f8"),  # since the last conversion
        ("candidate_size", "f8"),
        ("candidate_dip", "f8"),
        ("candidate_s", "f8"),
        ("slow_rate", "f8", (3,)),  # low-passed, for the detection of rest
        ("slow_force", "f8", (3,)),
        ("still_s", "f8"),
        ("rejected", "i8"),  # magnetic fields that were not used
    ]
)
