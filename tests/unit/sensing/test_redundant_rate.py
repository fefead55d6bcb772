"""A tumbling body: six axes lose its rate, nine hold it."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.records import attributes
from firmware_py.sensing.kinematics import kinematic_params
from firmware_py.sensing.numeric_kinematics import solve_numeric
from firmware_py.sensing.redundant_rate import (
    centripetal_slope,
    redundant_params,
    redundant_rate_step,
    redundant_state,
)
from tests.unit.sensing.rigid_body import AXES, POSITIONS

MORE = np.vstack([POSITIONS, [[0.013, 0.013, 0.05], [-0.013, 0.0, 0.09], [0.01, -0.01, 0.116]]])
MORE_AXES = np.vstack([AXES, [[0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]])
DT_S = 1e-3
NOISE = 1e-3


def tumble(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Rates (n, 3) of up to 4 rad/s and readings (n, 9), by vector products, alpha exact."""
    t = np.arange(round(seconds / DT_S)) * DT_S
    rate = 3.0 * np.stack([np.sin(2.0 * t), np.cos(1.3 * t), np.sin(0.7 * t + 1.0)], axis=1)
    alpha = 3.0 * np.stack([2.0 * np.cos(2.0 * t), -1.3 * np.sin(1.3 * t), 0.7 * np.cos(0.7 * t + 1.0)], axis=1)
    force = np.array([0.4, -1.0, 9.6])
    rows = [
        np.sum(MORE_AXES * (force + np.cross(a, MORE) + np.cross(w, np.cross(w, MORE))), axis=1)
        for w, a in zip(rate, alpha, strict=True)
    ]
    return rate, np.array(rows) + NOISE * np.random.default_rng(1).standard_normal((len(t), 9))


def test_nine_axes_hold_the_rate_that_integration_loses() -> None:
    rate, readings = tumble(3.0)
    params, state = redundant_params(MORE, MORE_AXES, np.full(9, NOISE)), redundant_state(rate[0], 1e-3)
    simple, before, out = kinematic_params(MORE, MORE_AXES, np.ones(9)), rate[0].copy(), np.empty(6)
    held, lost = [], []
    for w, y in zip(rate[1:], readings[:-1], strict=True):
        redundant_rate_step(y, DT_S, state, params)
        held.append(np.abs(state["rate"][0] - w).max())
        if not lost or lost[-1] < 10.0:
            solve_numeric(y, before, DT_S, simple[0], out)
            before = before + DT_S * out[3:]
            lost.append(np.abs(before - w).max())
    assert lost[-1] > 10.0
    assert max(held) < 0.1
    # what the filter says of itself
    assert np.sqrt(np.trace(state["covariance"][0])) < 0.1


def test_slope_is_the_derivative() -> None:
    params, w = kinematic_params(MORE, MORE_AXES, np.ones(9)), np.array([1.0, -2.0, 0.5])
    out, twin = np.empty((9, 3)), np.empty((9, 3))
    centripetal_slope(w, params[0], out)
    centripetal_slope.py_func(w, attributes(params)[0], twin)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(out, twin)

    def c(rate: np.ndarray) -> np.ndarray:
        return np.sum(MORE_AXES * np.cross(rate, np.cross(rate, MORE)), axis=1)

    numeric = np.stack([(c(w + 1e-6 * e) - c(w - 1e-6 * e)) / 2e-6 for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(out, numeric, atol=1e-8)


def test_six_axes_have_nothing_left_over() -> None:
    with pytest.raises(ValueError, match="more than six"):
        redundant_params(POSITIONS, AXES, np.ones(6))
