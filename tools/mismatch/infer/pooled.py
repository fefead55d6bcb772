"""Scores sets of effects on every one of several recordings, each predicted by a fit that left it out.

A search scores on the recordings that its split holds out. Its decision would rest on those few alone, and an effect
that they hardly show would be lost. Here the folds of a cross-validation cover all recordings (Stone, J. Royal Stat.
Soc. B 36, 1974, 111), so that the evidence is the sum over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hal.arrays import Array
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.many import everything
from tools.mismatch.engine.pose import Posed
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.split import Split, cut, leave_out
from tools.mismatch.engine.workers import mapped
from tools.mismatch.infer.constants import Constants
from tools.mismatch.infer.search import Found
from tools.mismatch.infer.store import Scored, Store
from tools.mismatch.simulate import Model

FOLDS = 4
"""Largest number of fits of a set that leave recordings out: the computing time grows with their length only."""
CARRIED = 8
"""Number of sets of a search, best first, that are scored on all recordings."""
ITERATIONS = 10
"""Most iterations of a fit that leaves recordings out; it starts from the fit to all."""


def pooled(problem: Problem) -> Problem:
    """Return the problem with every recording both fitted and held out: its residuals are cross-validated."""
    spans = everything(problem).split.fit
    held = tuple((a + problem.init, b) for a, b in spans)
    return replace(
        problem, split=Split(problem.recording.n, spans, held, cut(held, 30), cut(spans, 48), own=False), hints=()
    )


def folds_of(problem: Problem) -> tuple[Problem, ...]:
    """Return the problems of the folds, which together hold out every recording of a pooled ``problem`` once.

    Neighbours are in different folds, because recordings may change in the course of time.
    """
    spans = problem.split.fit
    count = min(FOLDS, len(spans))
    n = problem.recording.n
    return tuple(
        replace(problem, split=leave_out(n, spans, range(k, len(spans), count), init=problem.init))
        for k in range(count)
    )


def left_out(problem: Problem, model: Model, theta: Array, k: int) -> tuple[dict[str, Array], bool]:
    """Fit fold ``k`` from ``theta`` and return the residuals of its held-out rows, and False if the fit failed."""
    fold = folds_of(problem)[k]
    again = fit(fold, model, [theta], iterations=ITERATIONS)
    residual = again.residual if again.ok else residuals(fold, model, theta)
    return {o: r[fold.held_rows] for o, r in residual.items()}, again.ok


class PooledStore(Store):
    """Holds sets of effects whose residuals are those of cross-validation over the recordings.

    A fit that is put into the store is to all recordings, and keeps its parameters.
    """

    def __init__(
        self, problem: Problem, base: Fit, constants: Constants, effects: Sequence[Effect] = (), jobs: int = 1
    ) -> None:
        self.jobs = jobs
        super().__init__(problem, base, constants, effects)

    def scored(self, fitted: Fit) -> Scored:
        """Score a fit by its cross-validated residual, without storing it."""
        return super().scored(self.cross_validated(fitted))

    def cross_validated(self, fitted: Fit) -> Fit:
        """Return ``fitted`` with each recording's residual of the fit that left it out; it is not ok if one failed.

        Parameters as given are returned unchanged, since they have seen no recording.
        """
        if not fitted.model.placed and np.array_equal(fitted.theta, self.problem.given):
            return fitted
        # made anew for each set, because the views of a problem keep columns
        folds = folds_of(self.problem)
        work = [(self.problem, fitted.model, fitted.theta, k) for k in range(len(folds))]
        found = mapped(self.problem, left_out, work, self.jobs)
        residual = {o: r.copy() for o, r in fitted.residual.items()}
        for fold, (left, _) in zip(folds, found, strict=True):
            for o, r in left.items():
                residual[o][fold.held_rows] = r
        ok = fitted.ok and (not fitted.model.placed or all(fine for _, fine in found))
        return replace(fitted, residual=residual, ok=ok)


def pool(found: Found, posed: Posed, jobs: int = 1) -> tuple[Found, Posed]:
    """Return the best sets of a search, fitted to all recordings and scored on each, and ``posed`` with their problem.

    The search ends here: its caches, and the fits of its trials, would be most of the memory of a hundred recordings.
    """
    store, problem = found.store, pooled(found.store.problem)
    best = [s.fitted for s in store.ranked() if s.placed][:CARRIED]
    for searched in (store.problem, posed.problem):
        forget(searched)

    def again(fitted: Fit) -> Fit:
        return fit(problem, fitted.model, [fitted.theta], iterations=15)

    out = PooledStore(problem, again(store.base.fitted), store.constants, store.effects, jobs)
    out.seen = dict(store.seen)
    store.sets.clear()
    store.eventful.clear()
    for fitted in best:
        out.put(again(fitted))
    return Found(out, tuple(replace(t, fitted=None) for t in found.first)), replace(posed, problem=problem)


def forget(problem: Problem) -> None:
    """Empty the caches of the views of a problem, and of its opening."""
    made = vars(problem)
    for view in (made.get("view"), made.get("fit_view")):
        if view is not None:
            view.memo.clear()
    if made.get("opening") is not None:
        forget(made["opening"])
