"""Forward selection: one effect at a time, the best that is acceptable, until none is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.families import FILTERS, LOOSE, beside_flexible, in_disguise, key_of, own_form
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.parsimony import Rule, choose, refine
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.revise import pair_search
from tools.mismatch.engine.score import misfits
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import LEAST_FITS, MOST_FITS, Progress, Trial, try_all
from tools.mismatch.engine.unexplained import SHAPELESS, Stranger, about, stranger
from tools.mismatch.engine.vary import size
from tools.mismatch.placed import Placed

MOST_EXCUSED = 0.1  # of the samples: more is not short and isolated
FITS = (LEAST_FITS, MOST_FITS)
OF_A_WALK = 0.7  # of the excess that integrated noise leaves nobody else: between its knots it is still noise
WORTH_A_PAIR = 1.5  # mean square over noise variance above which two effects are tried together


@dataclass(frozen=True)
class Work:
    """What a search tries and how: ``stride`` thins the rows of a trial, ``jobs`` processes."""

    effects: tuple[Effect, ...]
    rule: Rule
    stride: int = 1
    jobs: int = 1
    progress: Progress | None = None

    def tried(
        self, problem: Problem, current: Fit, pool: Sequence[Placed], what: str, fits: tuple[int, int] = FITS
    ) -> list[Trial]:
        """Every place of ``pool`` screened against ``current``; of each kind ``fits`` at least and at most fitted."""
        least, most = fits
        return try_all(
            problem, current, pool, stride=self.stride, jobs=self.jobs, progress=self.progress, what=what,
            least=least, most=most,
        )  # fmt: skip


@dataclass(frozen=True)
class Way:
    """How far one forward selection came; ``passed`` every acceptable trial with the steps before it."""

    problem: Problem
    current: Fit
    steps: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    first: tuple[Trial, ...]
    passed: tuple[tuple[Trial, ...], ...]
    strange: Stranger | None


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
        starts, stops = settings.get("starts", ()), settings.get("stops", ())
        # in a short record several bursts are a larger part of it
        several = len(starts) >= 3 and share > 0.95
        most_taken = (2.0 if several else 1.0) * MOST_EXCUSED
        if sum(stops) - sum(starts) > most_taken * trial.fitted.residual[trial.placed.outputs[0]].size:
            return False
        loud = max(c.before.values(), default=0.0) > 1.3
        # no tail, however heavy, puts most of a record's energy into a few neighbours
        most = p < 1e-4 and share > 0.8
        return (p < rule.p_tested and share > 0.2) or most or (loud and share > 0.6 and c.z > 7.0 and c.gain > 0.08)
    if trial.refused:
        return False
    # noise that runs up is all of it, or has only followed something else
    if trial.placed.effect.stochastic and c.excess_gain < OF_A_WALK:
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


def forward(
    problem: Problem, base: Fit, begin: Fit, chosen: Sequence[Trial], work: Work, first: tuple[Trial, ...] = ()
) -> Way:
    """Forward selection from ``begin``, which has the effects of ``chosen``."""
    rule = work.rule
    current = begin
    start = misfits(problem, base)
    steps: list[Trial] = list(chosen)
    rivals: list[tuple[Trial, ...]] = [() for _ in steps]
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
            for p in places(problem, work.effects, current.model.placed)
            if p.effect.claims is not None
            or p.effect.name == "quantization"  # the noise floor holds its steps
            or any(
                now[o] - 1 > max(0.5 * rule.gain, form[o] if p.effect.name in LOOSE else min(form[o], 0.2))
                for o in p.outputs
            )
        ]
        todo = [p for p in pool if key_of(p) not in known]
        for t in work.tried(problem, current, todo, f"step {len(steps) + 1}"):
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
        best = choose(candidates(good), rule, now, frozenset(t.name for t in steps))
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
        alike = same_elsewhere(good, best, rule, now) if decoupled else []
        touched: set[str] = set()
        for trial in (best, *alike):
            if trial is not best:
                refined = refine(problem, current, trial)
                assert refined.fitted is not None
            steps.append(refined)
            shared = [t for t in good if t is not trial and set(t.placed.outputs) & set(trial.placed.outputs)]
            rivals.append(tuple(sorted(shared, key=lambda t, mine=trial: (_left(t, mine), t.label))))
            current = refined.fitted
            touched |= set(trial.placed.outputs)
        quieter = problem.quieter(current.residual)
        if quieter is not problem:
            problem, start = quieter, misfits(quieter, base)
            current = fit(problem, current.model, [current.theta], iterations=6)
            steps[-1] = replace(refined, fitted=current, misfits=misfits(problem, current))
        # what looked hopeless beside a louder output is looked at again now that this one is quieter
        known = {
            k: t for k, t in known.items() if decoupled and t.fitted is not None and not touched & set(t.placed.outputs)
        }
    return Way(problem, current, tuple(steps), tuple(rivals), first, tuple(passed), strange)


def same_elsewhere(good: Sequence[Trial], best: Trial, rule: Rule, now: Mapping[str, float]) -> list[Trial]:
    """The same physics where it would be chosen on other outputs too, of a twin whose outputs share nothing: with one
    fit of each it is there, instead of one search for each.
    """
    found: list[Trial] = []
    for o in sorted({o for t in good for o in t.placed.outputs} - set(best.placed.outputs)):
        here = [t for t in good if t.placed.outputs == (o,)]
        if here and all(o not in t.placed.outputs or t in here for t in good):
            mine = choose(candidates(here), rule, now, frozenset((best.name,)))
            if mine.name == best.name and about(mine.placed.effect) == ():
                found.append(mine)
    return found


def candidates(good: Sequence[Trial]) -> list[Trial]:
    """Which of the acceptable trials stand for choice: bursts taken out of the comparison make no model, so they only
    where no model does better; levels read off the data model bursts only by following them.
    """
    models = [t for t in good if t.placed.effect.claims is None]
    bursts = [t for t in good if t.placed.effect.claims is not None]
    excess = lambda t: max(t.misfits[o] - 1.0 for o in t.placed.outputs)  # noqa: E731

    def follows_bursts(t: Trial) -> bool:
        same = [b for b in bursts if set(b.placed.outputs) <= set(t.placed.outputs)]
        return t.name in SHAPELESS and any(excess(b) < 2.0 * excess(t) for b in same)

    if not any(t.comparison and t.comparison.excess_gain > 0.5 for t in models):
        return list(good)
    return [t for t in models if not follows_bursts(t)] or bursts


def _left(rival: Trial, best: Trial) -> float:
    """Return what a rival leaves on the outputs that both serve."""
    return sum(rival.misfits[o] for o in best.placed.outputs if o in rival.placed.outputs)
