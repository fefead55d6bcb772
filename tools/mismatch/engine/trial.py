"""Adds candidates to a model and judges them, many candidates in parallel processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tools.mismatch.engine.fit import ROUGH, Fit, fit
from tools.mismatch.engine.linearised import fit_beside
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import Comparison, compare, misfits
from tools.mismatch.engine.screen import Candidate, Ground, bend, is_wide, one_step
from tools.mismatch.engine.vary import with_balance
from tools.mismatch.engine.workers import mapped
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

Array = np.ndarray
Progress = Callable[[str, int, int], None]

LEAST_SHARE = 0.004  # least share of the residual's mean square that one step must explain
LEAST_FITS = 3  # number of candidates per output that are fitted independent of their share
MOST_FITS = 7
NEAR_TOP = 0.3
CLEAR_P = 1e-7
TRIAL_ROWS = 12_000  # number of rows, over all outputs, of a candidate's fit; accepted ones are fitted on every row


@dataclass(frozen=True)
class Effort:
    """Limits the effort on a candidate.

    A candidate is not refined if it gains less than ``share`` of the best one-step gain in log density, or less than
    ``least`` (a share of the mean square of its outputs). ``stride`` thins the rows of its fit.
    """

    share: float
    least: float
    stride: int = 1

    def most_left(self, top: float) -> float:
        """Return the largest share of an output's mean square that a refined candidate may leave.

        One step of the best candidate explains ``top``; the log density falls with the logarithm of the rest.
        """
        return min((1.0 - min(top, MOST_TOP)) ** self.share, 1.0 - self.least)


MOST_TOP = 0.999
"""Largest share of an output's mean square that one step is credited with; the rest is noise."""


@dataclass(frozen=True)
class Trial:
    """Holds a candidate's outcome: ``fitted`` is None if the screen dropped it.

    ``misfits`` are per output on held-out samples (1 is perfect).
    """

    placed: Placed
    candidate: Candidate
    fitted: Fit | None
    comparison: Comparison | None
    misfits: dict[str, float]

    @property
    def name(self) -> str:
        return self.placed.effect.name


def extended(problem: Problem, current: Fit, placed: Placed) -> tuple[Model, Array]:
    """Return the model of ``current`` with one more effect, and its parameters carried over."""
    model = Model(problem.twin, (*current.model.placed, placed))
    return model, model.carry(current.model, current.theta, problem.recording)


def screen_one(problem: Problem, current: Fit, place: Placed, ground: Ground) -> Candidate:
    """Screen a candidate by one step."""
    return one_step(problem, current, place, ground)


