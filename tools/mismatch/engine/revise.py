"""Second thoughts: effects that stopped paying are dropped, early choices are put against their rivals again, and two
effects are tried together when neither pays alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import block_energy, compare, misfits, paired_t
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.vary import added, beyond_limits, reduced, replaced, size
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

Array = np.ndarray

INDISPENSABLE = 0.5  # share of the mean square that would come back: then few independent blocks are no reason
OTHER = 0.02  # share of what an effect takes that the right name may cost where the fitted figures rule this one out


def total(problem: Problem, fitted: Fit) -> float:
    """Mean square over noise variance, summed over outputs."""
    return sum(misfits(problem, fitted).values())


def better(problem: Problem, old: Fit, new: Fit, *, margin: float, least: float, t_limit: float = 3.0) -> bool:
    """Is ``new`` better than ``old`` on held-out blocks: by more than ``margin`` of the excess and by ``least`` (noise
    variances; three times that when it has more parameters), and by a paired test.
    """
    if not new.ok:
        return False
    a, b = total(problem, old), total(problem, new)
    room = a - len(problem.twin.outputs)
    if len(new.model.parameters) > len(old.model.parameters):
        least *= 3
    if a - b < max(margin * max(room, 0.0), least) + 0.02:
        return False
    blocks = problem.held_blocks
    return paired_t(block_energy(problem, old, blocks), block_energy(problem, new, blocks)) > t_limit


def swap_pass(
    problem: Problem, fitted: Fit, rivals: Sequence[Sequence[Trial]], *, least: float, margin: float = 0.25
) -> tuple[Fit, list[int]]:
    """Each effect but the last put against the best rivals of its step, now that the others are in place.

    Returns the model and the positions that changed.
    """
    changed: list[int] = []
    count = len(fitted.model.placed)
    if count < 2:
        return fitted, changed
    for k in range(count):
        if fitted.model.placed[k].effect.claims is not None:
            continue
        held = [p for j, p in enumerate(fitted.model.placed) if j != k]
        tried: set[str] = set()
        for rival in rivals[k][:4] if k < len(rivals) else ():
            name = rival.placed.effect.name
            if rival.placed.effect.claims is not None:
                continue
            same = any(p.effect.name == name and p.target == rival.placed.target for p in held)
            if same or name in tried or name == fitted.model.placed[k].effect.name:
                continue
            tried.add(name)
            with np.errstate(all="ignore"):
                candidate = replaced(problem, fitted, k, rival.placed)
            possible = candidate.ok and not beyond_limits(candidate, candidate.model.placed[-1])
            if possible and better(problem, fitted, candidate, margin=margin, least=least):
                # the newcomer is last in its model; keep the order of acceptance
                turned = reordered(problem, candidate, k)
                if turned.ok and better(problem, fitted, turned, margin=margin, least=least):
                    fitted = turned
                    changed.append(k)
                    break
    return fitted, changed


def simplify_pass(
    problem: Problem, base: Fit, fitted: Fit, pool: Sequence[Placed], *, tie: float, shape: float, most: int = 6
) -> tuple[Fit, list[int]]:
    """Each flexible effect put against simpler ones at its place, now that the others are in place.

    A family with much freedom takes parts of a second effect while that is missing; once it is there, something
    specific may do as well. ``pool``: simpler candidates by how promising they looked; ``tie`` and ``shape`` as in
    ``select.Rule``.
    """
    changed: list[int] = []
    start = misfits(problem, base)
    for k in range(len(fitted.model.placed)):
        placed = fitted.model.placed[k]
        if placed.effect.claims is not None:
            continue
        held = [p for j, p in enumerate(fitted.model.placed) if j != k]
        mine = size(placed)
        now = misfits(problem, fitted)
        room = sum(max(now[o] - 1.0, 0.0) for o in placed.outputs)
        with np.errstate(all="ignore"):
            rest = reduced(problem, fitted, k)
        without = misfits(problem, rest) if held else start
        taken = sum(max(without[o] - now[o], 0.0) for o in placed.outputs)
        limit = tie * room + 0.02 + shape * taken
        elsewhere = {p.effect.name for p in held}
        akin = placed.effect.confusable_with
        # what it is likely to stand for is tried first
        order = sorted(
            enumerate(pool),
            key=lambda r: (r[1].effect.name not in elsewhere, r[1].effect.name not in akin, size(r[1]), r[0]),
        )
        if beyond_limits(fitted, placed):
            # a second effect has joined since, and what is left for this one is other physics: the likeliest first
            limit = max(limit, 2.0 * room + OTHER * taken)
            order.sort(key=lambda r: akin.index(r[1].effect.name) if r[1].effect.name in akin else len(akin))
        passed: list[tuple[int, float, int, Fit]] = []
        tried = 0
        for i, rival in order:
            name = rival.effect.name
            simpler = size(rival) < 0.6 * mine or (name in elsewhere and size(rival) <= mine)
            fits_here = set(rival.outputs) == set(placed.outputs) and simpler
            twice = any(p.effect.name == name and p.target == rival.target for p in held)
            # the same physics on another output speaks for a name, but noise that runs up everywhere for nothing
            shared = placed.effect.name in elsewhere and name not in elsewhere and not placed.effect.stochastic
            if not fits_here or name == placed.effect.name or twice or shared:
                continue
            tried += 1
            if tried > most:
                break
            with np.errstate(all="ignore"):
                candidate = added(problem, rest, rival)
            after = misfits(problem, candidate)
            left = sum(max(after[o] - 1.0, 0.0) for o in placed.outputs)
            if candidate.ok and left <= limit and not beyond_limits(candidate, candidate.model.placed[-1]):
                passed.append((size(rival), left, i, candidate))
        if passed:
            _, left, _, candidate = min(passed, key=lambda c: c[:3])
            turned = reordered(problem, candidate, k)
            # in another order two effects act on one another
            if turned.ok and total(problem, turned) <= total(problem, candidate) + 0.05 + 0.1 * left:
                fitted = turned
                changed.append(k)
    return fitted, changed


def reordered(problem: Problem, fitted: Fit, k: int) -> Fit:
    """The fit with the last effect of its model moved to position ``k``, fitted again."""
    order = list(fitted.model.placed)
    order.insert(k, order.pop())
    model = Model(problem.twin, order)
    theta = model.carry(fitted.model, fitted.theta, problem.recording)
    return fit(problem, model, [theta], iterations=6)


def prune(problem: Problem, fitted: Fit, *, z: float, gain: float) -> tuple[Fit, list[int]]:
    """Effects that no longer pay are dropped, the least useful first. Returns the model and the dropped positions
    (in the order of the model that came in).
    """
    positions = list(range(len(fitted.model.placed)))
    dropped: list[int] = []
    while len(positions) > 1:
        worth: list[tuple[float, int, Fit]] = []
        for k, placed in enumerate(fitted.model.placed):
            if placed.effect.claims is not None:
                continue
            small = reduced(problem, fitted, k)
            c = compare(problem, small, fitted)
            if not (c.z > z and c.gain > gain) and not (c.gain > INDISPENSABLE and c.improvement > 1.0):
                worth.append((c.improvement, k, small))
        if not worth:
            break
        _, k, fitted = min(worth, key=lambda w: (w[0], w[1]))
        dropped.append(positions.pop(k))
    return fitted, dropped


def pair_search(
    problem: Problem, current: Fit, trials: Sequence[Trial], *, z: float, gain: float, most: int = 5
) -> tuple[Fit, tuple[Trial, Trial]] | None:
    """Two effects together where none pays alone: the most promising by their one-step share, all pairs of them."""
    # what takes samples out of the comparison makes any pair look good
    models = (t for t in trials if t.fitted is not None and not t.refused and t.placed.effect.claims is None)
    hopeful = sorted(models, key=lambda t: -t.candidate.share)
    chosen: list[Trial] = []
    for t in hopeful:
        if all(t.name != c.name for c in chosen):
            chosen.append(t)
        if len(chosen) == most:
            break
    best: tuple[float, Fit, tuple[Trial, Trial]] | None = None
    for i, a in enumerate(chosen):
        for b in chosen[i + 1 :]:
            assert a.fitted is not None
            with np.errstate(all="ignore"):
                both = added(problem, a.fitted, b.placed)
            if not both.ok:
                continue
            c = compare(problem, current, both)
            alone = max(a.improvement, b.improvement)
            if (
                c.z > z
                and c.gain > 2 * gain
                and c.improvement > alone + 0.05
                and (best is None or c.improvement > best[0])
            ):
                best = (c.improvement, both, (a, b))
    return None if best is None else (best[1], best[2])
