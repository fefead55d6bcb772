"""Which effects are named: forward selection on held-out scores, pairs, pruning, swaps, and parsimony."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.revise import added, pair_search, prune, simplify_pass, size, swap_pass, total
from tools.mismatch.engine.score import block_energy, compare, misfits, paired_t
from tools.mismatch.engine.screen import bend, one_step, places
from tools.mismatch.engine.trial import Progress, Trial, try_all
from tools.mismatch.engine.unexplained import Stranger, about, stranger
from tools.mismatch.simulate import Model, Placed

FAR = 100.0  # noise variances above which the best is a poor model: then blocks say nothing about which is simpler
MOST_TIE = 0.3  # noise variances, besides what the form of a model may cost
MOST_EXCUSED = 0.1  # of the samples: more is not short and isolated
WORTH_A_PAIR = 1.5  # mean square over noise variance above which two effects are tried together


@dataclass(frozen=True)
class Rule:
    """The margins of a decision; calibrated on null simulations (docs/mismatch-calibration.md).

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


EXACT = frozenset(
    (
        "dead_time", "channel_delay", "clock_skew", "dropped_samples", "first_order_lag", "misalignment", "soft_iron",
        "mains_interference", "vibration", "step_shift", "centripetal_acceleration", "sensor_position_error",
        "current_coupling",
    )
)  # fmt: skip
"""Effects of which there is one form: what they leave is something else."""
LOOSE = frozenset(("hysteresis", "rate_dependent_hysteresis", "creep", "random_walk", "stribeck_friction"))


def own_form(names: Iterable[str]) -> float:
    """Share of what the named effects took that their true form may leave over."""
    return max((0.004 if n in EXACT else 0.05 if n in LOOSE else 0.015 for n in names), default=0.0)


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
    strange: Stranger | None = None
    """A context signal whose free curve does better than the next effect would have done: the search ended there."""


def moved_by(placed: Placed, problem: Problem) -> tuple[str, ...]:
    """Outputs that an effect moves: a force moves every output of its equation of motion."""
    return problem.twin.outputs if placed.site == "feedback" else placed.outputs


def acceptable(trial: Trial, rule: Rule, taken: float) -> bool:
    """May this effect be named at all: better on held-out data by more than chance and by more than a trifle.

    ``taken``: mean square over noise variance that the form of earlier effects may leave on the same outputs.
    """
    c = trial.comparison
    if trial.fitted is None or c is None or not trial.fitted.ok:
        return False
    if trial.placed.effect.claims is not None:
        p, share = trial.candidate.p_value, trial.candidate.share
        settings = trial.placed.settings
        taken = sum(settings.get("stops", ())) - sum(settings.get("starts", ()))
        if taken > MOST_EXCUSED * trial.fitted.residual[trial.placed.outputs[0]].size:
            return False
        return (p < rule.p_tested and share > 0.2) or (share > 0.6 and c.z > 7.0 and c.gain > 0.08)
    if trial.candidate.tested and trial.candidate.p_value > 1e-3:
        return False
    if c.z < rule.z or c.gain < rule.gain or c.excess_gain < rule.excess:
        return False
    # what the form of an earlier effect leaves over, no other effect explains down to the noise
    clean = max(c.after.values(), default=np.inf) < 1.25 and c.gain > 0.4 and c.z > 2 * rule.z
    return c.improvement > taken or (clean and trial.name not in LOOSE)


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
    strange: Stranger | None = None
    decoupled = bool(getattr(problem.twin, "static", False))
    while len(steps) < rule.most * len(problem.twin.outputs):
        now = misfits(problem, current)
        form = {
            o: rule.form * own_form(p.effect.name for p in current.model.placed if o in moved_by(p, problem))
            * max(start[o] - now[o], 0.0)
            for o in now
        }  # fmt: skip
        pool = [
            p
            for p in places(problem, effects, current.model.placed)
            if p.effect.claims is not None
            or any(
                now[o] - 1 > max(0.5 * rule.gain, form[o] if p.effect.name in LOOSE else min(form[o], 0.5))
                for o in p.outputs
            )
        ]
        todo = [p for p in pool if _key(p) not in known]
        for t in try_all(
            problem, current, todo, stride=stride, jobs=jobs, progress=progress, what=f"step {len(steps) + 1}"
        ):
            known[_key(t.placed)] = t
        trials = [known[_key(p)] for p in pool]
        if not steps:
            first = tuple(trials)
        good = [t for t in trials if acceptable(t, rule, sum(form[o] for o in moved_by(t.placed, problem)))]
        if not good and not steps and max(now.values()) > WORTH_A_PAIR:
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
        best = choose(models or good, rule, now, frozenset(t.name for t in steps))
        refined = refine(problem, current, best)
        assert refined.fitted is not None
        found = (stranger(problem, current, refined.fitted, o, (best.name,)) for o in best.placed.outputs)
        strange = next((f for f in found if f is not None), None)
        if strange is not None:
            signal = strange.signal
            own = [t for t in good if signal in about(t.placed.effect) and strange.output in t.placed.outputs]
            if not any(signal in about(t.placed.effect) for t in trials):
                break
            strange = None
            if own:
                # a context signal that the vocabulary knows: its own effect first
                best = choose(own, rule, now, frozenset(t.name for t in steps))
                refined = refine(problem, current, best)
                assert refined.fitted is not None
        steps.append(refined)
        shared = [t for t in good if t is not best and set(t.placed.outputs) & set(best.placed.outputs)]
        rivals.append(tuple(sorted(shared, key=lambda t: (_left(t, best), t.label))))
        current = refined.fitted
        touched = set(best.placed.outputs)
        known = {k: t for k, t in known.items() if decoupled and not touched & set(t.placed.outputs)}
    if steps and steps[0].name in FLEXIBLE:
        parted = part_flexible(problem, base, steps[0], first)
        if parted is not None:
            fitted, two = parted
            if len(steps) == 1 or total(problem, fitted) <= total(problem, current) + 0.05:
                current, steps, rivals = fitted, list(two), [(steps[0], *rivals[0]), ()]
    if len(steps) > 1:
        current, steps, rivals = second_thoughts(problem, base, current, steps, rivals, first, rule)
    return Selection(base, current, tuple(steps), tuple(rivals), first, strange)


