"""The numeric differential kinematics against a body moved through space (000 (2.6), ERRATA 4, 5)."""

from __future__ import annotations

import numpy as np

from firmware_py.records import attributes
from firmware_py.sensing.kinematics import kinematic_params, solve_rate
from tests.unit.sensing.rigid_body import AXES, POSITIONS


def step_readings(rate: np.ndarray, before: np.ndarray, dt_s: float, positions: np.ndarray, axes: np.ndarray):
    """Readings of a body whose rate went from ``before`` to ``rate``, by vector products."""
    alpha = (rate - before) / dt_s
    force = np.array([0.4, -1.0, 9.6])
    centripetal = np.cross(rate, np.cross(rate, positions))
    return np.sum(axes * (force + np.cross(alpha, positions) + centripetal), axis=1), force


def test_the_rate_comes_back_to_1e_9_in_three_iterations() -> None:
    rng = np.random.default_rng(1)
    extra = np.vstack([POSITIONS, [[0.01, 0.01, 0.05], [-0.01, 0.0, 0.08]]])
    more = np.vstack([AXES, [[0.6, 0.8, 0.0], [0.0, 0.6, 0.8]]])
    for positions, axes in ((POSITIONS, AXES), (extra, more)):
        params = kinematic_params(positions, axes, np.ones(len(axes)))
        out = np.empty(6)
        for _ in range(50):
            before = rng.normal(0.0, 1.0, 3)
            rate = before + rng.normal(0.0, 0.02, 3)
            y, force = step_readings(rate, before, 1e-3, positions, axes)
            assert 1 <= solve_rate(y, before, 1e-3, params[0], out) <= 3
            np.testing.assert_allclose(out[3:], rate, atol=1e-9)
            np.testing.assert_allclose(out[:3], force, atol=1e-6)


def test_a_reading_that_cannot_be_solved_falls_back_to_the_analytic_solution() -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    out = np.empty(6)
    y = 1e9 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    assert solve_rate(y, np.zeros(3), 1.0, params[0], out) == -1
    np.testing.assert_allclose(out, params["solve"][0] @ y, rtol=1e-12)


def test_kernel_and_python_agree() -> None:
    params = kinematic_params(POSITIONS, AXES, np.ones(6))
    y, w = np.linspace(-3, 9, 6), np.array([0.3, -2.0, 1.0])
    a, b = np.empty(6), np.empty(6)
    assert solve_rate(y, w, 1e-3, params[0], a) == solve_rate.py_func(y, w, 1e-3, attributes(params)[0], b)  # type: ignore[attr-defined]
    np.testing.assert_allclose(a, b, rtol=1e-9)
