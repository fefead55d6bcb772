"""Rival models and how far apart they are: the distance of one from another that may re-fit itself.

The distance of ``b`` from ``a`` at an input is ``D = sqrt(min over b's parameters of sum ((y_a - y_b) / sigma)^2)``, in
standard deviations of the noise (Hunter and Reiner 1965; T-optimality: Atkinson and Fedorov 1975). Half its square is
the expected gain in log likelihood of ``a`` over ``b`` when ``a`` is true.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.placed import Placed
from tools.mismatch.plan.situation import problem_of, simulated, with_outputs
from tools.mismatch.recording import Array, Recording
from tools.mismatch.simulate import Model


@dataclass(frozen=True)
class Rival:
    """A twin with effects, at the parameters that met what was recorded so far. ``name``: its effects."""

    name: str
    placed: tuple[Placed, ...]
    theta: Array


def distance(course: Recording, a: Rival, b: Rival, sigma: Mapping[str, float], iterations: int = 8) -> float:
    """Return how far ``b`` stays from ``a`` on the inputs of ``course`` after it has re-fitted itself, in standard
    deviations. Zero where a model runs away: such an input is of no use.
    """
    problem = problem_of(course, sigma)
    truth = simulated(course, Model(problem.twin, a.placed), a.theta)
    if not all(np.all(np.isfinite(y)) for y in truth.values()):
        return 0.0
    found = refit(with_outputs(course, truth), b, sigma, iterations)
    left = squares(found, sigma)
    return math.sqrt(left) if np.isfinite(left) else 0.0


def refit(recording: Recording, rival: Rival, sigma: Mapping[str, float], iterations: int = 8, tries: int = 1) -> Fit:
    """``rival`` fitted to a recording, from its own parameters."""
    problem = problem_of(recording, sigma)
    model = Model(problem.twin, rival.placed)
    return fit(problem, model, [rival.theta], iterations=iterations, rounds=1, tolerance=1e-4, tries=tries)


def squares(found: Fit, sigma: Mapping[str, float]) -> float:
    """Sum of the squared residuals of a fit in noise variances, over all outputs."""
    return float(sum(np.sum((r / sigma[o]) ** 2) for o, r in found.residual.items()))


def smallest_distance(
    course: Recording, rivals: Sequence[Rival], sigma: Mapping[str, float], iterations: int = 8, floor: float = -1.0
) -> float:
    """The least distance over all ordered pairs. Ends early once a pair is not above ``floor``."""
    least = math.inf
    for a in rivals:
        for b in rivals:
            if a is not b:
                least = min(least, distance(course, a, b, sigma, iterations))
                if least <= floor:
                    return least
    return least


def log_ratio(recording: Recording, a: Rival, b: Rival, sigma: Mapping[str, float]) -> float:
    """Log likelihood of ``a`` less that of ``b`` on a recording, both re-fitted (normal noise, its rms as stated), with
    half the logarithm of the number of samples as the price of a parameter (Schwarz 1978): a model that contains the
    other one must earn what it is free to follow.
    """
    found = [refit(recording, r, sigma, iterations=25) for r in (a, b)]
    left = [squares(f, sigma) for f in found]
    price = 0.5 * math.log(recording.n * len(recording.outputs))
    return 0.5 * (left[1] - left[0]) + price * (found[1].theta.size - found[0].theta.size)


def fitted_rival(problem: Problem, name: str, placed: Sequence[Placed], starts: Sequence[Array]) -> Rival | None:
    """``placed`` fitted to what was recorded, from ``starts``; None where no fit is finite."""
    found = fit(problem, Model(problem.twin, placed), starts)
    return Rival(name, tuple(placed), found.theta) if found.ok and np.isfinite(found.cost) else None
