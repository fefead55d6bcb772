"""Equations that are affine in states and signals take exact steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from tools.guest.equations import Builder
from tools.mismatch.twins.affine import exact_steps, is_affine
from tools.mismatch.twins.program import parse

NAMES = ("t", "x", "v", "u", "k")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("k*x + v/k - u + 2", True), ("sin(k)*x - k**2", True), ("-(x + v)*exp(k)", True), ("k", True),
        ("x*v", False), ("k/x", False), ("x**2", False), ("sin(x)", False), ("max(u, k)", False), ("abs(v)", False),
        ("x if u > 0 else v", False), ("x + t", False), ("t*k", False), ("sin(t)", False), ("t**2", False),
    ],
)  # fmt: skip
def test_what_is_affine(text: str, expected: bool) -> None:
    builder = Builder(NAMES)
    program = builder.program(parse(builder, {"wanted": text}, ["wanted"]))
    assert is_affine(program, 3) is expected


A = np.array([[0.0, 1.0], [-40.0, -0.8]])
B = np.array([[0.0, 0.3], [500.0, -2.0]])
C = np.array([0.1, -7.0])


@pytest.mark.parametrize("held", [(True, True), (False, False), (True, False)])
def test_steps_are_the_solution(held: tuple[bool, bool]) -> None:
    """Against the closed form of each step for constant and straight signals, in three stretches."""
    rng, dt, n = np.random.default_rng(3), 0.05, 60
    u = rng.normal(size=(n, 2)) * (1.0, 30.0)
    starts, stop = np.array([0, 20, 45]), np.array([18, 45, n])
    x0 = rng.normal(size=(3, 2))
    steps = exact_steps(lambda x, s: A @ x + B @ s + C, np.array([0.2, 1.5]), np.array([0.0, 30.0]), dt, np.array(held))
    found = steps.run(x0, u, starts, stop)
    inverse, e = np.linalg.inv(A), expm(A * dt)
    expected = np.zeros((n, 2))
    for i, (a, b) in enumerate(zip(starts, stop, strict=True)):
        expected[a] = x0[i]
        for k in range(a + 1, b):
            begin = B @ u[k - 1] + C
            slope = B @ np.where(held, 0.0, u[k] - u[k - 1]) / dt
            # x' = A x + begin + slope t
            rest = inverse @ (begin + inverse @ slope)
            expected[k] = e @ (expected[k - 1] + rest) - rest - inverse @ slope * dt
    assert np.allclose(found, expected, rtol=1e-10, atol=1e-10)


def test_an_integrator_and_a_time_constant_far_below_the_step() -> None:
    """x' = u, v' = -1e6 v + 1e6 x: a straight signal makes a parabola, and v follows x."""
    steps = exact_steps(
        lambda x, s: np.array([s[0], 1e6 * (x[0] - x[1])]),
        np.array([1.0, 1.0]),
        np.array([1.0]),
        0.01,
        np.array([False]),
    )
    t = np.arange(200) * 0.01
    found = steps.run(np.zeros((1, 2)), t[:, None], np.array([0]), np.array([200]))
    assert np.allclose(found[:, 0], 0.5 * t**2, atol=1e-12)
    assert np.allclose(found[1:, 1], 0.5 * t[1:] ** 2 - 1e-6 * t[1:], atol=1e-10)
