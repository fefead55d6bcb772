"""Which effects are named: forward selection on held-out scores, pairs, pruning, swaps, and parsimony."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import Comparison, block_energy, compare, misfit, paired_t
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import Progress, Trial, try_all
from tools.mismatch.simulate import Model, Placed


@dataclass(frozen=True)
class Rule:
    """The margins of a decision; calibrated on null simulations (docs/mismatch-calibration.md).

    ``z`` whitened held-out correlation in standard deviations, over all candidates and places; ``gain`` least
    share of the mean square; ``excess`` least share of what stands above the noise; ``form`` share of what is
    already explained below which a leftover counts as the accepted effect's own form; ``tie`` excess of a rival
    relative to the best at which fewer parameters win.
    """

    z: float = 5.5
    gain: float = 0.04
    excess: float = 0.08
    form: float = 0.02
    tie: float = 1.3
    p_tested: float = 1e-7
    most: int = 4


@dataclass(frozen=True)
class Selection:
    """``fitted`` the model with everything accepted, ``steps`` the accepted trials in order, ``rivals`` per step
    the other trials, best first; ``first`` all trials against the recalibrated base.
    """

    base: Fit
    fitted: Fit
    steps: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    first: tuple[Trial, ...] = field(default=())


def acceptable(problem: Problem, trial: Trial, rule: Rule, explained: float) -> bool:
    """May this effect be named at all: better on held-out data by more than chance and by more than a trifle."""
    c = trial.comparison
    if trial.fitted is None or c is None or not trial.fitted.ok:
        return False
    if trial.placed.effect.stochastic or trial.candidate.tested:
        return trial.candidate.p_value < rule.p_tested and trial.candidate.share > rule.gain
    return c.z > rule.z and c.gain > rule.gain and c.excess_gain > rule.excess and c.gain * 1.0 > rule.form * explained


def search(
    problem: Problem,
    base: Fit,
    effects: Iterable[Effect],
    *,
    rule: Rule | None = None,
    stride: int = 1,
    jobs: int = 1,
    progress: Progress | None = None,
) -> Selection:
    """Forward selection, then pruning and swaps."""
    rule = rule or Rule()
    effects = tuple(effects)
    current = base
    steps: list[Trial] = []
    rivals: list[tuple[Trial, ...]] = []
    first: tuple[Trial, ...] = ()
    while len(steps) < rule.most * len(problem.twin.outputs):
        pool = places(problem, effects, current.model.placed)
        trials = try_all(
            problem, current, pool, stride=stride, jobs=jobs, progress=progress, what=f"step {len(steps) + 1}"
        )
        if not steps:
            first = tuple(trials)
        start = misfit(problem, base)
        explained = max(start - misfit(problem, current), 0.0) / max(misfit(problem, current), 1e-12)
        good = [t for t in trials if acceptable(problem, t, rule, explained)]
        if not good:
            break
        best = choose(problem, good, rule)
        refined = refine(problem, best)
        steps.append(refined)
        rivals.append(tuple(sorted((t for t in good if t is not best), key=lambda t: t.misfit)))
        assert refined.fitted is not None
        current = refined.fitted
        if misfit(problem, current) < 1.0 + 0.5 * rule.gain:
            break
    return Selection(base, current, tuple(steps), tuple(rivals), first)


def choose(problem: Problem, good: Sequence[Trial], rule: Rule) -> Trial:
    """The best on held-out data, or a simpler one that is as good."""
    order = sorted(good, key=lambda t: (t.misfit, t.label))
    best = order[0]
    near = [t for t in order if t is best or as_good(problem, t, best, rule)]
    return min(near, key=lambda t: (complexity(t), t.misfit, t.label))


def as_good(problem: Problem, rival: Trial, best: Trial, rule: Rule) -> bool:
    """Is the rival within error of the best: not significantly worse over blocks, or worse by a trifle."""
    if not np.isfinite(rival.misfit):
        return False
    t = paired_t(rival.energy, best.energy)
    excess_best = max(best.misfit - 1.0, 0.0)
    excess_rival = max(rival.misfit - 1.0, 0.0)
    trifle = excess_rival <= rule.tie * excess_best + 0.02
    close = excess_rival <= 2.0 * excess_best + 0.1
    return trifle or (close and t < 2.0)


def complexity(trial: Trial) -> float:
    """How much freedom an effect has."""
    return trial.parameters


def refine(problem: Problem, trial: Trial) -> Trial:
    """The same trial fitted on every row."""
    assert trial.fitted is not None
    fitted = fit(problem, trial.fitted.model, [trial.fitted.theta], stride=1, iterations=15)
    return replace(
        trial, fitted=fitted, misfit=misfit(problem, fitted), energy=block_energy(problem, fitted, problem.held_blocks)
    )


def without(problem: Problem, fitted: Fit, k: int) -> Fit:
    """The fit without its k-th effect, everything else fitted again."""
    placed = [p for j, p in enumerate(fitted.model.placed) if j != k]
    model = Model(problem.twin, placed)
    return fit(problem, model, [model.carry(fitted.model, fitted.theta, problem.recording)], stride=2, iterations=12)


def contribution(problem: Problem, fitted: Fit, k: int) -> tuple[Fit, Comparison]:
    """What the k-th effect is worth beside all others."""
    small = without(problem, fitted, k)
    return small, compare(problem, small, fitted)


__all__ = ["Placed", "Rule", "Selection", "acceptable", "choose", "contribution", "refine", "search", "without"]
