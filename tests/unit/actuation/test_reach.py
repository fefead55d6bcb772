"""Nearest reachable point against a general optimiser; continuity across the border."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.manipulator import tip_from_strokes
from firmware_py.actuation.reach import box_least_squares, inside, nearest_reachable
from firmware_py.actuation.stage import geometry_of

CONFIG = ActuationConfig(rest_heights_m=(20e-6, -35e-6, 10e-6))
GEOMETRY = geometry_of(CONFIG)[0]
LOW, HIGH = np.array([-6e-6, -6.2e-6, -5.9e-6]), np.array([8e-6, 7.6e-6, 8.1e-6])


def nearest(tip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    at, strokes = tip.copy(), np.empty(3)
    nearest_reachable(at, GEOMETRY, LOW, HIGH, strokes)
    return at, strokes


def forward(strokes: np.ndarray) -> np.ndarray:
    tip = np.empty(3)
    tip_from_strokes(strokes, GEOMETRY, tip)
    return tip


@pytest.mark.parametrize("seed", range(5))
def test_box_least_squares_against_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        a, b = rng.standard_normal((3, 3)), 3.0 * rng.standard_normal(3)
        low, high = -rng.uniform(0.1, 1.0, 3), rng.uniform(0.1, 1.0, 3)
        x = np.empty(3)
        box_least_squares(a.T @ a, a.T @ b, low, high, x)
        found = lsq_linear(a, b, (low, high), tol=1e-14)
        # the least value is what counts: nearly singular matrices have long valleys
        assert np.sum((a @ x - b) ** 2) <= np.sum((a @ found.x - b) ** 2) + 1e-9
        assert inside(x, low, high)


@pytest.mark.parametrize("tip_um", [(900, 0, 0), (-700, 500, 30), (0, 0, 200), (100, -900, -90), (3000, 0, 0)])
def test_nearest_point_against_a_general_optimiser(tip_um: tuple[float, ...]) -> None:
    tip = np.array(tip_um) * 1e-6
    at, strokes = nearest(tip)
    assert inside(strokes, LOW, HIGH)
    np.testing.assert_allclose(at, forward(strokes), atol=1e-15)
    distance = np.linalg.norm(at - tip)
    for start in (np.zeros(3), HIGH * 1e6, LOW * 1e6):
        found = minimize(
            lambda s: 1e6 * np.linalg.norm(forward(s * 1e-6) - tip),
            start,
            bounds=list(zip(LOW * 1e6, HIGH * 1e6, strict=True)),
            method="L-BFGS-B",
        )
        assert distance <= 1e-6 * found.fun + 2e-9


def test_a_reachable_point_is_its_own_nearest() -> None:
    tip = forward(np.array([5e-6, -3e-6, 1e-6]))
    at, _ = nearest(tip)
    np.testing.assert_allclose(at, tip, atol=1e-12)


def test_no_jump_where_a_path_leaves_the_workspace_and_comes_back() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 2000)
    path = np.column_stack([700e-6 * np.cos(turn), 700e-6 * np.sin(2 * turn), 70e-6 * np.sin(turn + 1.0)])
    at = np.array([nearest(tip)[0] for tip in path])
    moved, wanted = (np.linalg.norm(np.diff(v, axis=0), axis=1) for v in (at, path))
    assert np.any(np.linalg.norm(at - path, axis=1) > 50e-6)
    # nearest points of a convex set move no further apart; the workspace bends by 4 um in 500
    assert np.all(moved < 1.02 * wanted)


def test_not_a_number_is_neutral() -> None:
    at, strokes = nearest(np.array([np.nan, 0.0, 0.0]))
    assert np.all(strokes == 0.0)
    assert np.all(at == 0.0)


def test_kernel_and_python_agree() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((3, 3)), rng.standard_normal(3)
    x, y = np.empty(3), np.empty(3)
    box_least_squares(a.T @ a, a.T @ b, -0.3 * np.ones(3), 0.3 * np.ones(3), x)
    box_least_squares.py_func(a.T @ a, a.T @ b, -0.3 * np.ones(3), 0.3 * np.ones(3), y)  # type: ignore[attr-defined]
    np.testing.assert_allclose(x, y, rtol=1e-12)
