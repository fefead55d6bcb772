"""Which effects are named: forward selection on held-out scores, pairs, pruning, swaps, and parsimony."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.families import (
    FILTERS,
    FLEXIBLE,
    LOOSE,
    beside_flexible,
    in_disguise,
    key_of,
    own_form,
    part_flexible,
)
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.locate import follow
from tools.mismatch.engine.parsimony import Rule, choose, fewest, refine
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.revise import added, pair_search, prune, simplify_pass, size, swap_pass, total
from tools.mismatch.engine.score import block_energy, compare, misfits
from tools.mismatch.engine.screen import bend, one_step, places
from tools.mismatch.engine.trial import Progress, Trial, try_all
from tools.mismatch.engine.unexplained import Stranger, about, stranger

MOST_EXCUSED = 0.1  # of the samples: more is not short and isolated
WORTH_A_PAIR = 1.5  # mean square over noise variance above which two effects are tried together


@dataclass(frozen=True)
class Selection:
    """``problem`` with the noise floors as they were found on the way, ``fitted`` the model with everything accepted,
    ``steps`` the accepted trials in order, ``rivals`` per step the other acceptable trials, best first; ``first`` all
    trials against the recalibrated base.
    """

    problem: Problem
    base: Fit
    fitted: Fit
    steps: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    first: tuple[Trial, ...] = field(default=())
    strange: Stranger | None = None
    """A context signal whose free curve does better than the next effect would have done: the search ended there."""


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
        if of_the_grid(trial):
            return False
        taken = sum(settings.get("stops", ())) - sum(settings.get("starts", ()))
        if taken > MOST_EXCUSED * trial.fitted.residual[trial.placed.outputs[0]].size:
            return False
        loud = max(c.before.values(), default=0.0) > 1.3
        # no tail, however heavy, puts most of a record's energy into a few neighbours
        most = p < 1e-4 and share > 0.8
        return (p < rule.p_tested and share > 0.2) or most or (loud and share > 0.6 and c.z > 7.0 and c.gain > 0.08)
    if trial.refused:
        return False
    if c.z < rule.z or c.gain < rule.gain or c.excess_gain < rule.excess or in_disguise(trial):
        return False
    # what the form of an earlier effect leaves over, no other effect explains down to the noise
    after = max(c.after.values(), default=np.inf)
    clean = after < 1.25 and (c.gain > 0.4 or c.excess_gain > 0.75) and c.z > 2 * rule.z
    # nor does one number take most of it, far beyond doubt, unless that is the physics
    sharp = after < 2.0 and c.excess_gain > 0.5 and c.z > 3 * rule.z and size(trial.placed) <= 2
    # nor do a few numbers take nearly all of it, wherever they leave it: a form left over has the shape of nothing else
    most = c.excess_gain > 0.75 and c.z > 4 * rule.z and size(trial.placed) <= 4
    return c.improvement > taken or ((clean or sharp or most) and trial.name not in LOOSE and not of_the_filter(trial))


def of_the_grid(trial: Trial) -> bool:
    """Whether bursts are no higher than the steps of a named quantiser: readings beside an edge fall on either side."""
    fitted, placed = trial.fitted, trial.placed
    assert fitted is not None
    assert placed.effect.claims is not None
    for p in fitted.model.placed[:-1]:
        if p.effect.name == "quantization" and set(p.outputs) & set(placed.outputs):
            r = fitted.residual[placed.outputs[0]]
            inside = np.abs(r[placed.effect.claims(placed.settings, r.size)])
            return bool(np.quantile(inside, 0.99) < 1.5 * p.settings["step"][0]) if inside.size else True
    return False


def of_the_filter(trial: Trial) -> bool:
    """Whether an effect is linear dynamics beside linear dynamics of the same output: a second pole, or a lead, of what
    is there, until it takes more than the form of that may leave.
    """
    assert trial.fitted is not None
    before = {p.effect.name for p in trial.fitted.model.placed[:-1] if set(p.outputs) & set(trial.placed.outputs)}
    return trial.name in FILTERS and bool(before & FILTERS)


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
    passed: list[tuple[Trial, ...]] = []
    strange: Stranger | None = None
    decoupled = bool(getattr(problem.twin, "static", False))
    while len(steps) < rule.most * len(problem.twin.outputs):
        now = misfits(problem, current)
        form = {
            o: rule.form * own_form(p.effect.name for p in current.model.placed if o in p.outputs)
            * max(start[o] - now[o], 0.0)
            for o in now
        }  # fmt: skip
        pool = [
            p
            for p in places(problem, effects, current.model.placed)
            if p.effect.claims is not None
            or p.effect.name == "quantization"  # the noise floor holds its steps
            or any(
                now[o] - 1 > max(0.5 * rule.gain, form[o] if p.effect.name in LOOSE else min(form[o], 0.2))
                for o in p.outputs
            )
        ]
        todo = [p for p in pool if key_of(p) not in known]
        for t in try_all(
            problem, current, todo, stride=stride, jobs=jobs, progress=progress, what=f"step {len(steps) + 1}"
        ):
            known[key_of(t.placed)] = t
        trials = [known[key_of(p)] for p in pool]
        if not steps:
            first = tuple(trials)
        good = [t for t in trials if acceptable(t, rule, sum(form[o] for o in t.placed.outputs))]
        passed += [(*steps, t) for t in good]
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
            freed = beside_flexible(problem, current, steps, trials, 2 * rule.z) if steps else None
            if freed is None:
                break
            current, steps = freed[0], list(freed[1])
            rivals.append(())
            known = {}
            continue
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
        quieter = problem.quieter(current.residual)
        if quieter is not problem:
            problem, start = quieter, misfits(quieter, base)
            current = fit(problem, current.model, [current.theta], iterations=6)
            steps[-1] = replace(refined, fitted=current, misfits=misfits(problem, current))
        touched = set(best.placed.outputs)
        # what looked hopeless beside a louder output is looked at again now that this one is quieter
        known = {
            k: t for k, t in known.items() if decoupled and t.fitted is not None and not touched & set(t.placed.outputs)
        }
    if steps and steps[0].name in (*FLEXIBLE, "random_walk"):
        parted = part_flexible(problem, base, steps[0], first)
        if parted is not None:
            fitted, two = parted
            if len(steps) == 1 or total(problem, fitted) <= total(problem, current) + 0.05:
                current, steps, rivals = fitted, list(two), [(steps[0], *rivals[0]), ()]
    if len(steps) > 1:
        current, steps, rivals = second_thoughts(problem, base, current, steps, rivals, first, rule)
    if len(steps) > 1:
        fewer = fewest(problem, base, current, steps, passed)
        if fewer is not None:
            current, steps = fewer[0], list(fewer[1])
            rivals = [*rivals[: len(steps) - 1], ()]
    walk = unshaped(problem, current, effects, rule) if strange is None else None
    if walk is not None:
        current = walk[0]
        steps.append(walk[1])
        rivals.append(())
    return Selection(problem, base, current, tuple(steps), tuple(rivals), first, strange)


def unshaped(problem: Problem, current: Fit, effects: Iterable[Effect], rule: Rule) -> tuple[Fit, Trial] | None:
    """Integrated noise where nothing else is left: nobody predicts it, so no held-out score can vouch for it. Its own
    test does, when what is left stands far above the noise and follows nothing that was recorded.
    """
    now = misfits(problem, current)
    walks = [e for e in effects if e.name == "random_walk"]
    for place in places(problem, walks, current.model.placed):
        o = place.outputs[0]
        if now[o] < 2.0:
            continue
        with np.errstate(all="ignore"):
            seen = one_step(problem, current, place, bend(problem, current))
        if seen.p_value > rule.p_tested or seen.share < 0.5:
            continue
        found, _ = follow(problem, current, o)
        if any(d.signal != "time" and d.p_value < 1e-4 and d.strength > 0.1 for d in found):
            continue
        with np.errstate(all="ignore"):
            walk = added(problem, current, place)
        value = misfits(problem, walk)
        if walk.ok and value[o] < now[o]:
            better = compare(problem, current, walk)
            energy = block_energy(problem, walk, problem.held_blocks)
            added_one = walk.model.placed[-1]
            count = size(added_one)
            return walk, Trial(added_one, seen, walk, better, value, energy, count, problem.twin.outputs)
    return None


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
    seen = sorted(
        (t for t in first if t.placed.effect.claims is None and not t.refused),
        key=lambda t: (-t.candidate.share, t.label),
    )
    top = {
        o: max((t.candidate.share for t in seen if o in t.placed.outputs), default=0.0) for o in problem.twin.outputs
    }
    pool = [t.placed for t in seen if t.candidate.share > 0.1 * min(top[o] for o in t.placed.outputs)]
    # what was good beside the earlier effects may have looked like nothing before them
    pool += [t.placed for later in rivals[1:] for t in later if t.placed.effect.claims is None and not t.refused]
    pool = list({key_of(p): p for p in pool}.values())
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
