"""Decides on scored sets: the named effects, their probabilities, equivalents, and if the account is complete."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.evidence import Doubt
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.intervals import rounding_left
from tools.mismatch.engine.noise import floor_interval
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Withheld
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.unexplained import LEAST_LEAD, Leftover, Stranger, about, lead, leftover
from tools.mismatch.infer.borne_out import Out, borne_out, doubts_of, entry_of
from tools.mismatch.infer.causes import caused_by
from tools.mismatch.infer.constants import Constants
from tools.mismatch.infer.density import unpredicted
from tools.mismatch.infer.loudness import LEAST_P, louder_with
from tools.mismatch.infer.store import Scored, Store, part_of

MARGIN = 1.05
"""Largest ratio of a rival's held-out residual rms to that of the named set at which the rival fits as well."""
KEPT = 0.5
"""Largest share of the named effect's own gain (log of the held-out rms) that a rival that fits as well may lack, as a
trial of non-inferiority keeps half of what the known remedy does (FDA, Non-Inferiority Clinical Trials, 2016, IV.A.3).
The margin alone would call every effect equal to one that gains less than the margin."""
TESTED, DEEPEST = 6, 30
"""Number of sets of names, best first, whose every name is tested; and the number if none has passed so far."""
CURVE = 12
"""Number of parameters charged for a free curve of a signal: the columns of a product of a curve and a mover."""
LOUD = 1.5
"""Ratio of the mean square of the residual to that of the loudest noise above which it is more than noise."""


@dataclass(frozen=True)
class Rival:
    """Describes a set that has ``name`` where the answer has ``instead_of``.

    ``ratio`` is its held-out rms over the answer's on ``output``; ``as_good`` is True if a paired test finds it no
    worse than the margin.
    """

    scored: Scored
    name: str
    instead_of: str
    output: str
    ratio: float
    as_good: bool


@dataclass(frozen=True)
class Answer:
    """Holds the decision.

    ``chosen`` is the set (the base if nothing is named), ``sure`` the probability per name. ``strange`` is a recorded
    signal whose free curve is a better account than any set. ``left`` is the rest per output, ``floors`` the interval
    of the noise rms per output. ``whole`` is True if nothing but form errors is left; ``doubtful`` lists outputs for
    which both ends of the interval differ in this. ``withheld`` lists effects that scored better without support.
    """

    chosen: Scored
    sure: Mapping[str, float]
    rivals: tuple[Rival, ...]
    strange: Stranger | None
    left: Mapping[str, Leftover]
    floors: Mapping[str, tuple[float, float]]
    whole: bool
    doubtful: tuple[str, ...] = ()
    withheld: tuple[Withheld, ...] = ()


def tested(store: Store, gone: Sequence[Out]) -> list[tuple[Scored, float]]:
    """Return (set, the weakest test of its names), best first, down to the empty set, without those that are ``gone``.

    A test of a name fits the set without it; that smaller set is ranked with the others. If no set has passed, the
    search goes deeper, because an unsupported name may be in all of the first sets.
    """
    out: dict[frozenset[str], tuple[Scored, float]] = {}
    passed, c = 0, store.constants

    def ranked() -> Iterator[Scored]:
        return (s for s in store.ranked() if not any(g(s) for g in gone))

    while len(out) < DEEPEST and (s := next((s for s in ranked() if s.names not in out), None)) is not None:
        out[s.names] = s, store.least_z(s)
        passed += out[s.names][1] > c.least_z
        if not s.names or (len(out) >= TESTED and passed):
            break
    return [out[s.names] for s in ranked() if s.names in out]


def accepted(store: Store, gone: Sequence[Out] = ()) -> list[Scored]:
    """Return the sets of which every name passes its test, best first; at least the empty one."""
    c = store.constants
    out = [s for s, z in tested(store, gone) if z > c.least_z]
    return out if any(not s.names for s in out) else [*out, store.base]


def surenesses(
    names: frozenset[str], sets: Sequence[tuple[frozenset[str], float]], known: bool, c: Constants
) -> dict[str, float]:
    """Return the probability of each of ``names`` among ``sets`` (names, score).

    It is the tempered posterior of the sets that have the name, mapped on a log odds scale that was calibrated on
    separate cases. ``known``: only noise is left.
    """
    weights = posterior(sets)
    return {name: stated(sum(w for of, w in weights if name in of), known, c) for name in names}


