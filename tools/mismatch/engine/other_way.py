"""Two effects to begin with where the first way, one effect at a time, left much: its first choice may have been wrong
for what it took of a second effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tools.mismatch.engine.families import key_of, possible
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.forward import Work, acceptable
from tools.mismatch.engine.parsimony import complexity, refine
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.revise import total
from tools.mismatch.engine.score import block_energy, misfits
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import CLEAR_P, Trial

BEGINNINGS = 2  # by what they leave
SURE = 2  # by a test of their own
FITS = (1, 2)  # of each kind beside one beginning
REFINED = 3  # pairs
NEARLY = 1.3  # of the least excess, within which the pair of least freedom begins


def beginnings(first: Sequence[Trial], output: str) -> list[Trial]:
    """First effects worth a second try on one output, one of each name: those that leave least, then those that their
    own test is sure of.
    """
    here = [t for t in first if output in t.placed.outputs and t.fitted is not None and t.fitted.ok and not t.refused]
    # what takes samples out of the comparison makes any pair look good
    here = [t for t in here if t.placed.effect.claims is None]
    chosen: dict[str, Trial] = {}
    for t in sorted(here, key=lambda t: (t.misfits[output], t.label)):
        if len(chosen) < BEGINNINGS:
            chosen.setdefault(t.name, t)
    sure = [t for t in here if t.candidate.tested and t.candidate.p_value < CLEAR_P]
    for t in sorted(sure, key=lambda t: (-t.candidate.share, t.label))[:SURE]:
        chosen.setdefault(t.name, t)
    return [*chosen.values()]


def from_other_bases(problem: Problem, base: Fit, trial: Trial) -> Trial:
    """The trial, or what comes of it from other base parameters, when that leaves less: those that one effect was
    fitted with are off by what the second does. They begin as the engineer believes them to be, and as recalibrated.
    """
    assert trial.fitted is not None
    model, here = trial.fitted.model, trial.fitted.theta
    n = model.n_base
    begun = [np.concatenate([b[:n], here[n:]]) for b in (model.start(problem.recording), base.theta)]
    there = fit(problem, model, [here, *begun], iterations=25)
    if not there.ok or total(problem, there) >= total(problem, trial.fitted):
        return trial
    energy = block_energy(problem, there, problem.held_blocks)
    return replace(trial, fitted=there, misfits=misfits(problem, there), energy=energy)


def other_pair(
    problem: Problem, base: Fit, first: Sequence[Trial], steps: Sequence[Trial], output: str, work: Work
) -> tuple[Fit, tuple[Trial, Trial]] | None:
    """The pair of effects that leaves least on the output that is worst off, with everything fitted on every row; None
    when no second effect is acceptable beside another beginning than that of ``steps``.
    """
    outputs = problem.twin.outputs
    found: list[tuple[float, float, str, Trial, Trial]] = []
    for one in beginnings(first, output):
        if steps and one.label == steps[0].label:
            continue
        begun = refine(problem, base, one)
        assert begun.fitted is not None
        if not begun.fitted.ok:
            continue
        pool = [p for p in places(problem, work.effects, begun.fitted.model.placed) if output in p.outputs]
        unique = list({key_of(p): p for p in pool}.values())
        for two in work.tried(problem, begun.fitted, unique, f"{one.name} and another", FITS):
            if two.fitted is not None and acceptable(two, work.rule, 0.0) and possible(two.fitted):
                left = sum(max(two.misfits[o] - 1.0, 0.0) for o in outputs)
                found.append((left, complexity(begun) + complexity(two), two.label, begun, two))
    # few steps on few rows rank them; what they are worth shows when everything is fitted
    ended: list[tuple[float, float, str, Trial, Trial]] = []
    for _, freedom, label, one, two in sorted(found, key=lambda f: f[:3])[:REFINED]:
        assert one.fitted is not None
        both = from_other_bases(problem, base, refine(problem, one.fitted, two))
        assert both.fitted is not None
        if possible(both.fitted):
            ended.append((sum(max(both.misfits[o] - 1.0, 0.0) for o in outputs), freedom, label, one, both))
    if not ended:
        return None
    least = min(e[0] for e in ended)
    near = [e for e in ended if e[0] <= NEARLY * least + 0.05]
    _, _, _, one, both = min(near, key=lambda e: e[1:3])
    assert both.fitted is not None
    return both.fitted, (one, both)
