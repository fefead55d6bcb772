"""Which effects are named: forward selection on held-out scores, other beginnings, pruning, swaps, and parsimony."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.families import FLEXIBLE, key_of, own_form, part_flexible, possible
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.forward import Way, Work, forward
from tools.mismatch.engine.locate import follow
from tools.mismatch.engine.other_way import other_pair
from tools.mismatch.engine.parsimony import Rule, fewest
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.revise import prune, simplify_pass, swap_pass, total
from tools.mismatch.engine.score import block_energy, compare, misfits
from tools.mismatch.engine.screen import bend, one_step, places
from tools.mismatch.engine.selection import Selection
from tools.mismatch.engine.trial import Progress, Trial
from tools.mismatch.engine.vary import added, reduced, size

WORTH_ANOTHER = 0.5  # noise variances that one way must leave before another is tried, and
BEYOND = 1.5  # times what the form of its effects may leave;
CROWDED = 0.25  # where more than two effects share an output, their number is suspect by itself
LEAST_OF_A_WALK = 0.4  # of what is left, where its own test speaks for it and nothing else does


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
    """Forward selection, from other beginnings too where the first way leaves much; then second thoughts."""
    rule = rule or Rule()
    effects = tuple(effects)
    work = Work(effects, rule, stride, jobs, progress)
    way = forward(problem, base, base, (), work)
    found = settled(base, way, work)
    if way.strange is None:
        start = misfits(found.problem, base)
        left = {o: v - 1.0 for o, v in misfits(found.problem, found.fitted).items()}
        worst = max(left, key=lambda o: left[o])
        taken = max(start[worst] - 1.0, 0.0)
        form = own_form(t.name for t in found.steps if worst in t.placed.outputs)
        crowded = sum(worst in t.placed.outputs for t in found.steps) > 2
        if left[worst] > max(WORTH_ANOTHER, (CROWDED if crowded else BEYOND) * form * taken):
            pair = other_pair(found.problem, base, way.first, found.steps, worst, work)
            if pair is not None and outdone(found, pair[0], len(pair[1])):
                again = settled(base, forward(found.problem, base, pair[0], pair[1], work, way.first), work)
                if again.strange is None and outdone(found, again.fitted, len(again.steps)):
                    found = again
    return found


def outdone(found: Selection, other: Fit, effects: int) -> bool:
    """Whether another account explains so much more that it is the better one: at least half of what the first left,
    and more for every effect that it takes in addition.
    """
    more = max(effects - max(len(found.steps), 1), 0)
    return excess(found.problem, other) <= 0.5 ** (1 + more) * excess(found.problem, found.fitted)


def excess(problem: Problem, fitted: Fit) -> float:
    """Mean square over noise variance above one, of all outputs."""
    return sum(max(v - 1.0, 0.0) for v in misfits(problem, fitted).values())


def settled(base: Fit, way: Way, work: Work) -> Selection:
    """A way with its second thoughts."""
    problem, current, strange, first, rule = way.problem, way.current, way.strange, way.first, work.rule
    steps, rivals = list(way.steps), list(way.rivals)
    if steps and steps[0].name in (*FLEXIBLE, "random_walk"):
        parted = part_flexible(problem, base, steps[0], first, work.jobs)
        if parted is not None:
            fitted, two = parted
            if len(steps) == 1 or total(problem, fitted) <= total(problem, current) + 0.05:
                current, steps, rivals = fitted, list(two), [(steps[0], *rivals[0]), ()]
    if len(steps) > 1:
        current, steps, rivals = second_thoughts(problem, base, current, steps, rivals, first, rule)
    if len(steps) > 1:
        fewer = fewest(problem, base, current, steps, way.passed)
        if fewer is not None:
            current, steps = fewer[0], list(fewer[1])
            rivals = [*rivals[: len(steps) - 1], ()]
    walk = unshaped(problem, current, work.effects, rule) if strange is None else None
    if walk is not None:
        current = walk[0]
        steps.append(walk[1])
        rivals.append(())
    current, dropped = of_the_walk(problem, current)
    for k in dropped:
        del steps[k], rivals[k]
    return Selection(problem, base, current, tuple(steps), tuple(rivals), first, strange)


READ_OFF_A_WALK = ("step_shift", "thermal_drift")


def of_the_walk(problem: Problem, current: Fit) -> tuple[Fit, list[int]]:
    """Integrated noise without the levels and drifts that are read off it: they go unless they take half of what it
    leaves, or (a smooth drift, which a walk follows) leave less than twice as much alone. The model and the positions
    that were dropped, last first.
    """
    dropped: list[int] = []
    for k in reversed(range(len(current.model.placed))):
        placed = current.model.placed
        walked = {o for p in placed if p.effect.name == "random_walk" for o in p.outputs}
        if placed[k].effect.name in READ_OFF_A_WALK and set(placed[k].outputs) <= walked:
            alone = reduced(problem, current, k)
            left = excess(problem, alone)
            if not possible(alone) or left > 2.0 * excess(problem, current) + 0.1:
                continue
            if placed[k].effect.name == "thermal_drift":
                walk = next(j for j, p in enumerate(placed) if p.effect.name == "random_walk")
                if excess(problem, reduced(problem, current, walk)) <= 2.0 * left:
                    continue
            current = alone
            dropped.append(k)
    return current, dropped


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
        if walk.ok and now[o] - value[o] > LEAST_OF_A_WALK * (now[o] - 1.0):
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
