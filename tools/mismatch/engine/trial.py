"""One candidate added to a model and judged; many candidates in parallel processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed

from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import Comparison, block_energy, compare, misfits
from tools.mismatch.engine.screen import Candidate, one_step
from tools.mismatch.simulate import Model, Placed

Array = np.ndarray
Progress = Callable[[str, int, int], None]

LEAST_SHARE = 0.004
LEAST_P = 1e-3


@dataclass(frozen=True)
class Trial:
    """A candidate's outcome: ``fitted`` is None when the screen let it drop. ``misfits`` per output on held-out
    samples (1 is perfect), ``energy`` (blocks, outputs) of held-out blocks, ``parameters`` how many it adds.
    """

    placed: Placed
    candidate: Candidate
    fitted: Fit | None
    comparison: Comparison | None
    misfits: dict[str, float]
    energy: Array
    parameters: int

    @property
    def name(self) -> str:
        return self.placed.effect.name

    @property
    def improvement(self) -> float:
        """Held-out mean square over noise variance that goes."""
        return self.comparison.improvement if self.comparison else -np.inf

    @property
    def label(self) -> str:
        return self.placed.label


def extended(problem: Problem, current: Fit, placed: Placed) -> tuple[Model, Array]:
    """The model of ``current`` with one more effect, and its parameters carried over."""
    model = Model(problem.twin, (*current.model.placed, placed))
    return model, model.carry(current.model, current.theta, problem.recording)


def try_one(problem: Problem, current: Fit, place: Placed, stride: int, always: bool = False) -> Trial:
    """Screen one candidate, fit it jointly with everything that is there, compare on held-out samples."""
    problem = problem.fresh()
    with np.errstate(all="ignore"):
        candidate = one_step(problem, current, place)
        hopeful = always or candidate.share > LEAST_SHARE or candidate.p_value < LEAST_P
        if not hopeful:
            return Trial(candidate.placed, candidate, None, None, {}, np.empty((0, 0)), 0)
        model, _ = extended(problem, current, candidate.placed)
        fitted = fit(problem, model, list(candidate.starts), stride=stride, iterations=12)
        comparison = compare(problem, current, fitted)
        value = misfits(problem, fitted)
        energy = block_energy(problem, fitted, problem.held_blocks)
    added = len(model.parameters) - len(current.model.parameters)
    return Trial(candidate.placed, candidate, fitted, comparison, value, energy, added)


def try_all(
    problem: Problem,
    current: Fit,
    candidates: Sequence[Placed],
    *,
    stride: int,
    jobs: int,
    progress: Progress | None = None,
    what: str = "candidates",
) -> list[Trial]:
    """Every candidate tried. The answer does not depend on ``jobs``."""
    heavy = problem.recording.n * len(problem.twin.outputs) * len(candidates) > 3_000_000
    if jobs > 1 and heavy and len(candidates) > 2:
        work = (delayed(try_one)(problem, current, c, stride) for c in candidates)
        found: list[Trial] = []
        for trial in Parallel(n_jobs=jobs, return_as="generator", batch_size=1)(work):  # type: ignore[union-attr]
            found.append(trial)
            if progress:
                progress(what, len(found), len(candidates))
        return found
    found = []
    for c in candidates:
        found.append(try_one(problem, current, c, stride))
        if progress:
            progress(what, len(found), len(candidates))
    return found
