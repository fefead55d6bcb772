"""Which of several effects that do about as well is named: the one with least freedom, and no more than it takes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import block_energy, misfits, paired_t
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.vary import size
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

FAR = 100.0  # noise variances above which the best is a poor model: then blocks say nothing about which is simpler
PLAIN = 2.5  # so much more the form of an effect of one or two numbers may cost beside a family
NEAR = 10.0  # noise variances
MOST_TIE = 0.3  # noise variances, besides what the form of a model may cost


@dataclass(frozen=True)
class Rule:
    """The margins of a decision; calibrated on null simulations (``tools/research/prove/nulls.py``).

    ``z`` whitened held-out correlation in standard deviations, over all candidates and places; ``gain`` least
    share of the mean square; ``excess`` least share of what stands above the noise; ``form`` times
    ``own_form`` the share of what is explained below which a leftover counts as the accepted effect's own; ``tie``
    excess of a rival relative to the best at which fewer parameters win, ``shape`` share of what is explained that
    the form of a model may cost on top; ``p_tested`` for effects with a test of their own.
    """

    z: float = 5.5
    gain: float = 0.04
    excess: float = 0.25
    form: float = 1.0
    tie: float = 1.3
    shape: float = 0.004
    p_tested: float = 1e-7
    most: int = 4


def choose(good: Sequence[Trial], rule: Rule, now: Mapping[str, float], named: frozenset[str]) -> Trial:
    """On the output that is worst off: the best on held-out data, or a simpler one that is as good.

    ``now``: mean square over noise variance per output before this step; ``named``: effects accepted so far, which
    are preferred among equals (the same physics on another output).
    """
    touched = sorted({o for t in good for o in t.placed.outputs})
    output = max(touched, key=lambda o: now[o])
    here = sorted((t for t in good if output in t.placed.outputs), key=lambda t: (t.misfits[output], t.label))
    best = here[0]
    near = [t for t in here if t is best or as_good(t, best, rule, output, now[output])]
    names = {t.name for t in near}
    # as good here within a trifle: then what it does for the other outputs counts
    close = best.misfits[output] + 0.05 + 0.001 * max(now[output] - best.misfits[output], 0.0)
    chosen = min(
        near,
        key=lambda t: (
            t.name not in named or t.placed.effect.stochastic, complexity(t), less_plain(t.name, names),
            t.misfits[output] > close, -t.improvement, t.label,
        ),
    )  # fmt: skip
    # of its forms the one that leaves least, unless by a trifle: what a form leaves is mended with names; where one
    # comes near the noise, a share of all that both explain is no trifle
    left = max(chosen.misfits[output] - 1.0, 0.0)
    trifle = 0.02 + min(0.25 * rule.shape * max(now[output] - chosen.misfits[output], 0.0), (rule.tie - 1.0) * left)
    forms = [t for t in here if t.label == chosen.label and t.placed.site == chosen.placed.site]
    least = min(forms, key=lambda t: t.misfits[output])
    return least if least.misfits[output] < chosen.misfits[output] - trifle else chosen


ORDER = (
    ("saturation", "dead_zone"),
    ("coulomb_friction", "stribeck_friction"),
    ("mains_interference", "vibration"),
    ("dead_time", "clock_skew"),
    ("dead_time", "channel_delay"),
    ("step_shift", "thermal_drift"),
)
"""Where two effects serve equally well with equal freedom, the first is the plainer statement."""

FREEDOM = {
    "static_nonlinearity": 4,
    "creep": 5,
    "hysteresis": 8,
    "rate_dependent_hysteresis": 20,
    "step_shift": 10,
    "random_walk": 12,
    "mains_interference": 6,
    "vibration": 6,
    "dropped_samples": 2,
}
"""What a family counts as at most: its weights are smoothed, and how many columns its data asked for (bends of a curve,
harmonics and wander of a line, samples that were lost) is no physics. Levels are the plainer statement than a walk,
however many they are.
"""


def less_plain(name: str, among: Collection[str]) -> bool:
    """Is a plainer statement of the same freedom among those that serve equally well."""
    return any(name == second and first in among for first, second in ORDER)


def as_good(rival: Trial, best: Trial, rule: Rule, output: str, before: float) -> bool:
    """Is the rival within error of the best on one output: worse by a trifle, or by no more than the form of a model
    may cost, or not significantly over blocks. ``before``: mean square over noise variance without either.

    The first tenth of the blocks may be left out: what a start transient costs says nothing about the physics. A best
    effect without shape allows for no form of its own. A best that leaves less than the noise shows that the noise was
    estimated too high.
    """
    if rival.fitted is None or not rival.fitted.ok or output not in rival.misfits:
        return False
    floor = min(best.misfits[output], 1.0)
    a, b = best.misfits[output] - floor, max(rival.misfits[output] - floor, 0.0)
    # a family bends to what the form of a plain effect leaves, while that is not far above the noise
    plain = freedom(best.placed) >= 8 and size(rival.placed) <= 2 and b < NEAR
    form = 0.02 + (PLAIN if plain else 1.0) * rule.shape * max(before - best.misfits[output], 0.0)
    shapeless = best.placed.effect.stochastic
    # far above the noise a share of the excess is no trifle
    slack = form if shapeless else form + min((rule.tie - 1.0) * a, MOST_TIE + 3.0 * form)
    if b > 2.0 * a + 0.1 + min(5.0 * form, NEAR):
        return False  # who leaves twice as much lacks something, however much both explain
    if b <= a + slack:
        return True
    if shapeless or a > FAR:
        return False
    column = best.outputs.index(output)
    mine, his = best.energy[:, column], rival.energy[:, column]
    if paired_t(his[:, None], mine[:, None]) < 2.0 and b <= 2.0 * a + 0.1:
        return True
    usual = slice(his.size // 10, None)
    a, b = max(float(mine[usual].mean()) - floor, 0.0), max(float(his[usual].mean()) - floor, 0.0)
    return b <= a + form + min((rule.tie - 1.0) * a, MOST_TIE + 3.0 * form)


def freedom(placed: Placed) -> float:
    """Return how many numbers an effect brings, those of a family counted as no more than ``FREEDOM``."""
    return min(size(placed), FREEDOM.get(placed.effect.name, np.inf))


def complexity(trial: Trial) -> float:
    """How much freedom an effect has, per output that it serves but at least one; events read off the data count as
    parameters.
    """
    return max(freedom(trial.placed) / max(len(trial.placed.outputs), 1), 1.0)


def fewest(
    problem: Problem, base: Fit, current: Fit, steps: Sequence[Trial], passed: Sequence[tuple[Trial, ...]]
) -> tuple[Fit, tuple[Trial, ...]] | None:
    """A model of fewer effects, met on the way, that does as well as the one that was arrived at; None if no such.

    An effect that was passed over for a simpler name may be the only one: what the simpler one left had to be mended.
    """
    excess = lambda m: sum(max(v - 1.0, 0.0) for v in m.values())  # noqa: E731
    now = excess(misfits(problem, current))
    outputs = len(problem.twin.outputs)
    taken = excess(misfits(problem, base)) - now
    limit = 1.1 * now + 0.03 * outputs + 0.001 * taken
    freedom = sum(complexity(t) for t in steps)
    events = {t.label for t in steps if t.placed.effect.claims is not None}  # named by their own test, not by what goes
    near = [
        c
        for c in passed
        if len(c) < len(steps)
        and events <= {t.label for t in c}
        and sum(complexity(t) for t in c) < freedom
        and excess(c[-1].misfits) <= 1.3 * limit + 0.05
    ]
    near.sort(key=lambda c: (len(c), sum(complexity(t) for t in c), excess(c[-1].misfits)))
    mine = block_energy(problem, current, problem.held_blocks)
    for chain in near[:6]:
        *held, last = chain
        before = held[-1].fitted if held else base
        assert before is not None
        last = refine(problem, before, last)
        assert last.fitted is not None
        if not last.fitted.ok or excess(last.misfits) > limit:
            continue
        if paired_t(last.energy, mine) < 3.0:
            return last.fitted, (*held, last)
    return None


def refine(problem: Problem, current: Fit, trial: Trial) -> Trial:
    """The effect added to the current model and everything fitted on every row."""
    assert trial.fitted is not None
    model = Model(problem.twin, (*current.model.placed, trial.placed))
    theta = trial.fitted.theta
    if trial.fitted.model.placed[:-1] != current.model.placed:
        # other outputs have moved on since
        theta = model.carry(current.model, current.theta, problem.recording)
        own = trial.fitted.model.slices(len(trial.fitted.model.placed) - 1)
        for mine, theirs in zip(model.slices(len(model.placed) - 1), own, strict=True):
            theta[mine] = trial.fitted.theta[theirs]
    fitted = fit(problem, model, [theta], iterations=15, keep=current, touched=trial.placed.outputs)
    energy = block_energy(problem, fitted, problem.held_blocks)
    return replace(trial, fitted=fitted, misfits=misfits(problem, fitted), energy=energy)