def posterior(sets: Sequence[tuple[frozenset[str], float]]) -> list[tuple[frozenset[str], float]]:
    """Return the share of the tempered posterior of each of ``sets`` (names, score)."""
    top = max(v for _, v in sets)
    weights = [(of, math.exp(v - top)) for of, v in sets]
    total = sum(w for _, w in weights)
    return [(of, w / total) for of, w in weights]


LIKELY = 0.9
"""Least posterior probability that a name of a whole account is not one too many. Of the calibrate corpus 7 of 14 names
were right that had 0.5 to 0.9, and 9 of 10 from there to 0.999."""


def is_likely(p: float, known: bool, c: Constants) -> bool:
    """Return True if a name of posterior probability ``p`` is to be reported.

    Beside an unexplained rest its probability must be stated to be at least a half.
    """
    return p >= LIKELY if known else stated(p, False, c) >= 0.5


def dispensable(
    names: frozenset[str], sets: Sequence[tuple[frozenset[str], float]], known: bool, c: Constants,
    score_of: Callable[[frozenset[str]], float],
) -> frozenset[str]:  # fmt: skip
    """Return those of ``names`` that may well be one too many, first the one without which the others score best: of
    two that stand for each other one is needed. ``score_of`` returns the score of a smaller set.

    A name has the support of the sets that have it, or others in its place: which of two equals it is, is a question
    of its own (``Answer.rivals``).
    """
    weights, kept = posterior(sets), names

    def support(name: str) -> float:
        rest = kept - {name}
        return sum(w for of, w in weights if name in of or rest < of)

    while doubted := [name for name in sorted(kept) if not is_likely(support(name), known, c)]:
        kept -= {max(doubted, key=lambda name: (score_of(kept - {name}), -support(name)))}
    return names - kept


FLOOR = 1e-6
"""Least distance of a probability from zero and one before its log odds are computed."""


def log_odds(p: float) -> float:
    p = min(max(p, FLOOR), 1.0 - FLOOR)
    return math.log(p / (1.0 - p))


def stated(p: float, known: bool, c: Constants) -> float:
    """Map a raw probability to the stated one.

    The raw one compares known effects only. If not all of the residual is ``known``, an unknown effect may have been
    mistaken for the name, and the stated probability is lower.
    """
    odds = c.sure_offset + c.sure_slope * log_odds(p) - (0.0 if known else c.sure_open)
    return min(1.0 / (1.0 + math.exp(-odds)), c.most_sure)


def rivals_of(store: Store, chosen: Scored) -> tuple[Rival, ...]:
    """Return the sets with one name of ``chosen`` replaced by another, best first.

    Equivalence is a paired test on held-out blocks with a margin, which is less for a weak effect (``KEPT``); fewer
    parameters give a rival no advantage.
    """
    margins = _margins(store, chosen)
    out: list[Rival] = []
    for s in store.ranked():
        gone, new = chosen.names - s.names, s.names - chosen.names
        if len(gone) != 1 or len(new) != 1:
            continue
        (name,), (instead,) = new, gone
        touched = [o for e in s.placed if e.effect.name == name for o in e.outputs]
        touched += [o for e in chosen.placed if e.effect.name == instead for o in e.outputs]
        out.append(Rival(s, name, instead, *_against(store.problem, chosen, s, touched, margins[instead])))
    return tuple(out[:8])


def _margins(store: Store, chosen: Scored) -> dict[str, dict[str, float]]:
    """Return per name and output the log ratio of residuals up to which another account fits as well."""
    p = store.problem
    chosen_rms = held_rms(p, chosen.fitted)
    margins: dict[str, dict[str, float]] = {}
    for name in sorted(chosen.names):
        without = held_rms(p, store.without(chosen, lambda e, n=name: e.effect.name == n).fitted)
        gains = {o: math.log(max(without[o] / max(rms, 1e-300), 1.0)) for o, rms in chosen_rms.items()}
        margins[name] = {o: min(math.log(MARGIN), KEPT * v) for o, v in gains.items()}
    return margins


