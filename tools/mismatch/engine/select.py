"""Which effects are named: forward selection on held-out scores, pairs, pruning, swaps, and parsimony."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.revise import pair_search, prune, swap_pass
from tools.mismatch.engine.score import block_energy, misfits, paired_t
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import Progress, Trial, try_all
from tools.mismatch.simulate import Model, Placed


@dataclass(frozen=True)
class Rule:
    """The margins of a decision; calibrated on null simulations (docs/mismatch-calibration.md).

    ``z`` whitened held-out correlation in standard deviations, over all candidates and places; ``gain`` least
    share of the mean square; ``excess`` least share of what stands above the noise; ``form`` share of what is
    already explained below which a leftover counts as the accepted effect's own form; ``tie`` excess of a rival
    relative to the best at which fewer parameters win; ``p_tested`` for effects with a test of their own.
    """

    z: float = 5.5
    gain: float = 0.04
    excess: float = 0.25
    form: float = 0.015
    tie: float = 1.3
    p_tested: float = 1e-7
    most: int = 4


@dataclass(frozen=True)
class Selection:
    """``fitted`` the model with everything accepted, ``steps`` the accepted trials in order, ``rivals`` per step
    the other acceptable trials, best first; ``first`` all trials against the recalibrated base.
    """

    base: Fit
    fitted: Fit
    steps: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    first: tuple[Trial, ...] = field(default=())


def acceptable(trial: Trial, rule: Rule, explained: float) -> bool:
    """May this effect be named at all: better on held-out data by more than chance and by more than a trifle.

    ``explained``: mean square over noise variance that earlier effects took on the same outputs.
    """
    c = trial.comparison
    if trial.fitted is None or c is None or not trial.fitted.ok:
        return False
    if trial.placed.effect.claims is not None:
        return trial.candidate.p_value < rule.p_tested and trial.candidate.share > 0.2
    if trial.candidate.tested and trial.candidate.p_value > 1e-3:
        return False
    return c.z > rule.z and c.gain > rule.gain and c.excess_gain > rule.excess and c.improvement > rule.form * explained


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
    """Forward selection."""
    rule = rule or Rule()
    effects = tuple(effects)
    current = base
    start = misfits(problem, base)
    steps: list[Trial] = []
    rivals: list[tuple[Trial, ...]] = []
    first: tuple[Trial, ...] = ()
    known: dict[tuple[str, ...], Trial] = {}
    decoupled = bool(getattr(problem.twin, "static", False))
    while len(steps) < rule.most * len(problem.twin.outputs):
        now = misfits(problem, current)
        pool = [
            p
            for p in places(problem, effects, current.model.placed)
            if any(now[o] - 1 > max(0.5 * rule.gain, rule.form * (start[o] - now[o])) for o in p.outputs)
        ]
        todo = [p for p in pool if _key(p) not in known]
        for t in try_all(
            problem, current, todo, stride=stride, jobs=jobs, progress=progress, what=f"step {len(steps) + 1}"
        ):
            known[_key(t.placed)] = t
        trials = [known[_key(p)] for p in pool]
        if not steps:
            first = tuple(trials)
        good = [t for t in trials if acceptable(t, rule, sum(max(start[o] - now[o], 0.0) for o in t.placed.outputs))]
        if not good and not steps:
            pair = pair_search(problem, current, trials, z=rule.z + 1, gain=rule.gain)
            if pair is None:
                break
            for member in pair[1]:
                steps.append(replace(member, fitted=pair[0], misfits=misfits(problem, pair[0])))
                rivals.append(())
            current = pair[0]
            known = {}
            continue
        if not good:
            break
        # bursts taken out of the comparison make no model: only where no model does better
        models = [t for t in good if t.placed.effect.claims is None and t.comparison and t.comparison.excess_gain > 0.5]
        best = choose(models or good, rule)
        refined = refine(problem, current, best)
        steps.append(refined)
        rivals.append(tuple(sorted((t for t in good if t is not best), key=lambda t: -t.improvement)))
        assert refined.fitted is not None
        current = refined.fitted
        touched = set(best.placed.outputs)
        known = {k: t for k, t in known.items() if decoupled and not touched & set(t.placed.outputs)}
    if len(steps) > 1:
        current, steps, rivals = second_thoughts(problem, current, steps, rivals, rule)
    return Selection(base, current, tuple(steps), tuple(rivals), first)


def second_thoughts(
    problem: Problem, current: Fit, steps: list[Trial], rivals: list[tuple[Trial, ...]], rule: Rule
) -> tuple[Fit, list[Trial], list[tuple[Trial, ...]]]:
    """Swaps, then pruning; the accepted trials follow."""
    current, changed = swap_pass(problem, current, rivals)
    for k in changed:
        placed = current.model.placed[k]
        steps[k] = replace(steps[k], placed=placed, fitted=current, misfits=misfits(problem, current))
    current, dropped = prune(problem, current, z=rule.z, gain=rule.gain)
    for k in sorted(dropped, reverse=True):
        del steps[k], rivals[k]
    return current, steps, rivals


def _key(p: Placed) -> tuple[str, ...]:
    return (p.effect.name, p.effect.kind, p.site, p.target)


def choose(good: Sequence[Trial], rule: Rule) -> Trial:
    """The best on held-out data, or a simpler one that is as good."""
    order = sorted(good, key=lambda t: (-t.improvement, t.label))
    best = order[0]
    near = [t for t in order if t is best or as_good(t, best, rule)]
    return min(near, key=lambda t: (complexity(t), -t.improvement, t.label))


def excess(trial: Trial, outputs: Iterable[str]) -> float:
    """What a trial leaves above the noise on some outputs."""
    return sum(max(trial.misfits.get(o, np.inf) - 1.0, 0.0) for o in outputs)


def as_good(rival: Trial, best: Trial, rule: Rule) -> bool:
    """Is the rival within error of the best: not significantly worse over blocks, or worse by a trifle."""
    if rival.fitted is None or not rival.fitted.ok or not set(rival.placed.outputs) & set(best.placed.outputs):
        return False
    outputs = sorted(set(rival.placed.outputs) | set(best.placed.outputs))
    t = paired_t(rival.energy, best.energy)
    a, b = excess(best, outputs), excess(rival, outputs)
    trifle = b <= rule.tie * a + 0.02
    close = b <= 2.0 * a + 0.1
    return trifle or (close and t < 2.0)


def complexity(trial: Trial) -> float:
    """How much freedom an effect has."""
    return trial.parameters


def refine(problem: Problem, current: Fit, trial: Trial) -> Trial:
    """The effect added to the current model and everything fitted on every row."""
    assert trial.fitted is not None
    model = Model(problem.twin, (*current.model.placed, trial.placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    k = len(model.placed) - 1
    for mine, theirs in zip(
        model.slices(k), trial.fitted.model.slices(len(trial.fitted.model.placed) - 1), strict=True
    ):
        theta[mine] = trial.fitted.theta[theirs]
    fitted = fit(problem, model, [theta], stride=1, iterations=15)
    energy = block_energy(problem, fitted, problem.held_blocks)
    return replace(trial, fitted=fitted, misfits=misfits(problem, fitted), energy=energy)
