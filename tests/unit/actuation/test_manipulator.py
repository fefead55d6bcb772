"""Kinematics against the constraints of the mechanism, finite differences, and each other."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.manipulator import (
    NEWTON_PASSES,
    strokes_from_tip,
    tip_from_strokes,
    tip_jacobian,
)
from firmware_py.actuation.stage import geometry_of
from firmware_py.records import attributes
from tests.unit.actuation import truth

CONFIG = ActuationConfig()
# a real one: levers, rest heights and lengths that are not the drawing's
BUILT = ActuationConfig(
    ball_circle_m=0.00507,
    shaft_m=0.0396,
    lever_gain=(8.15, 7.9, 8.02),
    rest_heights_m=(20e-6, -35e-6, 10e-6),
)
HALF_M = 7.5e-6


def inverse(tip: np.ndarray, config: ActuationConfig, warm: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    strokes = np.empty(3)
    passes = strokes_from_tip(tip, geometry_of(config)[0], np.zeros(2) if warm is None else warm, strokes)
    return strokes, passes


def forward(strokes: np.ndarray, config: ActuationConfig) -> np.ndarray:
    tip = np.empty(3)
    tip_from_strokes(np.asarray(strokes), geometry_of(config)[0], tip)
    return tip


@pytest.mark.parametrize("config", [CONFIG, BUILT])
@pytest.mark.parametrize("strokes_um", [(7.5, -7.5, -7.5), (-7.5, 7.5, -1.0), (3.0, 5.0, 7.0), (0.0, 7.5, -7.5)])
def test_forward_solves_the_constraints(strokes_um: tuple[float, ...], config: ActuationConfig) -> None:
    strokes = np.array(strokes_um) * 1e-6
    np.testing.assert_allclose(forward(strokes, config), truth.tip_from_strokes(strokes, config), atol=1e-12)


@pytest.mark.parametrize("config", [CONFIG, BUILT])
def test_inverse_of_forward_is_the_identity_to_a_nanometre_over_the_workspace(config: ActuationConfig) -> None:
    """All of the stroke box and some beyond, at the tip: far below 1e-9 m."""
    worst, passes = 0.0, 0
    for strokes in itertools.product(np.linspace(-1.2 * HALF_M, 1.2 * HALF_M, 9), repeat=3):
        tip = forward(np.array(strokes), config)
        back, n = inverse(tip, config)
        worst = max(worst, float(np.max(np.abs(forward(back, config) - tip))))
        passes = max(passes, n)
        assert np.max(np.abs(back - strokes)) < 2e-14  # a picometre at the tip, where Newton stops
    assert worst < 1e-12
    assert passes <= NEWTON_PASSES == 3


def test_a_warm_start_needs_no_more_than_two_steps_for_a_tremor() -> None:
    warm = np.zeros(2)
    strokes = np.empty(3)
    geometry = geometry_of(BUILT)[0]
    t = np.arange(1000) / 1000.0
    path = 25e-6 * np.sin(2 * np.pi * np.array([9.0, 10.0, 11.0]) * t[:, None])
    passes = [strokes_from_tip(tip, geometry, warm, strokes) for tip in path]
    assert max(passes) <= 2


@pytest.mark.parametrize("config", [CONFIG, BUILT])
def test_jacobian_is_the_derivative(config: ActuationConfig) -> None:
    geometry = geometry_of(config)[0]
    step = 1e-8
    for strokes in itertools.product((-HALF_M, 2e-6, HALF_M), repeat=3):
        jacobian = np.empty((3, 3))
        tip_jacobian(np.array(strokes), geometry, jacobian)
        numeric = np.column_stack(
            [
                (forward(strokes + step * e, config) - forward(strokes - step * e, config)) / (2 * step)
                for e in np.eye(3)
            ]
        )
        np.testing.assert_allclose(jacobian, numeric, atol=1e-6 * 64.0)


def test_equal_strokes_move_along_the_shaft_by_the_lever() -> None:
    strokes, _ = inverse(np.array([0.0, 0.0, 40e-6]), CONFIG)
    np.testing.assert_allclose(strokes, 5e-6, rtol=1e-12)


def test_leg_one_up_tilts_the_tip_away_from_it() -> None:
    """Erratum 69: a_x = -(2 z1 - z2 - z3) / (3 r)."""
    tip = truth.tip_from_strokes(np.array([1e-6, 0.0, 0.0]), CONFIG)
    assert tip[0] == pytest.approx(-0.040 * 2 * 8e-6 / (3 * 0.005), rel=1e-3)
    assert tip[1] == pytest.approx(0.0, abs=1e-12)


def test_out_of_any_reach_is_not_a_number_and_the_next_start_is_level() -> None:
    warm = np.array([0.01, 0.02])
    strokes, passes = inverse(np.array([0.05, 0.0, 0.0]), CONFIG, warm)
    assert passes == -1
    assert np.all(np.isnan(strokes))
    assert np.all(warm == 0.0)
    assert inverse(np.array([np.nan, 0.0, 0.0]), CONFIG)[1] == -1


def test_kernels_and_python_agree() -> None:
    tip, geometry = np.array([3e-4, -2e-4, 5e-5]), geometry_of(BUILT)
    a, b, record = np.empty(3), np.empty(3), attributes(geometry)[0]
    strokes_from_tip(tip, geometry[0], np.zeros(2), a)
    # the callee that the twin reaches is compiled, and the same mathematics
    strokes_from_tip.py_func(tip, record, np.zeros(2), b)  # type: ignore[attr-defined]
    np.testing.assert_allclose(a, b, rtol=1e-13)
    c, d = np.empty((3, 3)), np.empty((3, 3))
    tip_jacobian(a, geometry[0], c)
    tip_jacobian.py_func(a, record, d)  # type: ignore[attr-defined]
    np.testing.assert_allclose(c, d, rtol=1e-13)
