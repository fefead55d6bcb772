"""Closed forms that a sequential test is measured against: Page's CUSUM, Shiryaev-Roberts, the shortest delay."""

from __future__ import annotations

import math

OVERSHOOT = 0.583
"""Mean overshoot of a random walk with standard normal steps over a high level (Siegmund 1985)."""


def cusum_run_length(threshold: float, drift: float) -> float:
    """The average run length (steps) of Page's CUSUM ``max(0, S + x)`` over ``threshold``, x normal with mean ``drift``
    and variance 1, with the overshoot at both ends: Siegmund, Sequential Analysis, Springer, 1985, chapter 2.
    """
    b = threshold + 2 * OVERSHOOT
    if abs(drift) < 1e-6:
        return b * b
    return (math.exp(-2 * drift * b) - 1 + 2 * drift * b) / (2 * drift * drift)


def shiryaev_roberts_run_length(threshold: float, shift: float) -> float:
    """The average run length (steps) of the Shiryaev-Roberts test of a shift of a normal mean by ``shift`` standard
    deviations that stops at ``threshold``: Pollak, Annals of Statistics 15(2), 1987.
    """
    return threshold * math.exp(OVERSHOOT * shift)


def shortest_delay(run_length: float, information: float) -> float:
    """The worst mean delay (steps) that no test with that average run length falls short of, to first order: Lorden,
    Annals of Mathematical Statistics 42(6), 1971. ``information``: Kullback-Leibler divergence per step, nats.
    """
    return math.log(run_length) / information
