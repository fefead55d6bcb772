"""Both Kalman filters against a body that is turned exactly, and TRIAD's covariance against draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.records import attributes, new
from firmware_py.sensing.attitude_params import gyroscope_error_state
from firmware_py.sensing.error_state import propagate_errors
from firmware_py.sensing.error_state_records import ERRORS, ErrorState
from firmware_py.sensing.triad import triad
from tools.research.attitude.quaternion_kalman import triad_covariance
from tools.research.reproduce.gyroscope_attitude import gyroscope_attitude

RATE_HZ = 200.0
G = 9.81
FIELD = np.array([20.0, 0.0, -40.0])


def moving_body(seconds: float, bias: np.ndarray, noise: float = 0.0, shake_m_s2: float = 0.0):
    """Attitudes (n), and rate, force, field as sensors give them: rate is the mean of the interval before."""
    rng = np.random.default_rng(2)
    n = round(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    turn = np.stack([0.6 * np.sin(1.1 * t), 0.5 * np.sin(0.7 * t + 1.0), 0.8 * np.sin(0.5 * t)], axis=1)
    attitude = Rotation.from_rotvec(turn) * Rotation.from_rotvec([0.3, -0.2, 2.5])
    rate = np.zeros((n, 3))
    rate[1:] = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE_HZ
    shake = shake_m_s2 * np.stack([np.sin(7.0 * t), np.cos(9.0 * t), np.sin(11.0 * t)], axis=1)
    force = attitude.inv().apply(shake + np.array([0.0, 0.0, G]))
    field = attitude.inv().apply(np.tile(FIELD, (n, 1)))
    return (
        attitude,
        rate + bias + noise * rng.standard_normal((n, 3)),
        force + 3.0 * noise * rng.standard_normal((n, 3)),
        field + 30.0 * noise * rng.standard_normal((n, 3)),
    )


def errors_deg(q: np.ndarray, attitude: Rotation) -> np.ndarray:
    return np.degrees((Rotation.from_quat(q[:, [1, 2, 3, 0]]) * attitude.inv()).magnitude())


@pytest.mark.parametrize("method", ["error-state", "quaternion-kalman"])
def test_a_turned_body_is_followed_and_a_rate_bias_found(method: str) -> None:
    attitude, rate, force, field = moving_body(60.0, np.radians([0.5, -0.4, 0.3]), noise=0.002)
    q = gyroscope_attitude(rate, force, field, RATE_HZ, method)  # type: ignore[arg-type]
    assert np.all(q[:, 0] >= 0.0)
    late = errors_deg(q, attitude)[-4000:]
    assert np.sqrt(np.mean(late**2)) < 0.6
    # what bias alone would have done by then
    assert np.degrees(np.linalg.norm(np.radians([0.5, -0.4, 0.3]))) * 60.0 > 40.0


def test_accelerations_average_out_where_triad_follows_them() -> None:
    attitude, rate, force, field = moving_body(60.0, np.zeros(3), noise=0.001, shake_m_s2=2.0)
    q = gyroscope_attitude(rate, force, field, RATE_HZ)
    late = slice(-4000, None)
    ours = np.sqrt(np.mean(errors_deg(q, attitude)[late] ** 2))
    c, alone = np.empty((3, 3)), []
    for f, b, truth in zip(force[late], field[late], attitude[late].as_matrix(), strict=True):
        triad(f, b, c)
        alone.append(np.degrees(np.arccos(np.clip((np.trace(c @ truth.T) - 1) / 2, -1, 1))))
    assert ours < 0.5
    assert np.sqrt(np.mean(np.square(alone))) > 10.0 * ours


def test_a_magnet_does_not_turn_the_heading() -> None:
    attitude, rate, force, field = moving_body(60.0, np.zeros(3), noise=0.001)
    near = slice(8000, 9400)
    field[near] += np.array([0.0, 25.0, 0.0])
    q = gyroscope_attitude(rate, force, field, RATE_HZ)
    # the field itself is 30 to 50 degrees off; the rate alone carries the heading for 7 s
    assert np.max(errors_deg(q, attitude)[near]) < 0.5


def turning_body(seconds: float, scale_error: float):
    """A body that lies still for 10 s and then turns about the vertical, and back a fifth as fast: attitudes (n), and
    rate, force, field of a gyroscope whose scale is off."""
    n = round(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    rate = np.where(t < 10.0, 0.0, np.where(t % 12.0 < 2.0, -0.4, 2.0))
    heading = np.cumsum(rate) / RATE_HZ
    attitude = Rotation.from_rotvec(heading[:, None] * np.array([0.0, 0.0, 1.0]))
    gyro = (1.0 + scale_error) * rate[:, None] * np.array([0.0, 0.0, 1.0])
    return attitude, gyro, np.tile([0.0, 0.0, G], (n, 1)), attitude.inv().apply(np.tile(FIELD, (n, 1)))


def test_a_scale_error_of_the_gyroscope_does_not_walk_the_heading_off() -> None:
    """0.3 % of 1.6 rad/s on average is 16 degrees a minute; the field must stop it, however certain rest was.

    A drift d against a heading of density r (noise and slow disturbance) and a turn of density q leaves d sqrt(r / q).
    """
    attitude, rate, force, field = turning_body(100.0, 0.003)
    settings = gyroscope_error_state(), gyroscope_error_state()
    settings[1]["turn_per_rate"] = 0.0
    away, certain = (
        errors_deg(gyroscope_attitude(rate, force, field, RATE_HZ, setting=setting), attitude)[-2000:]
        for setting in settings
    )
    setting = attributes(settings[0])[0]
    rate_rad_s = float(np.mean(np.abs(rate[2000:, 2])))
    noise = setting.heading_density + 2.0 * setting.disturbance_rad**2 * setting.disturbance_s
    turn = setting.turn_density[2] + setting.turn_per_rate * rate_rad_s
    limit = np.degrees(0.003 * rate_rad_s * np.sqrt(noise / turn))
    assert np.max(away) < limit
    assert np.min(certain) > limit


def test_the_covariance_follows_the_dense_equation() -> None:
    """P <- F P F^T + Q with F written out as a matrix."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(ERRORS, ERRORS))
    params, state = gyroscope_error_state(), new(ErrorState)
    state["covariance"][0] = p = root @ root.T
    c = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    up, rate, dt = np.array([0.5, -0.7, 9.9]), np.array([1.0, 2.0, -0.5]), 0.01
    propagate_errors(state[0], params[0], c, up, rate, dt)
    f = np.eye(ERRORS)
    f[0:3, 3:6] = dt * c
    f[3:6, 6:9] = -dt * np.eye(3)
    f[12, 12] = np.exp(-dt / params["disturbance_s"][0])
    q = np.zeros((ERRORS, ERRORS))
    q[0:3, 0:3] = dt * (
        c @ np.diag(params["turn_density"][0]) @ c.T + params["turn_per_rate"][0] * np.linalg.norm(rate) * np.eye(3)
    )
    q[3:6, 3:6] = dt * np.diag(params["rate_density"][0])
    q[9:12, 9:12] = dt * params["force_density"][0] * np.eye(3)
    q[12, 12] = params["disturbance_rad"][0] ** 2 * (1.0 - f[12, 12] ** 2)
    # theta x up = -[up x] theta; rows of cross(eye, up) are e_i x up, so the matrix is its transpose
    f[9:12, 0:3] = dt * np.cross(np.eye(3), up).T
    np.testing.assert_allclose(state["covariance"][0], f @ p @ f.T + q, rtol=1e-10, atol=1e-12)
    again = new(ErrorState)
    again["covariance"][0] = p
    propagate_errors.py_func(attributes(again)[0], attributes(params)[0], c, up, rate, dt)  # type: ignore[attr-defined]
    np.testing.assert_allclose(again["covariance"], state["covariance"], rtol=1e-12)


def test_triad_covariance_is_that_of_drawn_errors() -> None:
    rng = np.random.default_rng(7)
    truth = Rotation.from_rotvec([0.7, -0.4, 1.2])
    up, field = truth.inv().apply([0.0, 0.0, 1.0]), truth.inv().apply(FIELD / np.linalg.norm(FIELD))
    a, b = 2e-3, 5e-3
    drawn = np.empty((4000, 3, 3))
    for c in drawn:
        triad(up + a * rng.standard_normal(3), field + b * rng.standard_normal(3), c)
    found = (truth.inv() * Rotation.from_matrix(drawn)).as_rotvec()
    expected = np.empty((3, 3))
    triad_covariance(up, field, a * a, b * b, expected)
    np.testing.assert_allclose(np.cov(found.T), expected, atol=0.06 * np.max(expected))


def test_rows_must_match() -> None:
    with pytest.raises(ValueError, match="rows"):
        gyroscope_attitude(np.zeros((5, 3)), np.zeros((4, 3)), np.zeros((5, 3)), 100.0)