def _against(
    p: Problem, chosen: Scored, s: Scored, touched: Sequence[str], margin: Mapping[str, float]
) -> tuple[str, float, bool]:
    """Return the output on which ``s`` loses most to ``chosen``, the ratio of the residuals there, and True if a paired
    test finds ``s`` no worse than the margin."""
    own, other = held_rms(p, chosen.fitted), held_rms(p, s.fitted)
    output = max(dict.fromkeys(touched), key=lambda o: other[o] / max(own[o], 1e-300))
    ratio = other[output] / max(own[output], 1e-300)
    worse = (chosen.blocks - s.blocks).sum(axis=1)
    spread = float(np.std(worse, ddof=1) / math.sqrt(worse.size)) if worse.size > 1 else math.inf
    within = float(np.mean(worse)) + 1.645 * spread < sum(margin[o] for o in set(touched))
    return output, ratio, within and math.log(max(ratio, 1e-300)) <= margin[output]


FORMS = 3
"""Number of other forms of the named effects whose parameters widen the intervals."""


def other_forms(store: Store, chosen: Scored) -> list[Scored]:
    """Return the sets that have other forms of the effects of ``chosen``, at the same places."""
    where = sorted((e.effect.name, e.site, e.target) for e in chosen.placed)
    return [
        s
        for s in store.sets.values()
        if s.key != chosen.key and sorted((e.effect.name, e.site, e.target) for e in s.placed) == where
    ]


def forms_as_good(store: Store, chosen: Scored) -> tuple[Fit, ...]:
    """Return the fits of other forms of the effects of ``chosen`` at their places that fit as well, best first.

    A form that would not be named itself, because a size that it needs may be zero, is none of them.
    """
    alike = other_forms(store, chosen)
    alike += [store.with_law(chosen, k, law) for k, e in enumerate(chosen.placed) for law in e.effect.other_laws]
    if not chosen.placed or not alike:
        return ()
    margins, own = _margins(store, chosen), {part_of(e) for e in chosen.placed}
    good: list[Scored] = []
    for s in sorted(alike, key=store.score, reverse=True):
        other = [e for e in s.placed if part_of(e) not in own]
        touched = [o for e in other for o in e.outputs]
        margin = {o: min(margins[e.effect.name][o] for e in other) for o in store.problem.twin.outputs}
        if s.proper and _against(store.problem, chosen, s, touched, margin)[2]:
            good.append(s)
    refined = (store.refined(s).fitted for s in good[:FORMS])
    return tuple(f for f in refined if not doubts_of(store.problem, f))


def candidate_signals(first: Sequence[Trial]) -> frozenset[str]:
    """Return the recorded signals that some candidate effect uses: these have effects of their own."""
    return frozenset(s for t in first for s in about(t.placed.effect))


def free_curve(problem: Problem, fitted: Fit, known: frozenset[str]) -> Stranger | None:
    """Find the recorded signal whose free curve explains most of the residual of ``fitted``.

    Signals of candidate effects are excluded; the output is the one that is furthest from its noise.
    """
    found = (lead(problem, fitted, o, least=LEAST_LEAD) for o in problem.twin.outputs)
    leads = [f for f in found if f is not None and f.signal not in known]
    return max(leads, key=lambda f: f.share, default=None)


def curve_score(store: Store, s: Scored, found: Stranger) -> float:
    """Return the score of ``s`` with a free curve beside it: its gain on held-out blocks, less its price."""
    c = store.constants
    gain = store.count.curve_gain(store.short(s)[found.output], found.share) / store.outputs
    return store.score(s) + gain - c.per_name - c.per_parameter * CURVE


@dataclass(frozen=True)
class Rest:
    """Holds the rest of a model: ``fit`` with the unpredicted part as residual, ``left`` with the signals that it
    follows per output, ``floors`` with the interval of the noise rms.
    """

    fit: Fit = field(repr=False)
    left: Mapping[str, Leftover]
    floors: Mapping[str, tuple[float, float]]


