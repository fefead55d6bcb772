"""What is left and fits nothing: what it follows, how strongly, and whether that is enough to say so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.locate import follow, follow_size
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import winsorised


@dataclass(frozen=True)
class Leftover:
    """Per output: ``ratio`` residual mean square over noise variance on held-out samples, ``follows`` what the
    residual follows (strongest first), ``memory_p`` the p-value that history adds nothing, ``real`` whether it
    is more than noise of whatever colour.
    """

    output: str
    ratio: float
    follows: tuple[Dependence, ...]
    memory_p: float
    real: bool


def leftover(
    problem: Problem, fitted: Fit, output: str, *, p_limit: float = 1e-6, least: float = 0.03, least_size: float = 0.05
) -> Leftover:
    """Judge what one output has left."""
    s = problem.sigma(output)
    r = winsorised(fitted.residual[output][problem.held_rows], s)
    ratio = float(np.mean((r / s) ** 2))
    found, memory = follow(problem, fitted, output)
    said = [d for d in found if d.p_value < p_limit and d.strength > least]
    followed = any(d.feature != "time itself" for d in said)
    if not followed:
        sizes = [d for d in follow_size(problem, fitted, output) if d.p_value < p_limit and d.strength > least_size]
        followed = bool(sizes)
        said += sizes
    loud = problem.floors[output].declared and ratio > 1.5
    if loud and not said:
        said = found[:1]
    return Leftover(output, ratio, tuple(said), memory, bool(followed or loud))
