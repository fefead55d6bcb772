"""Tests if a residual is louder where the simulation moves more, which noise that knows nothing of it is not."""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import norm, rankdata

from sim_devices.physics.effect import Array
from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem

PIECES = (128, 64, 32)
"""Numbers of pieces of a record, in each of which the mean square of the residual is compared with that of a signal."""
LEAST_SAMPLES = 4
"""Least number of samples of a piece."""
CERTAIN = 1.0 - 1e-12
"""Largest correlation whose transform is finite."""
LEAST_P = 1e-6
"""Largest p-value of a residual that follows: that of other tests of what is left."""


def rank_correlation(a: Array, b: Array) -> tuple[float, float]:
    """Return Spearman's correlation of two series (n,), and the one-sided p-value that it is not above zero.

    Neighbours of either series are alike, which leaves fewer independent pairs (M. S. Bartlett, J. R. Stat. Soc. 98,
    1935): n / (1 + 2 sum (1 - k/n) r_a(k) r_b(k)), over lags up to a fifth of n.
    """
    x, y = (rankdata(v) - 0.5 * (v.size + 1) for v in (a, b))
    power = math.sqrt(float(x @ x) * float(y @ y))
    if power == 0.0:
        return 0.0, 1.0
    r, n = float(x @ y) / power, x.size
    lags = range(1, n // 5 + 1)
    alike = sum((1 - k / n) * float(x[k:] @ x[:-k]) * float(y[k:] @ y[:-k]) for k in lags) / power**2
    pairs = min(n / max(1.0 + 2.0 * alike, 1.0 / n), float(n))
    return r, float(norm.sf(math.atanh(max(-CERTAIN, min(r, CERTAIN))) * math.sqrt(max(pairs - 3.0, 0.0))))


def louder_with(problem: Problem, fitted: Fit, output: str) -> Dependence | None:
    """Return the simulated output or the input with which the residual of ``output`` grows louder; None if with none.

    The variance of an error of form depends on the state (T. S. Breusch, A. R. Pagan, Econometrica 47, 1979); here by
    ranks, in pieces of several lengths, corrected for the number of tests. ``strength`` is the square of the
    correlation.
    """
    residual = fitted.residual[output]
    simulated = problem.measured[output] - residual
    signals = {output: (simulated, "amplitude"), f"{output}'": (np.gradient(simulated), "rate")}
    signals |= {i: (problem.recording.signals[i][problem.index], "amplitude") for i in problem.twin.inputs}
    best, tests = Dependence(output, "amplitude", 1.0, 0.0, False), 0
    for pieces in PIECES:
        samples = residual.size // pieces
        if samples < LEAST_SAMPLES:
            continue
        own = _loudness(residual, samples)
        for name, (signal, feature) in signals.items():
            if np.ptp(signal) == 0.0:
                continue
            tests += 1
            r, p = rank_correlation(own, _loudness(signal - signal.mean(), samples))
            if p < best.p_value:
                best = Dependence(name.removesuffix("'"), feature, p, r * r, False)
    p = min(1.0, best.p_value * tests)
    return Dependence(best.signal, best.feature, p, best.strength, False) if p < LEAST_P else None


def _loudness(x: Array, samples: int) -> Array:
    """Return the mean square of ``x`` (n,) in pieces of ``samples``."""
    n = x.size // samples
    return np.mean(x[: n * samples].reshape(n, samples) ** 2, axis=1)
