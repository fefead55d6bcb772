"""Keeps undetermined parameters near the engineer's own values, and checks the requirements on every fit.

A weak normal prior on the base parameters is centred on the values of the recording's twin. It does not move parameters
that the data determine (its weight is below that of one sample). Undetermined ones stay as given: a parameter that no
output depends on, an offset beside an integrator, the free directions of a change of coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from tools.mismatch.engine.problem import Problem
from tools.mismatch.placed import Free
from tools.mismatch.simulate import Model

LOG_WIDTH = 1.5
"""Standard deviation of the prior of a parameter that is searched by its logarithm: a factor of 4.5."""
TIMES_GIVEN = 10.0
"""Standard deviation of the prior of any other parameter, in units of the engineer's own value."""
TIMES_SCALE = 1000.0
"""Standard deviation in units of the parameter's typical step, used if it is wider (an offset given as zero)."""
FAR = 1e3
"""Ratio of the residual to the largest recorded value above which a simulation has diverged."""


def to_search(p: Free, v: float) -> float:
    """Return a parameter in its search coordinate: the logarithm if only its size is uncertain."""
    return float(np.log(max(v, 1e-300))) if p.log and p.lo > 0 else v


@dataclass(frozen=True)
class Belief:
    """Holds centre and width (parameters,) of the prior, in search coordinates; an infinite width is no prior."""

    centre: Array
    width: Array


def belief(problem: Problem, model: Model) -> Belief:
    """Return the prior of every parameter of ``model``: normal for base parameters, none for those of effects."""
    centre, width = np.zeros(len(model.parameters)), np.full(len(model.parameters), np.inf)
    given = problem.given
    for i, p in enumerate(model.parameters[: model.n_base]):
        centre[i] = to_search(p, given[i])
        if p.log and p.lo > 0:
            width[i] = LOG_WIDTH
        elif np.isfinite(p.hi - p.lo):
            width[i] = p.hi - p.lo
        else:
            width[i] = max(TIMES_GIVEN * abs(given[i]), TIMES_SCALE * abs(p.scale)) or np.inf
    return Belief(centre, width)


def stayed(problem: Problem, residual: Mapping[str, Array]) -> bool:
    """Return True if a simulation did not diverge: it is finite and within ``FAR`` times the largest recorded value."""
    return all(
        bool(np.all(np.abs(r) <= FAR * float(np.max(np.abs(problem.recording.outputs[o])))))
        for o, r in residual.items()
    )


def fit_loss(problem: Problem, residual: Mapping[str, Array]) -> float:
    """Return the mean square over noise variance on the fitted samples, averaged over outputs, without weights."""
    rows = problem.fit_rows
    return float(np.mean([np.mean((r[rows] / problem.sigma(o)) ** 2) for o, r in residual.items()]))


def broken(problem: Problem, given: Mapping[str, Array], theta: Array, residual: Mapping[str, Array]) -> str:
    """Return the requirement that a fit violates, as a sentence ("" if none).

    ``given``: the residual of the twin as given. An accepted fit is finite, its simulation does not diverge, and it is
    no worse on the fitted samples than the twin as given.
    """
    if not np.all(np.isfinite(theta)):
        return "A fitted parameter was not finite."
    if not stayed(problem, residual):
        return f"The fitted simulation left the recording by more than {FAR:g} times its largest value."
    if stayed(problem, given) and fit_loss(problem, residual) > (1 + 1e-9) * fit_loss(problem, given):
        return "The fit was worse on the fitted samples than the twin as given."
    return ""