def fit_one(
    problem: Problem,
    current: Fit,
    candidate: Candidate,
    ground: Ground,
    tops: dict[str, float],
    effort: Effort,
) -> Trial:
    """Fit a candidate jointly with the current model and compare them on held-out samples.

    ``tops``: the best one-step share per output; a candidate far below it is not refined, as ``effort`` states.
    """
    model, _ = extended(problem, current, candidate.placed)
    rows = problem.fit_rows
    touched = candidate.placed.outputs
    now = {o: float(np.mean((current.residual[o][rows] / problem.sigma(o)) ** 2)) for o in model.together(touched)}
    gone = max((1.0 - effort.most_left(tops[o])) * now[o] for o in touched)
    limit = (sum(now.values()) - gone) / len(now)
    if is_wide(problem, current.model):
        fitted = fit_beside(problem, model, current, ground, candidate.starts, hopeless=limit)
        return Trial(candidate.placed, candidate, fitted, compare(problem, current, fitted), misfits(problem, fitted))
    thin = max(effort.stride, rows.size * len(now) // TRIAL_ROWS)
    begin = with_balance(problem, model, candidate.starts)
    fitted = fit(
        problem, model, begin, stride=thin, iterations=20, tolerance=ROUGH, hopeless=limit,
        keep=current, touched=touched,
    )  # fmt: skip
    comparison = compare(problem, current, fitted)
    return Trial(candidate.placed, candidate, fitted, comparison, misfits(problem, fitted))


def freedom(candidate: Candidate) -> int:
    """Return the number of parameters of an effect."""
    parts = candidate.placed.parts
    return len(parts.nonlinear) + len(parts.weights)


def vouched(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Give all forms of an effect at a place the clearest of their own tests, corrected for the number of forms."""
    tests: dict[tuple[str, ...], list[float]] = {}
    place = lambda c: (c.placed.effect.name, c.placed.site, c.placed.target)  # noqa: E731
    for c in candidates:
        if c.tested:
            tests.setdefault(place(c), []).append(c.p_value)
    best = {k: min(1.0, len(p) * min(p)) for k, p in tests.items()}
    return [replace(c, p_value=best[place(c)]) if c.tested else c for c in candidates]


def hopeful(candidates: Sequence[Candidate], least: int = LEAST_FITS, most: int = MOST_FITS) -> list[bool]:
    """Select the candidates for a fit: per output the best by their one-step share.

    Specific effects, flexible families (which one step overestimates) and events or noise with a test of their own are
    ranked separately (of each ``least``, and up to ``most`` that are near the best). Those inside the equations have a
    rank of their own as well: one step underestimates an outflow beside which the base moves far. Candidates that are
    clear by their own test are added, and those that it refuses are not fitted. Forms of an effect share one rank.
    """
    keep = [False] * len(candidates)
    outputs = sorted({o for c in candidates for o in c.placed.outputs})
    kinds = ["tested" if c.tested else "flexible" if freedom(c) > 4 else "specific" for c in candidates]
    inside = ["inside" if c.placed.site == "feedback" and not c.tested else "" for c in candidates]
    for o in outputs:
        for kind in ("specific", "flexible", "tested", "inside"):
            of = inside if kind == "inside" else kinds
            here = [i for i, c in enumerate(candidates) if o in c.placed.outputs and of[i] == kind and not c.refused]
            here.sort(key=lambda i: (-candidates[i].share, candidates[i].placed.label))
            top = candidates[here[0]].share if here else 0.0
            names = list(dict.fromkeys(candidates[i].placed.effect.name for i in here))
            for i in here:
                share, rank = candidates[i].share, names.index(candidates[i].placed.effect.name)
                near = share > NEAR_TOP * top and rank < most
                if share > LEAST_SHARE and (rank < least or near):
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
    effort: Effort,
    progress: Progress | None = None,
    what: str = "candidates",
    least: int = LEAST_FITS,
    most: int = MOST_FITS,
) -> list[Trial]:
    """Screen every candidate and fit the ``hopeful`` ones. The result does not depend on ``jobs``."""

    def run(function: Callable[..., Any], items: Sequence[Any], extra: tuple[Any, ...], label: str) -> list[Any]:
        work = [(problem, current, item, *extra) for item in items]
        report_progress = progress  # the type checker keeps it in the closure
        tell = (lambda done: report_progress(label, done, len(items))) if report_progress else None
        return mapped(problem, function, work, jobs, long=False, tell=tell)

    with np.errstate(all="ignore"):
        ground = bend(problem, current)
    screened: list[Candidate] = run(screen_one, candidates, (ground,), f"{what}: screen")
    screened = vouched(screened)
    keep = hopeful(screened, least, most)
    chosen = [c for c, k in zip(screened, keep, strict=True) if k]
    tops = dict.fromkeys(problem.twin.outputs, 0.0)
    # shares are of the mean square of all outputs; one output may have little of it
    part = _parts(problem, current)
    for c in chosen:
        for o in c.placed.outputs:
            tops[o] = max(tops[o], c.share / len(c.placed.outputs) / part[o])
    fitted = iter(run(fit_one, chosen, (ground, tops, replace(effort, stride=stride)), f"{what}: fit"))
    return [next(fitted) if k else Trial(c.placed, c, None, None, {}) for c, k in zip(screened, keep, strict=True)]


def _parts(problem: Problem, current: Fit) -> dict[str, float]:
    """Return the share of every output in the residual of ``current`` on fitted samples, in noise variances."""
    rows = problem.fit_rows
    left = {o: float(np.mean((r[rows] / problem.sigma(o)) ** 2)) for o, r in current.residual.items()}
    total = max(sum(left.values()), 1e-300)
    return {o: max(v / total, 1e-12) for o, v in left.items()}
