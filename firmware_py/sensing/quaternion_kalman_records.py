"""Defines the records of the quaternion Kalman filter's parameters and state."""

from __future__ import annotations

from firmware_py.records import Array, field, record
from firmware_py.sensing.attitude_filter import AttitudeParams, AttitudeState


@record
class QuaternionKalmanParams:
    """Densities and limits of the filter, body axes where there are three."""

    turn_density: Array = field("rad^2/s", 3)  # white noise of the rate
    rate_density: Array = field("(rad/s)^2/s", 3)  # random walk of its error (Xi_alpha for accelerometers, erratum 44)
    lead: float = field("1")
    up_density: float = field("rad^2 s")  # of the direction of gravity, the hand's accelerations included
    field_density: float = field("rad^2 s")  # of the direction of the field
    start_variance: Array = field("rad^2, rad^2, (rad/s)^2", 3)  # of tilt, heading, rate
    gravity: float = field("m/s^2")
    force_gate_m_s2: float = field("m/s^2")
    field_gate: float = field("1")  # relative


@record
class QuaternionKalman:
    """The filter's own state."""

    covariance: Array = field("products of 1 and rad/s", 7, 7)
    field_size: float = field("uT")
    rejected: int = field("1")


@record
class QuaternionKalmanAttitude(AttitudeState):
    """The attitude's state with the quaternion filter's."""

    quaternion_kalman: QuaternionKalman = field("")


@record
class QuaternionKalmanNumbers(AttitudeParams):
    """The attitude's parameters with the quaternion filter's."""

    quaternion_kalman: QuaternionKalmanParams = field("")
