"""(f, alpha) from six readings, against a body moved through space and differentiated twice."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.records import attributes
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import kinematic_params, observation_matrix, solve_motion
from tests.unit.sensing.rigid_body import AXES, GRAVITY, POSITIONS, Motion


def tumbling(rate_hz: float) -> Motion:
    t = np.arange(round(0.2 * rate_hz)) / rate_hz
    position = 1e-3 * np.stack([np.sin(40 * t), np.cos(55 * t), np.sin(31 * t + 1)], axis=1)
    turn = np.stack([0.4 * np.sin(21 * t), 0.3 * np.sin(33 * t + 0.4), 0.5 * np.cos(17 * t)], axis=1)
    return Motion(position, Rotation.from_rotvec(turn), rate_hz)


def solved(motion: Motion, positions: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    params = kinematic_params(positions, axes, np.ones(len(axes)))
    readings, rates = motion.readings(positions, axes), motion.rate()
    out = np.empty((len(readings), 6))
    for y, w, o in zip(readings, rates, out, strict=True):
        solve_motion(y, w, params[0], o)
    return out, rates


def test_a_tumbling_body_gives_its_force_and_angular_acceleration() -> None:
    motion = tumbling(20_000.0)
    out, rates = solved(motion, POSITIONS, AXES)
    inside = slice(10, -10)
    force = motion.attitude.inv().apply(motion.acceleration(np.zeros(3)) + np.array([0.0, 0.0, GRAVITY]))
    alpha = np.gradient(rates, 1.0 / motion.rate_hz, axis=0)
    assert np.max(np.abs(rates[inside])) > 5.0  # fast enough for the centripetal part to matter
    np.testing.assert_allclose(out[inside, :3], force[inside], atol=2e-4)
    np.testing.assert_allclose(out[inside, 3:], alpha[inside], atol=2e-3)


def test_more_than_six_axes_are_weighted_not_chosen() -> None:
    motion = tumbling(20_000.0)
    positions = np.vstack([POSITIONS, [[0.0, 0.012, 0.06], [0.012, 0.0, 0.06]]])
    axes = np.vstack([AXES, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    out, _ = solved(motion, positions, axes)
    reference, _ = solved(motion, POSITIONS, AXES)
    np.testing.assert_allclose(out[10:-10], reference[10:-10], atol=2e-3)
    noise = np.array([1.0] * 6 + [0.5] * 2)
    solve = kinematic_params(positions, axes, noise)["solve"][0]
    observe = observation_matrix(positions, axes)
    weights = np.diag(noise**-2)
    best = np.linalg.inv(observe.T @ weights @ observe) @ observe.T @ weights
    np.testing.assert_allclose(solve, best, rtol=1e-6, atol=1e-9)


def test_an_axis_pointing_up_reads_plus_one_g_at_rest() -> None:
    """Erratum 2: specific force, not gravity."""
    motion = Motion(np.zeros((5, 3)), Rotation.from_rotvec(np.zeros((5, 3))))
    readings = motion.readings()
    np.testing.assert_allclose(readings[2], GRAVITY * AXES[:, 2], atol=1e-12)
    out, _ = solved(motion, POSITIONS, AXES)
    np.testing.assert_allclose(out[2], [0, 0, GRAVITY, 0, 0, 0], atol=1e-9)


def test_default_geometry_has_the_published_differences() -> None:
    """Ang 2004, second (2.54)."""
    d1, d2, d3 = 0.0202, 0.0143, 0.116
    r1, r2, r3 = np.array(SensingConfig().positions_m)
    np.testing.assert_allclose(r2 - r1, [-d1, d1, 0.0], atol=1e-15)
    np.testing.assert_allclose(r3 - r2, [d2, d2 - d1, d3], atol=1e-15)
    np.testing.assert_allclose(r3 - r1, [d2 - d1, d2, d3], atol=1e-15)


def test_a_placement_that_cannot_see_all_six_is_refused() -> None:
    with pytest.raises(ValueError, match="six degrees"):
        kinematic_params(np.zeros((6, 3)), AXES, np.ones(6))


def test_kernel_and_python_agree() -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    y, w = np.linspace(-3, 9, 6), np.array([0.3, -2.0, 1.0])
    a, b = np.empty(6), np.empty(6)
    solve_motion(y, w, params[0], a)
    solve_motion.py_func(y, w, attributes(params)[0], b)  # type: ignore[attr-defined]
    np.testing.assert_allclose(a, b, rtol=1e-12)
