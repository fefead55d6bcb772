"""Measures how far apart rival models are: the distance of one from another that may re-fit itself.

The distance of ``b`` from ``a`` at an input is ``D = sqrt(min over b's parameters of sum ((y_a - y_b) / sigma)^2)``, in
standard deviations of the noise (Hunter and Reiner 1965; T-optimality: Atkinson and Fedorov 1975). Half its square is
the expected gain in log likelihood of ``a`` over ``b`` when ``a`` is true.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.placed import Placed
from tools.mismatch.plan.situation import problem_of, simulated, with_outputs
from tools.mismatch.recording import Array, Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare, starts

MOST_PLACES = 3


@dataclass(frozen=True)
class Rival:
    """Holds a twin with effects at the parameters that fit the recordings so far. ``name`` lists its effects."""

    name: str
    placed: tuple[Placed, ...]
    theta: Array


def distance(
    course: Recording, a: Rival, b: Rival, sigma: Mapping[str, float], iterations: int = 8, *, thorough: bool = False
) -> float:
    """Return the distance of ``b`` from ``a`` on the inputs of ``course`` after its re-fit, in standard deviations.

    The distance is zero if a model diverges, because such an input is useless. ``thorough``: see ``refit``.
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
    """Fit ``rival`` to a recording with all its parameters, those of the twin as well.

    The search begins at the rival's own parameters and at those that the recording suggests for each effect, because a
    search from a single start may end in a local optimum and overestimate the distance of two models. ``thorough``:
    each start is followed to convergence, and the last effect may sit at another of its places, with settings that are
    read off this recording, as a new diagnosis would do.
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
    if rival.placed:
        rest = Model(problem.twin, rival.placed[:-1])
        elsewhere = best_rival(problem, rest, model, rival.theta, rival.placed[-1].effect.name, iterations)
        if elsewhere is not None:
            found.append(fitted(Model(problem.twin, elsewhere.placed), [elsewhere.theta]))
    return min(found, key=lambda f: _or_infinite(squares(f, sigma)))


def _or_infinite(value: float) -> float:
    return value if np.isfinite(value) else math.inf


def squares(found: Fit, sigma: Mapping[str, float]) -> float:
    """Return the sum of squared residuals of a fit in noise variances, over all outputs."""
    return float(sum(np.sum((r / sigma[o]) ** 2) for o, r in found.residual.items()))


def separation(
    course: Recording, rivals: Sequence[Rival], sigma: Mapping[str, float], iterations: int = 8, floor: float = -1.0,
    *, thorough: bool = False,
) -> float:  # fmt: skip
    """Return the least separation of any two rivals (``separations``)."""
    return min(separations(course, pairs_of(rivals), sigma, iterations, floor, thorough=thorough).values())


def pairs_of(rivals: Sequence[Rival]) -> list[tuple[Rival, Rival]]:
    """Return every two of the rivals, in their order."""
    return list(itertools.combinations(rivals, 2))


def separations(
    course: Recording, pairs: list[tuple[Rival, Rival]], sigma: Mapping[str, float], iterations: int = 8,
    floor: float = -1.0, *, thorough: bool = False,
) -> dict[str, float]:  # fmt: skip
    """Return the separation of every pair (``joint``), by "one / other", or of the first alone that is not above
    ``floor``.

    Every re-fit bounds a distance from above, so thorough ones are made only where quick ones of all pairs lie above
    ``floor``, the closest pair first. A pair that is not above it moves to the front of ``pairs``: it is the likeliest
    to decide the next input, too.
    """
    bounds = [[math.inf, math.inf] for _ in pairs]
    found = [math.inf for _ in pairs]
    for careful in (False, True) if thorough and floor > 0.0 else (thorough,):
        for k in sorted(range(len(pairs)), key=found.__getitem__):
            a, b = pairs[k]
            for way, (x, y) in enumerate(((a, b), (b, a))):
                again = distance(course, x, y, sigma, iterations, thorough=careful)
                bounds[k][way] = min(bounds[k][way], again)
                found[k] = joint(*bounds[k])
                if found[k] <= floor:
                    pairs.insert(0, pairs.pop(k))
                    return {_label(a, b): found[k]}
    return {_label(a, b): d for (a, b), d in zip(pairs, found, strict=True)}


def _label(a: Rival, b: Rival) -> str:
    return f"{a.name} / {b.name}"


def joint(forward: float, back: float) -> float:
    """Combine the distances of two models from each other to a separation, by the geometric mean of ``1 + D^2``.

    Either model may be true, so both directions count. The separation is ``D`` where both distances are equal. If one
    model contains the other, the distance of the larger one is zero on any input and the other direction alone counts.
    """
    return math.sqrt(math.sqrt((1.0 + forward**2) * (1.0 + back**2)) - 1.0)


def evidence(recording: Recording, a: Rival, b: Rival, sigma: Mapping[str, float]) -> tuple[float, float]:
    """Return the evidence of a waveform for ``a`` over ``b``, and for ``b`` over ``a``, both re-fitted.

    It is the difference of log likelihoods (normal noise of known rms). A price of parameters is not in it, because it
    would favour the smaller model on an input that moves neither. Where the favoured model has more parameters than the
    other, half of each is taken off: what they are expected to gain from noise alone.
    """
    found = [refit(recording, r, sigma, iterations=25, thorough=True) for r in (a, b)]
    gain = 0.5 * (squares(found[1], sigma) - squares(found[0], sigma))
    spare = found[0].theta.size - found[1].theta.size
    return gain - 0.5 * max(0, spare), -gain - 0.5 * max(0, -spare)


def best_rival(
    problem: Problem, rest: Model, full: Model, theta: Array, name: str, iterations: int = 25
) -> Rival | None:
    """Return the effect ``name`` beside those of ``rest`` at the place where it leaves least.

    None where it cannot be placed or fitted.
    """
    recording = problem.recording
    begin = rest.carry(full, theta, recording)
    best: tuple[float, Rival] | None = None
    for place in sites(problem.twin, recording, EFFECTS[name], rest.placed)[:MOST_PLACES]:
        placed = prepare(rest, problem.fit_view, begin, place)
        model = Model(problem.twin, (*rest.placed, placed))
        first = model.carry(rest, begin, recording)
        begins = starts(model, len(rest.placed), problem.fit_view, first)
        rival = fitted_rival(problem, name, model.placed, begins, iterations)
        if rival is None:
            continue
        left = model.residual(problem.view, rival.theta)
        cost = float(sum(np.mean((left[o] / problem.sigma(o)) ** 2) for o in left))
        if best is None or cost < best[0]:
            best = (cost, rival)
    return best[1] if best is not None else None


def fitted_rival(
    problem: Problem, name: str, placed: Sequence[Placed], begins: Sequence[Array], iterations: int = 25
) -> Rival | None:
    """Return ``placed`` fitted to the recording from ``begins``, None where no fit is finite."""
    found = fit(problem, Model(problem.twin, placed), begins, iterations=iterations)
    return Rival(name, tuple(placed), found.theta) if found.ok and np.isfinite(found.cost) else None
