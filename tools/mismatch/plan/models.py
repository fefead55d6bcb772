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
from tools.mismatch.simulate_start import prepare, starts


@dataclass(frozen=True)
class Rival:
    """A twin with effects, at the parameters that met what was recorded so far. ``name``: its effects."""

    name: str
    placed: tuple[Placed, ...]
    theta: Array


def distance(
    course: Recording, a: Rival, b: Rival, sigma: Mapping[str, float], iterations: int = 8, *, thorough: bool = False
) -> float:
    """Return how far ``b`` stays from ``a`` on the inputs of ``course`` after it has re-fitted itself, in standard
    deviations. Zero where a model runs away: such an input is of no use. ``thorough``: see ``refit``.
    """
    problem = problem_of(course, sigma)
    truth = simulated(course, Model(problem.twin, a.placed), a.theta)
    if not all(np.all(np.isfinite(y)) for y in truth.values()):
        return 0.0
    left = squares(refit(with_outputs(course, truth), b, sigma, iterations, thorough=thorough), sigma)
    return math.sqrt(left) if np.isfinite(left) else 0.0


def refit(
    recording: Recording, rival: Rival, sigma: Mapping[str, float], iterations: int = 8, *, thorough: bool = False
) -> Fit:
    """``rival`` fitted to a recording with all its parameters, those of the twin as well.

    The search begins at the rival's own parameters and at those that the recording itself suggests for each effect: a
    search from one start may end in another valley, which makes two models look further apart than they are.
    ``thorough``: each start is followed to its end, once more with settings of the effects that are read off this
    recording, as a new diagnosis would.
    """
    problem = problem_of(recording, sigma)
    model = Model(problem.twin, rival.placed)

    def fitted(model: Model, begins: Sequence[Array]) -> Fit:
        return fit(problem, model, begins, iterations=iterations, rounds=1, tolerance=1e-4)

    suggested = [t for k in range(len(rival.placed)) for t in starts(model, k, problem.fit_view, rival.theta)]
    if not thorough:
        return fitted(model, [rival.theta, *suggested])
    found = [fitted(model, [rival.theta])]
    if suggested:
        found.append(fitted(model, suggested))
    fresh = _with_new_settings(problem, model, rival.theta)
    if fresh is not None:
        found.append(fitted(*fresh))
    return min(found, key=lambda f: _or_infinite(squares(f, sigma)))


def _with_new_settings(problem: Problem, model: Model, theta: Array) -> tuple[Model, list[Array]] | None:
    """The model with the settings of its last effect read off the problem's recording, and where a search begins; None
    where the settings stay as they are.
    """
    if not model.placed:
        return None
    rest = Model(problem.twin, model.placed[:-1])
    begin = rest.carry(model, theta, problem.recording)
    placed = prepare(rest, problem.fit_view, begin, model.placed[-1])
    if placed.settings == model.placed[-1].settings:
        return None
    other = Model(problem.twin, (*rest.placed, placed))
    first = other.carry(rest, begin, problem.recording)
    return other, starts(other, len(rest.placed), problem.fit_view, first)


def _or_infinite(value: float) -> float:
    return value if np.isfinite(value) else math.inf


def squares(found: Fit, sigma: Mapping[str, float]) -> float:
    """Sum of the squared residuals of a fit in noise variances, over all outputs."""
    return float(sum(np.sum((r / sigma[o]) ** 2) for o, r in found.residual.items()))


def separation(
    course: Recording, rivals: Sequence[Rival], sigma: Mapping[str, float], iterations: int = 8, floor: float = -1.0,
    *, thorough: bool = False,
) -> float:  # fmt: skip
    """The least separation of any two rivals (``joint``). Ends early once a pair is not above ``floor``."""
    least = math.inf
    for i, a in enumerate(rivals):
        for b in rivals[i + 1 :]:
            ways = ((a, b), (b, a))
            least = min(least, joint(*(distance(course, x, y, sigma, iterations, thorough=thorough) for x, y in ways)))
            if least <= floor:
                return least
    return least


def joint(there: float, back: float) -> float:
    """One separation for the distances of two models from each other.

    Either may be true, so one direction must not stand for the other: the geometric mean of ``1 + D^2``. It is ``D``
    where both are alike. Where one model contains the other, the latter is at no distance from it on any input, and the
    other direction alone is left to be made large.
    """
    return math.sqrt(math.sqrt((1.0 + there**2) * (1.0 + back**2)) - 1.0)


def log_ratio(recording: Recording, a: Rival, b: Rival, sigma: Mapping[str, float]) -> float:
    """Log likelihood of ``a`` less that of ``b`` on a recording, both re-fitted (normal noise, its rms as stated), with
    half the logarithm of the number of samples as the price of a parameter (Schwarz 1978): a model that contains the
    other one must earn what it is free to follow.
    """
    found = [refit(recording, r, sigma, iterations=25, thorough=True) for r in (a, b)]
    left = [squares(f, sigma) for f in found]
    price = 0.5 * math.log(recording.n * len(recording.outputs))
    return 0.5 * (left[1] - left[0]) + price * (found[1].theta.size - found[0].theta.size)


def fitted_rival(problem: Problem, name: str, placed: Sequence[Placed], starts: Sequence[Array]) -> Rival | None:
    """``placed`` fitted to what was recorded, from ``starts``; None where no fit is finite."""
    found = fit(problem, Model(problem.twin, placed), starts)
    return Rival(name, tuple(placed), found.theta) if found.ok and np.isfinite(found.cost) else None