FLEXIBLE = ("hysteresis", "rate_dependent_hysteresis", "creep")


def part_flexible(
    problem: Problem, base: Fit, flexible: Trial, first: Sequence[Trial]
) -> tuple[Fit, tuple[Trial, Trial]] | None:
    """Two specific effects in place of one flexible family that took both of them; None when no two do as well."""
    outputs = flexible.placed.outputs
    excess = sum(max(flexible.misfits[o] - 1.0, 0.0) for o in outputs)
    limit = 0.5 * excess if excess > 0.1 else excess
    specific = [
        t
        for t in first
        if t.fitted is not None and t.fitted.ok and t.placed.effect.claims is None
        and t.name not in LOOSE and size(t.placed) <= 5 and set(t.placed.outputs) & set(outputs)
    ]  # fmt: skip
    specific.sort(key=lambda t: (sum(t.misfits[o] for o in outputs if o in t.misfits), t.label))
    best: tuple[float, Fit, tuple[Trial, Trial]] | None = None
    for one in specific[:2]:
        assert one.fitted is not None
        beside = [
            p
            for p in places(problem, [t.placed.effect for t in first if t.name not in LOOSE], one.fitted.model.placed)
            if p.effect.claims is None and p.effect.test is None and set(p.outputs) & set(outputs)
        ]
        unique = list({_key(p): p for p in beside}.values())
        with np.errstate(all="ignore"):
            bends = bend(problem, one.fitted)
            looked = [one_step(problem, one.fitted, p, bends) for p in unique]
        looked.sort(key=lambda c: (-c.share, c.placed.label))
        for other in [c for c in looked if c.share > 0.3][:2]:
            both = added(problem, one.fitted, other.placed)
            value = misfits(problem, both)
            left = sum(max(value[o] - 1.0, 0.0) for o in outputs)
            if both.ok and left <= limit and (best is None or left < best[0]):
                energy = block_energy(problem, both, problem.held_blocks)
                second = Trial(
                    both.model.placed[-1],
                    other,
                    both,
                    compare(problem, one.fitted, both),
                    value,
                    energy,
                    0,
                    one.outputs,
                )
                head = replace(one, fitted=both, misfits=value, energy=energy)
                best = (left, both, (head, second))
    return None if best is None else (best[1], best[2])


