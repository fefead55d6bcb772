"""Inverse kinematics against the constraints of the mechanism."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.actuation.manipulator import strokes_from_tip
from tests.unit.actuation.truth import tip_from_strokes

GEOMETRY = (0.005, 0.040, 8.0)


def workspace() -> list[np.ndarray]:
    """Directions on a sphere, out to 600 um sideways and 60 um along, and the tremor's own 25 um."""
    rng = np.random.default_rng(0)
    unit = rng.standard_normal((12, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    far = unit * [600e-6, 600e-6, 60e-6]
    return [*far, *(25e-6 * unit[:6]), np.zeros(3), np.array([0.0, 500e-6, 0.0]), np.array([500e-6, 0.0, 0.0])]


@pytest.mark.parametrize("tip", workspace())
def test_forward_of_inverse_is_the_identity_to_a_nanometre(tip: np.ndarray) -> None:
    strokes = np.empty(3)
    strokes_from_tip(tip, *GEOMETRY, strokes)
    np.testing.assert_allclose(tip_from_strokes(strokes, *GEOMETRY), tip, atol=1e-10)


def test_equal_strokes_move_along_the_shaft_by_the_lever() -> None:
    strokes = np.empty(3)
    strokes_from_tip(np.array([0.0, 0.0, 40e-6]), *GEOMETRY, strokes)
    np.testing.assert_allclose(strokes, 5e-6, rtol=1e-12)


def test_leg_one_up_tilts_the_tip_away_from_it() -> None:
    """ERRATA 69: a_x = -(2 z1 - z2 - z3) / (3 r)."""
    tip = tip_from_strokes(np.array([1e-6, 0.0, 0.0]), *GEOMETRY)
    assert tip[0] == pytest.approx(-0.040 * 2 * 8e-6 / (3 * 0.005), rel=1e-3)
    assert tip[1] == pytest.approx(0.0, abs=1e-12)


def test_out_of_any_reach_is_not_a_number() -> None:
    strokes = np.empty(3)
    strokes_from_tip(np.array([0.05, 0.0, 0.0]), *GEOMETRY, strokes)
    assert np.all(np.isnan(strokes))


def test_kernel_and_python_agree() -> None:
    a, b = np.empty(3), np.empty(3)
    tip = np.array([3e-4, -2e-4, 5e-5])
    strokes_from_tip(tip, *GEOMETRY, a)
    strokes_from_tip.py_func(tip, *GEOMETRY, b)  # type: ignore[attr-defined]
    np.testing.assert_allclose(a, b, rtol=1e-13)
