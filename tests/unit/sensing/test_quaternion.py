"""Quaternion identities and TRIAD, against scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.sensing.quaternion import from_matrix, rotate_by, to_matrix
from firmware_py.sensing.triad import triad

RANDOM = Rotation.random(50, rng=np.random.default_rng(1))
HALF_TURNS = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), [[0.6, 0.8, 0.0]]]))


def scalar_first(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


@pytest.mark.parametrize("rotation", [*RANDOM[:10], *HALF_TURNS])
def test_matrix_and_quaternion_are_one_rotation(rotation: Rotation) -> None:
    c, q = np.empty((3, 3)), np.empty(4)
    to_matrix(scalar_first(rotation), c)
    np.testing.assert_allclose(c, rotation.as_matrix(), atol=1e-14)
    from_matrix(rotation.as_matrix(), q)
    assert q[0] >= 0.0
    to_matrix(q, c)
    np.testing.assert_allclose(c, rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 1e-3, 0.1, 2.0])
def test_rotate_by_turns_about_body_axes(angle: float) -> None:
    turn = angle * np.array([0.48, -0.6, 0.64])
    for rotation in RANDOM[:5]:
        q = scalar_first(rotation)
        rotate_by(q, *turn)
        c = np.empty((3, 3))
        to_matrix(q, c)
        np.testing.assert_allclose(c, (rotation * Rotation.from_rotvec(turn)).as_matrix(), atol=1e-14)


def test_triad_finds_the_attitude_from_up_and_field() -> None:
    c = np.empty((3, 3))
    for rotation in RANDOM:
        up, field = rotation.inv().apply([0.0, 0.0, 9.8]), rotation.inv().apply([20.0, 0.0, -45.0])
        assert triad(up, field, c)
        np.testing.assert_allclose(c, rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("field", [np.zeros(3), np.array([0.0, 0.0, 48.0])])
def test_triad_without_a_usable_field_still_stands_upright(field: np.ndarray) -> None:
    c = np.empty((3, 3))
    assert not triad(np.array([0.0, 0.0, 9.8]), field, c)
    np.testing.assert_allclose(c @ c.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(c) == pytest.approx(1.0)
    np.testing.assert_allclose(c[2], [0.0, 0.0, 1.0])


def test_kernels_and_python_agree() -> None:
    q1, q2 = scalar_first(RANDOM[3]), scalar_first(RANDOM[3])
    rotate_by(q1, 0.1, 0.2, -0.3)
    rotate_by.py_func(q2, 0.1, 0.2, -0.3)  # type: ignore[attr-defined]
    np.testing.assert_allclose(q1, q2, rtol=1e-14)
    a, b = np.empty((3, 3)), np.empty((3, 3))
    v, w = np.array([1.0, 2.0, 9.0]), np.array([20.0, 3.0, -40.0])
    assert triad(v, w, a) == triad.py_func(v, w, b)  # type: ignore[attr-defined]
    np.testing.assert_allclose(a, b, rtol=1e-14)