def rest_of(problem: Problem, fitted: Fit, of_any_colour: Collection[str] = ()) -> Rest:
    """Return the rest of a model.

    The rest is real if it follows a signal or if it is louder than the noise can be, which on some outputs may be noise
    ``of_any_colour``. Readings on a lattice are as loud as its rounding, because beside an edge the side is unknown.
    """
    rest = unpredicted(problem, fitted)
    left: dict[str, Leftover] = {}
    floors: dict[str, tuple[float, float]] = {}
    for o in problem.twin.outputs:
        v = leftover(problem, rest, o)
        follows = max((d.strength for d in v.follows), default=0.0) if v.real else 0.0
        held = rest.residual[o][problem.held_rows]
        low, most = floor_interval(
            problem.floors[o], held, follows, 1 / problem.recording.dt, of_any_colour=o in of_any_colour
        )
        low = max(low, rounding_left(problem, fitted, o))
        most = max(most, problem.floors[o].step / math.sqrt(12.0), low)
        left[o] = replace(v, real=v.real or v.ratio * problem.sigma(o) ** 2 > LOUD * most**2)
        floors[o] = low, most
    return Rest(rest, left, floors)


def worst_left(problem: Problem, base: Fit, rest: Rest, *, doubt: bool) -> tuple[float, float]:
    """Return (noise variances that follow a signal on the worst output, noise variances that were explained there).

    With ``doubt`` the noise is as loud as it can be, else as it was estimated.
    """
    noise = {o: max(rest.floors[o][int(doubt)], problem.sigma(o)) for o in rest.left}
    real = {o: v.ratio * (problem.sigma(o) / noise[o]) ** 2 for o, v in rest.left.items() if v.real}
    if not real:
        return 0.0, 0.0
    o = max(real, key=lambda o: real[o])
    before = float(np.mean((base.residual[o][problem.held_rows] / noise[o]) ** 2))
    return max(real[o] - 1.0, 0.0), max(before - real[o], 0.0)


def is_whole(rest: float, explained: float, c: Constants) -> bool:
    """Return True if the rest that follows a signal is within the form error of the named effects.

    ``rest`` and ``explained`` are in noise variances.
    """
    return rest <= max(c.cut, c.cut_share * explained)


def _with_leads(problem: Problem, rest: Rest) -> dict[str, Leftover]:
    """Return the rest per output, led by the recorded condition that most of it follows."""
    found = {o: lead(problem, rest.fit, o) if v.real else None for o, v in rest.left.items()}
    return {o: v if (led := found[o]) is None else v.led_by(led) for o, v in rest.left.items()}


def decide(store: Store, first: Sequence[Trial]) -> Answer:
    """Decide on a finished search. ``first``: the candidates that were screened beside the base."""
    good, withheld = borne_out(store, accepted)
    chosen = good[0]
    strange = free_curve(store.problem, store.base.fitted, candidate_signals(first))
    if strange is not None and curve_score(store, store.base, strange) > store.score(chosen):
        chosen, withheld = store.base, ()
    else:
        strange = None
    judged = judge(store, chosen, strange)
    sets = [(s.names, store.score(s)) for s in good]
    c, events = store.constants, store.eventful[chosen.key][1]
    unlikely = dispensable(
        chosen.names, sets, judged.known, c,
        lambda kept: store.score(store.without(chosen, lambda e: e.effect.name not in kept)),
    )  # fmt: skip
    unlikely |= {name for name, p in events.items() if not is_likely(1.0 - p, judged.known, c)}
    if unlikely:
        final = judged.final
        withheld += tuple(
            entry_of(store, final, Doubt(k, "unlikely", ()))
            for k, e in enumerate(final.placed)
            if e.effect.name in unlikely
        )
        chosen = store.without(chosen, lambda e: e.effect.name in unlikely)
        fewer = judge(store, chosen, strange, events.keys() - unlikely)
        # fewer names are no better account
        judged = replace(fewer, whole=judged.whole and fewer.whole, known=judged.known and fewer.known)
    sure = surenesses(chosen.names, sets, judged.known, c)
    sure |= {name: stated(1.0 - p, judged.known, c) for name, p in events.items() if name not in unlikely}
    left = judged.rest.left
    if strange is not None:
        left = {o: v.led_by(strange) if o == strange.output else v for o, v in left.items()}
    else:
        left = _with_leads(store.problem, judged.rest)
    return Answer(
        judged.final, sure, rivals_of(store, chosen), strange, left, judged.rest.floors, judged.whole, judged.doubtful,
        withheld,
    )  # fmt: skip


