"""One candidate added to a model and judged; many candidates in parallel processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import Comparison, block_energy, compare, misfits
from tools.mismatch.engine.screen import Candidate, Ground, bend, one_step
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

Array = np.ndarray
Progress = Callable[[str, int, int], None]

LEAST_SHARE = 0.004  # of the residual's mean square, by one step
LEAST_FITS = 3  # per output, whatever their share
MOST_FITS = 7
NEAR_TOP = 0.3
CLEAR_P = 1e-7
LEAST_P = 1e-3
PARALLEL_WORK = 4_000_000  # samples times candidates above which processes pay
TRIAL_ROWS = 12_000  # over all outputs, that a candidate is fitted on; who is accepted is fitted on every row


@dataclass(frozen=True)
class Trial:
    """A candidate's outcome: ``fitted`` is None when the screen let it drop. ``misfits`` per output on held-out
    samples (1 is perfect), ``energy`` (blocks, outputs) of held-out blocks, ``parameters`` how many it adds;
    ``outputs`` names the columns of ``energy``.
    """

    placed: Placed
    candidate: Candidate
    fitted: Fit | None
    comparison: Comparison | None
    misfits: dict[str, float]
    energy: Array
    parameters: int
    outputs: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.placed.effect.name

    @property
    def refused(self) -> bool:
        """Whether the effect's own test finds nothing of it: then no fit, alone or with others, makes it a name."""
        return self.candidate.tested and self.candidate.p_value > LEAST_P

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


def screen_one(problem: Problem, current: Fit, place: Placed, ground: Ground) -> Candidate:
    """One step of one candidate."""
    with np.errstate(all="ignore"), threadpool_limits(1):
        return one_step(problem, current, place, ground)


def fit_one(problem: Problem, current: Fit, candidate: Candidate, stride: int, tops: dict[str, float]) -> Trial:
    """Fit one candidate jointly with everything that is there, compare on held-out samples.

    ``tops``: the best one-step share per output; who stays far below it is not refined.
    """
    with np.errstate(all="ignore"), threadpool_limits(1):
        model, _ = extended(problem, current, candidate.placed)
        rows = problem.fit_rows
        touched = candidate.placed.outputs
        now = {o: float(np.mean((current.residual[o][rows] / problem.sigma(o)) ** 2)) for o in model.together(touched)}
        gone = max(0.5 * tops[o] * now[o] for o in touched)
        limit = (sum(now.values()) - gone) / len(now)
        thin = max(stride, rows.size * len(now) // TRIAL_ROWS)
        fitted = fit(
            problem, model, candidate.starts, stride=thin, iterations=20, tolerance=1e-4, hopeless=limit,
            keep=current, touched=touched,
        )  # fmt: skip
        comparison = compare(problem, current, fitted)
        value = misfits(problem, fitted)
        energy = block_energy(problem, fitted, problem.held_blocks)
    added = len(model.parameters) - len(current.model.parameters)
    return Trial(candidate.placed, candidate, fitted, comparison, value, energy, added, problem.twin.outputs)


def freedom(candidate: Candidate) -> int:
    """How many parameters an effect brings."""
    parts = candidate.placed.parts
    return len(parts.nonlinear) + len(parts.weights)


def hopeful(candidates: Sequence[Candidate]) -> list[bool]:
    """Which candidates deserve a fit: per output the best by their one-step share, specific effects and flexible
    families ranked apart (one step flatters the latter), and whatever has a clear test of its own.
    """
    keep = [False] * len(candidates)
    outputs = sorted({o for c in candidates for o in c.placed.outputs})
    for o in outputs:
        for flexible in (False, True):
            here = [i for i, c in enumerate(candidates) if o in c.placed.outputs and (freedom(c) > 4) == flexible]
            here.sort(key=lambda i: (-candidates[i].share, candidates[i].placed.label))
            top = candidates[here[0]].share if here else 0.0
            for rank, i in enumerate(here):
                share = candidates[i].share
                near = share > NEAR_TOP * top and rank < MOST_FITS
                if share > LEAST_SHARE and (rank < LEAST_FITS or near):
                    keep[i] = True
    for i, c in enumerate(candidates):
        if c.tested and c.p_value < CLEAR_P:
            keep[i] = True
    return keep


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
    """Every candidate screened, the hopeful ones fitted. The answer does not depend on ``jobs``."""
    heavy = problem.recording.n * len(problem.twin.outputs) * len(candidates) > PARALLEL_WORK
    parallel = Parallel(n_jobs=jobs, return_as="generator") if jobs > 1 and heavy else None

    def run(function: Callable[..., Any], items: Sequence[Any], extra: tuple[Any, ...], label: str) -> list[Any]:
        work = ((problem, current, item, *extra) for item in items)
        if parallel is not None and len(items) > 2:
            stream = parallel(delayed(function)(*w) for w in work)
        else:
            stream = (function(*w) for w in work)
        found: list[Any] = []
        for result in stream:
            found.append(result)
            if progress:
                progress(label, len(found), len(items))
        return found

    with np.errstate(all="ignore"):
        ground = bend(problem, current)
    screened: list[Candidate] = run(screen_one, candidates, (ground,), f"{what}: screen")
    keep = hopeful(screened)
    chosen = [c for c, k in zip(screened, keep, strict=True) if k]
    tops = dict.fromkeys(problem.twin.outputs, 0.0)
    for c in chosen:
        for o in c.placed.outputs:
            tops[o] = max(tops[o], c.share / len(c.placed.outputs))
    fitted = iter(run(fit_one, chosen, (stride, tops), f"{what}: fit"))
    return [
        next(fitted) if k else Trial(c.placed, c, None, None, {}, np.empty((0, 0)), 0)
        for c, k in zip(screened, keep, strict=True)
    ]