def second_thoughts(
    problem: Problem,
    base: Fit,
    current: Fit,
    steps: list[Trial],
    rivals: list[tuple[Trial, ...]],
    first: tuple[Trial, ...],
    rule: Rule,
) -> tuple[Fit, list[Trial], list[tuple[Trial, ...]]]:
    """Swaps, then pruning; the accepted trials follow."""
    taken = sum(misfits(problem, base).values()) - sum(misfits(problem, current).values())
    current, changed = swap_pass(problem, current, rivals, least=0.01 * taken)
    seen = sorted((t for t in first if t.placed.effect.claims is None), key=lambda t: (-t.candidate.share, t.label))
    top = {
        o: max((t.candidate.share for t in seen if o in t.placed.outputs), default=0.0) for o in problem.twin.outputs
    }
    pool = [t.placed for t in seen if t.candidate.share > 0.1 * min(top[o] for o in t.placed.outputs)]
    current, simpler = simplify_pass(problem, base, current, pool, tie=rule.tie, shape=rule.shape)
    for k in sorted({*changed, *simpler}):
        placed = current.model.placed[k]
        steps[k] = replace(steps[k], placed=placed, fitted=current, misfits=misfits(problem, current))
    current, dropped = prune(problem, current, z=rule.z, gain=rule.gain)
    for k in sorted(dropped, reverse=True):
        del steps[k], rivals[k]
    return current, steps, rivals


def _left(rival: Trial, best: Trial) -> float:
    """What a rival leaves on the outputs that both serve."""
    return sum(rival.misfits[o] for o in best.placed.outputs if o in rival.placed.outputs)


def _key(p: Placed) -> tuple[str, ...]:
    return (p.effect.name, p.effect.kind, p.site, p.target, p.effect.equation)


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
    return min(
        near,
        key=lambda t: (
            t.name not in named, complexity(t), less_plain(t.name, names), t.misfits[output] > close, -t.improvement,
            t.label,
        ),
    )  # fmt: skip


ORDER = (
    ("saturation", "dead_zone"),
    ("coulomb_friction", "stribeck_friction"),
    ("mains_interference", "vibration"),
    ("dead_time", "clock_skew"),
    ("dead_time", "channel_delay"),
)
"""Where two effects serve equally well with equal freedom, the first is the plainer statement."""

FREEDOM = {
    "static_nonlinearity": 4,
    "creep": 5,
    "hysteresis": 8,
    "rate_dependent_hysteresis": 20,
    "random_walk": 12,
}
"""What a family counts as at most: its weights are smoothed, and how many columns its data asked for is no physics."""


def less_plain(name: str, among: Collection[str]) -> bool:
    """Is a plainer statement of the same freedom among those that serve equally well."""
    return any(name == second and first in among for first, second in ORDER)


def as_good(rival: Trial, best: Trial, rule: Rule, output: str, before: float) -> bool:
    """Is the rival within error of the best on one output: worse by a trifle, or by no more than the form of a model
    may cost, or not significantly over blocks. ``before``: mean square over noise variance without either.

    A tenth of the blocks may be left out: what a start transient costs says nothing about the physics. A best effect
    without shape allows for no form of its own.
    """
    if rival.fitted is None or not rival.fitted.ok or output not in rival.misfits:
        return False
    a, b = max(best.misfits[output] - 1.0, 0.0), max(rival.misfits[output] - 1.0, 0.0)
    form = 0.02 + rule.shape * max(before - best.misfits[output], 0.0)
    shapeless = best.placed.effect.stochastic
    # far above the noise a share of the excess is no trifle
    slack = form if shapeless else form + min((rule.tie - 1.0) * a, MOST_TIE + 3.0 * form)
    if b <= a + slack:
        return True
    if shapeless or a > FAR or b > 2.0 * a + 0.1 + 5.0 * form:
        return False
    column = best.outputs.index(output)
    mine, his = best.energy[:, column], rival.energy[:, column]
    if paired_t(his[:, None], mine[:, None]) < 2.0 and b <= 2.0 * a + 0.1:
        return True
    usual = np.argsort(his - mine)[: his.size - his.size // 10]
    a, b = max(float(mine[usual].mean()) - 1.0, 0.0), max(float(his[usual].mean()) - 1.0, 0.0)
    return b <= a + form + min((rule.tie - 1.0) * a, MOST_TIE + 3.0 * form)


def complexity(trial: Trial) -> float:
    """How much freedom an effect has, per output that it serves but at least one; events read off the data count as
    parameters.
    """
    most = FREEDOM.get(trial.name, np.inf)
    return max(min(size(trial.placed), most) / max(len(trial.placed.outputs), 1), 1.0)


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
    fitted = fit(problem, model, [theta], iterations=15, keep=current, touched=trial.placed.outputs)
    energy = block_energy(problem, fitted, problem.held_blocks)
    return replace(trial, fitted=fitted, misfits=misfits(problem, fitted), energy=energy)