def without_doubted(store: Store, answer: Answer, through: Fit, doubt: Doubt) -> Answer:
    """Return ``answer`` without the effect that is in doubt in ``through``, its fit over the whole run.

    Fewer names are no better account.
    """
    of = replace(answer.chosen, fitted=through)
    name = of.placed[doubt.k].effect.name
    smaller = store.without(answer.chosen, lambda e: e.effect.name == name)
    judged = judge(store, smaller, answer.strange, frozenset())
    return replace(
        answer, chosen=judged.final, sure={n: p for n, p in answer.sure.items() if n != name},
        rivals=rivals_of(store, judged.final), left=_with_leads(store.problem, judged.rest), floors=judged.rest.floors,
        whole=answer.whole and judged.whole, doubtful=judged.doubtful,
        withheld=(*answer.withheld, entry_of(store, of, doubt)),
    )  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """Holds ``final``, a set with the events beside it, its ``rest``, and if that is an account (``whole``).

    ``doubtful`` lists the outputs whose noise decides this; ``known`` is True if it is an account however loud the
    noise is, and not only because errors of form are forgiven their share: that rest may be other physics.
    """

    final: Scored
    rest: Rest
    whole: bool
    doubtful: tuple[str, ...]
    known: bool


def judge(store: Store, chosen: Scored, strange: Stranger | None, events: Collection[str] | None = None) -> Judged:
    """Judge the rest of a set. ``events``: the names of those beside it that stay (None: all)."""
    p, c = store.problem, store.constants
    final = store.with_events(chosen)
    if events is not None and any(name not in events for name in final.names - chosen.names):
        final = store.without(final, lambda e: e.effect.claims is not None and e.effect.name not in events)
    rest = rest_of(p, final.fitted)
    left, most_left = (worst_left(p, store.base.fitted, rest, doubt=doubt) for doubt in (False, True))
    quiet, loud = is_whole(*left, c), is_whole(*most_left, c)
    bare = [o for o in p.twin.outputs if not any(o in e.outputs for e in final.placed)]
    if bare and not quiet and strange is None:
        # what follows nothing that was recorded, and no effect explains, may be noise of any colour
        coloured = rest_of(p, final.fitted, bare)
        if is_whole(*worst_left(p, store.base.fitted, coloured, doubt=False), c):
            loudest = tuple(o for o, (_, hi) in coloured.floors.items() if hi > rest.floors[o][1])
            moved = ((o, louder_with(p, coloured.fit, o) or caused_by(p, coloured.fit, o)) for o in loudest)
            known = {**followed_by(store), **{o: d for o, d in moved if d is not None}}
            known = {o: d for o, d in known.items() if o in loudest}
            if not known:
                return Judged(final, coloured, True, loudest, False)
            # noise is not louder where the simulation moves more, the past of what moves does not predict it, and the
            # walk or drift that fits it follows nothing
            left = {
                o: replace(v, follows=(known[o], *v.follows), real=True) if o in known else v
                for o, v in rest.left.items()
            }
            return Judged(final, replace(rest, left=left), False, (), False)
    # the noise as estimated decides where nothing is named, and where more would be left of it than the names explain:
    # a doubt that is larger than what was found is reported
    whole = strange is None and (quiet or (loud and bool(final.placed) and left[0] <= left[1]))
    doubtful = tuple(o for o, (_, hi) in rest.floors.items() if hi > p.sigma(o)) if loud and not quiet else ()
    return Judged(final, rest, whole, doubtful, whole and quiet and most_left[0] <= c.cut)


def followed_by(store: Store) -> dict[str, Dependence]:
    """Return per output what an effect that depends on no signal follows, in sets that score better than the base."""
    out: dict[str, Dependence] = {}
    for s in store.every_ranked():
        if s.key == store.base.key:
            break
        found = store.dependent(s)
        if found is not None and found[1].p_value < LEAST_P:
            out |= {o: found[1] for o in found[0].outputs if o not in out}
    return out


def recalibrated(store: Store, raw: Fit) -> bool:
    """Return True if re-fitted base parameters predict better than the given ones by more than their price."""
    c = store.constants
    gain = store.lost(store.scored(raw)) - store.lost(store.base)
    return gain > c.per_parameter * store.base.fitted.model.n_base + c.per_name


__all__ = ["Answer", "Rival", "accepted", "decide", "recalibrated"]
