"""Kinematics against finite differences of an analytic pose (scipy's rotations, not ours)."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_devices.plant.rigid_body import attitude, body_rates, quaternion, specific_force

FRAME = Rotation.from_euler("zyz", [25.0, 140.0, 15.0], degrees=True).as_matrix()
AMPLITUDE = np.array([0.3, -0.2, 0.25])
W = np.array([2.0, 3.1, 4.3])
GRAVITY = 9.80131


def angles(t, order=0):
    return AMPLITUDE * W**order * np.sin(W * t + 0.5 * math.pi * order)


def world_from_body(t):
    a = angles(t)
    return FRAME @ Rotation.from_euler("ZYX", a[::-1]).as_matrix()


def origin(t, order=0):
    w = np.array([9.0, 7.0, 5.0])
    return 1e-3 * w**order * np.sin(w * t + 0.3 + 0.5 * math.pi * order)


def kernel_state(t):
    c, omega, alpha = np.empty((3, 3)), np.empty(3), np.empty(3)
    attitude(FRAME, angles(t), c)
    body_rates(angles(t), angles(t, 1), angles(t, 2), omega, alpha)
    return c, omega, alpha


@pytest.mark.parametrize("t", [0.0, 0.37, 2.9])
def test_attitude_rate_and_angular_acceleration(t):
    c, omega, alpha = kernel_state(t)
    assert np.allclose(c, world_from_body(t), atol=1e-14)

    def rate(at):
        h = 1e-3
        steps = (
            world_from_body(at - 2 * h),
            world_from_body(at - h),
            world_from_body(at + h),
            world_from_body(at + 2 * h),
        )
        skew = world_from_body(at).T @ ((steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h))
        return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])

    assert np.allclose(omega, rate(t), atol=1e-9)
    h = 1e-2
    slope = (rate(t - 2 * h) - 8 * rate(t - h) + 8 * rate(t + h) - rate(t + 2 * h)) / (12 * h)
    assert np.allclose(alpha, slope, atol=1e-5)


@pytest.mark.parametrize("t", [0.0, 0.37, 2.9])
@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.01, -0.02, -0.155)])
def test_specific_force_is_the_second_derivative_of_the_point_less_gravity(t, arm):
    arm = np.array(arm)
    c, omega, alpha = kernel_state(t)
    f = np.empty(3)
    specific_force((c, origin(t, 2), omega, alpha), GRAVITY, arm, f)

    def point(at):
        return origin(at) + world_from_body(at) @ arm

    h = 2e-3
    p = [point(t + k * h) for k in (-2, -1, 0, 1, 2)]
    acceleration = (-p[0] + 16 * p[1] - 30 * p[2] + 16 * p[3] - p[4]) / (12 * h * h)
    expected = world_from_body(t).T @ (acceleration + np.array([0.0, 0.0, GRAVITY]))
    assert np.allclose(f, expected, atol=1e-7)


def test_at_rest_the_axis_that_points_up_reads_plus_g():
    f, zero = np.empty(3), np.zeros(3)
    specific_force((np.eye(3), zero, zero, zero), GRAVITY, zero, f)
    assert f.tolist() == [0.0, 0.0, GRAVITY]


def test_quaternion_for_all_attitudes():
    extremes = [Rotation.from_rotvec(math.pi * np.eye(3)[i]) for i in range(3)]
    for r in [*Rotation.random(200, random_state=4), *extremes]:
        q = np.empty(4)
        quaternion(r.as_matrix(), q)
        assert q[0] >= 0.0
        expected = r.as_quat(scalar_first=True)
        assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < 1e-12


def test_compiled_and_python_agree():
    t, f, g = 0.7, np.empty(3), np.empty(3)
    c, omega, alpha = kernel_state(t)
    c2, omega2, alpha2 = np.empty((3, 3)), np.empty(3), np.empty(3)
    attitude.py_func(FRAME, angles(t), c2)
    body_rates.py_func(angles(t), angles(t, 1), angles(t, 2), omega2, alpha2)
    arm = np.array([0.01, 0.02, 0.03])
    specific_force((c, origin(t, 2), omega, alpha), GRAVITY, arm, f)
    specific_force.py_func((c, origin(t, 2), omega, alpha), GRAVITY, arm, g)
    q, q2 = np.empty(4), np.empty(4)
    quaternion(c, q)
    quaternion.py_func(c, q2)
    for ours, python in ((c, c2), (omega, omega2), (alpha, alpha2), (f, g), (q, q2)):
        assert np.allclose(ours, python, rtol=0, atol=1e-14)
