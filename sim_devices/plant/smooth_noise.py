"""Makes smooth stationary noise with exact derivatives: white noise through three equal real poles.

    p''' = -L^3 p - 3 L^2 p' - 3 L p'' + L^3 u

u is white noise held over one step, so within a step the solution is a matrix exponential and (p, p', p'') are
exact derivatives of one another at every instant: an accelerometer may read p''. The correlation
is (1 + x + x^2/3) exp(-x) with x = L |lag|; it falls to 1/e at x = 2.904. The spectrum goes as (L^2 + w^2)^-3,
half of its peak at w = 0.510 L.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_discrete_lyapunov

from hal.arrays import Array

CORRELATION_POLE = 2.904
"""L times the 1/e correlation time."""


@dataclass(frozen=True)
class SmoothNoise:
    """Holds one process of unit variance, made discrete for one step.

    ``transition`` (3, 3) and ``drive`` (3,) move (p, p', p''): x <- transition x + drive u, u ~ N(0, 1).
    ``integral`` (3,) and ``integral_drive`` give the integral of p over the step. ``stationary`` (3, 3) is a factor
    F with F F^T the stationary covariance, to start from.
    """

    transition: Array
    drive: Array
    integral: Array
    integral_drive: float
    stationary: Array


def smooth_noise(correlation_s: float, step_s: float) -> SmoothNoise:
    """Design for a 1/e correlation time of ``correlation_s`` seconds."""
    pole = CORRELATION_POLE / correlation_s
    system = np.zeros((5, 5))  # integral of p, p, p', p'', u
    system[0, 1] = system[1, 2] = system[2, 3] = 1.0
    system[3] = [0.0, -(pole**3), -3 * pole**2, -3 * pole, pole**3]
    step: Array = np.asarray(expm(system * step_s), dtype=np.float64)
    covariance = solve_discrete_lyapunov(step[1:4, 1:4], np.outer(step[1:4, 4], step[1:4, 4]))
    gain = 1.0 / np.sqrt(covariance[0, 0])
    values, vectors = np.linalg.eigh(covariance * gain**2)
    return SmoothNoise(
        transition=step[1:4, 1:4].copy(),
        drive=step[1:4, 4] * gain,
        integral=step[0, 1:4].copy(),
        integral_drive=float(step[0, 4] * gain),
        stationary=vectors * np.sqrt(np.maximum(values, 0.0)),
    )
