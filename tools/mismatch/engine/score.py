"""Compares two models on held-out data: which is better, and by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.mismatch.engine.colour import Whitener, fit_whitener, whiten
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import robust_scale

Span = tuple[int, int]

CLIP = 30.0  # limit in robust scales; the same outlier in two models cancels in their difference
CLIP_WHITE = 8.0


@dataclass(frozen=True)
class Comparison:
    """Compares a larger model with a smaller one on held-out samples.

    ``z``: whitened correlation of the larger model's change with the smaller one's residual, standard normal under the
    null hypothesis (the direction was learned on other data, so it is unbiased). The rest is over the outputs that
    change: ``before`` and ``after`` are mean squares over noise variance per output; ``effect_rms`` is the rms of the
    change per output.
    """

    z: float
    before: dict[str, float]
    after: dict[str, float]
    effect_rms: dict[str, float]

    @property
    def gain(self) -> float:
        """Return the largest removed share of the mean square over the outputs."""
        return max((1 - self.after[o] / max(b, 1e-300) for o, b in self.before.items()), default=0.0)


def winsorised(r: Array, floor: float, lively: NDArray[np.bool_] | None = None) -> Array:
    """Return the residual clipped at thirty robust scales, except for samples that respond to a jump of the input."""
    limit = CLIP * robust_scale(r, floor)
    clipped = np.clip(r, -limit, limit)
    return clipped if lively is None else np.where(lively, r, clipped)


def held_rms(problem: Problem, fitted: Fit) -> dict[str, float]:
    """Return the rms of the residual per output on held-out samples."""
    rows = problem.held_rows
    return {o: float(np.sqrt(np.mean(r[rows] ** 2))) for o, r in fitted.residual.items()}


def fit_rms(problem: Problem, fitted: Fit) -> dict[str, float]:
    """Return the rms of the residual per output on fitted samples."""
    rows = problem.fit_rows
    return {o: float(np.sqrt(np.mean(r[rows] ** 2))) for o, r in fitted.residual.items()}


def misfits(problem: Problem, fitted: Fit) -> dict[str, float]:
    """Return the mean square over noise variance on held-out samples, per output; 1 is perfect."""
    rows = problem.held_rows
    out: dict[str, float] = {}
    for o in problem.twin.outputs:
        s = problem.sigma(o)
        r = winsorised(fitted.residual[o][rows], s, problem.lively[rows])
        out[o] = float(np.mean((r / s) ** 2)) if fitted.ok else np.inf
    return out


def misfit(problem: Problem, fitted: Fit) -> float:
    """Return the mean over outputs of the mean square over noise variance on held-out samples."""
    return float(np.mean(list(misfits(problem, fitted).values())))


def whiteners(problem: Problem, fitted: Fit) -> dict[str, Whitener]:
    """Return the whitening filters of a model's residual from held-out samples, which no fit has flattened."""
    spans = problem.held_spans
    return {o: fit_whitener(r, stretches=spans) for o, r in fitted.residual.items()}


def direction_z(
    problem: Problem, small: Fit, change: dict[str, Array], filters: dict[str, Whitener], spans: list[Span]
) -> float:
    """Return the whitened correlation of ``change`` (by a larger model) with the residual of ``small``."""
    top = bottom = 0.0
    for o in problem.twin.outputs:
        r, d = small.residual[o], change[o]
        if not np.any(d):
            continue
        f = filters[o]
        usable = [s for s in spans if s[1] - s[0] > f.warm_up + 4]
        if not usable:
            f = Whitener(float(np.std(r)))
            usable = spans
        white = whiten(f, r, usable)
        moved = whiten(f, d, usable)
        s = 1.4826 * float(np.median(np.abs(white))) or 1.0
        white = white / s
        lively = np.concatenate([problem.lively[a + f.warm_up : b] for a, b in usable])
        white = np.where(lively, white, np.clip(white, -CLIP_WHITE, CLIP_WHITE))
        spread = max(float(np.std(white)), 1.0)
        top += float(white @ moved) / (s * spread)
        bottom += float(moved @ moved) / s**2
    return top / np.sqrt(bottom) if bottom > 0 else 0.0


def compare(problem: Problem, small: Fit, large: Fit) -> Comparison:
    """Compute all figures that decide between a model and a larger one."""
    filters = whiteners(problem, large)
    change = {o: small.residual[o] - large.residual[o] for o in problem.twin.outputs}
    z = direction_z(problem, small, change, filters, problem.held_spans)
    rows = problem.held_rows
    effect = {o: float(np.std(change[o][rows])) for o in problem.twin.outputs}
    before, after = misfits(problem, small), misfits(problem, large)
    moved = [o for o in problem.twin.outputs if effect[o] > 1e-3 * problem.sigma(o)]
    return Comparison(z, {o: before[o] for o in moved}, {o: after[o] for o in moved}, effect)
