"""A tumbling body: six axes lose its rate, nine hold it."""

from __future__ import annotations

import numpy as np

from firmware_py.records import attributes
from firmware_py.sensing.kinematics import kinematic_params
from firmware_py.sensing.redundant_rate import (
    centripetal_slope,
)
from tests.unit.sensing.rigid_body import AXES, POSITIONS

MORE = np.vstack([POSITIONS, [[0.013, 0.013, 0.05], [-0.013, 0.0, 0.09], [0.01, -0.01, 0.116]]])
MORE_AXES = np.vstack([AXES, [[0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]])
DT_S = 1e-3
NOISE = 1e-3


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
