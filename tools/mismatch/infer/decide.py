"""From scored sets to an answer: which names, how sure, what is equivalent, and whether that is the whole account."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.noise import floor_interval
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Withheld
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.unexplained import Leftover, Stranger, about, lead, leftover
from tools.mismatch.infer.borne_out import borne_out, entry_of
from tools.mismatch.infer.constants import Constants
from tools.mismatch.infer.density import unpredicted, weigh
from tools.mismatch.infer.store import Scored, Store

MARGIN = 1.05
"""Residual rms of a rival over that of the named set, on held-out samples, within which it fits as well."""
TESTED, DEEPEST = 6, 30
"""Sets of names, best first, whose every name is tested; and how many while none has passed."""
CURVE = 12
"""Parameters that a free curve of a signal is charged for: the columns of a product of a curve and a mover."""
LOUD = 1.5
"""Mean square of what is left over that of the loudest noise, from which it is more than noise."""
LEAST_LEAD = 0.1
"""Share of a residual that a free curve must take to be a rival of effects."""


@dataclass(frozen=True)
class Rival:
    """A set that has ``name`` where the answer has ``instead_of``. ``ratio``: its held-out rms over the answer's on
    ``output``; ``as_good``: no worse than the margin by a paired test."""

    scored: Scored
    name: str
    instead_of: str
    output: str
    ratio: float
    as_good: bool


@dataclass(frozen=True)
class Answer:
    """``chosen`` (the base where nothing is named); ``sure`` per name; ``rivals``; ``strange``: a recorded signal whose
    free curve is a better account than any set; ``left`` per output; ``floors``: per output the interval of the noise
    rms; ``whole``: nothing more is left than form errors; ``doubtful``: outputs where the two ends of that interval
    differ in this; ``withheld``: effects that scored better and are not borne out.
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


def tested(store: Store) -> list[tuple[Scored, float]]:
    """(set, the weakest test of its names), best first, down to the empty one. A name that is not borne out beside one
    set may be in all of the first: then it is looked further."""
    out: list[tuple[Scored, float]] = []
    passed, c = 0, store.constants
    for s in store.ranked()[:DEEPEST]:
        out.append((s, store.least_z(s)))
        passed += out[-1][1] > c.least_z
        if not s.names or (len(out) >= TESTED and passed):
            break
    return out


def accepted(store: Store) -> list[Scored]:
    """Sets of which every name passes its test, best first; at least the empty one."""
    c = store.constants
    out = [s for s, z in tested(store) if z > c.least_z]
    return out if any(not s.names for s in out) else [*out, store.base]


def surenesses(
    names: frozenset[str], sets: Sequence[tuple[frozenset[str], float]], whole: bool, c: Constants
) -> dict[str, float]:
    """How sure each of ``names`` is among ``sets`` (names, score): the share of the tempered posterior on sets
    that have it, on a log odds scale that was calibrated on cases of its own. ``whole``: nothing more is left.
    """
    top = max(v for _, v in sets)
    weights = [(of, math.exp(v - top)) for of, v in sets]
    total = sum(w for _, w in weights)
    out: dict[str, float] = {}
    for name in names:
        p = sum(w for of, w in weights if name in of) / total
        out[name] = stated(p, whole, c)
    return out


FLOOR = 1e-6
"""Probabilities are kept this far from zero and one before their log odds are taken."""


def log_odds(p: float) -> float:
    p = min(max(p, FLOOR), 1.0 - FLOOR)
    return math.log(p / (1.0 - p))


def stated(p: float, whole: bool, c: Constants) -> float:
    """The probability that is stated for a raw one. The raw one is among what is known: where the account is not
    ``whole``, something else is at work that may have been taken for it."""
    odds = c.sure_offset + c.sure_slope * log_odds(p) - (0.0 if whole else c.sure_open)
    return min(1.0 / (1.0 + math.exp(-odds)), c.most_sure)


def rivals_of(store: Store, chosen: Scored) -> tuple[Rival, ...]:
    """Sets with one name of ``chosen`` replaced by another, best first: equivalence is a paired test on held-out blocks
    with a margin, in both directions of which a rival with fewer parameters has no advantage.
    """
    p = store.problem
    mine = held_rms(p, chosen.fitted)
    out: list[Rival] = []
    for s in store.ranked():
        gone, new = chosen.names - s.names, s.names - chosen.names
        if len(gone) != 1 or len(new) != 1:
            continue
        (name,), (instead,) = new, gone
        touched = [o for e in s.placed if e.effect.name == name for o in e.outputs]
        touched += [o for e in chosen.placed if e.effect.name == instead for o in e.outputs]
        his = held_rms(p, s.fitted)
        output = max(dict.fromkeys(touched), key=lambda o: his[o] / max(mine[o], 1e-300))
        ratio = his[output] / max(mine[output], 1e-300)
        worse = (chosen.blocks - s.blocks).sum(axis=1)
        spread = float(np.std(worse, ddof=1) / math.sqrt(worse.size)) if worse.size > 1 else math.inf
        within = float(np.mean(worse)) + 1.645 * spread < math.log(MARGIN) * len(set(touched))
        out.append(Rival(s, name, instead, output, ratio, ratio <= MARGIN and within))
    return tuple(out[:8])


def candidate_signals(first: Sequence[Trial]) -> frozenset[str]:
    """Recorded signals that some candidate is about: these have effects of their own."""
    return frozenset(s for t in first for s in about(t.placed.effect))


def free_curve(problem: Problem, fitted: Fit, known: frozenset[str]) -> Stranger | None:
    """The recorded signal, about which no candidate effect is, whose free curve takes most of what ``fitted`` leaves
    on the output that is furthest from its noise."""
    found = (lead(problem, fitted, o, least=LEAST_LEAD) for o in problem.twin.outputs)
    leads = [f for f in found if f is not None and f.signal not in known]
    return max(leads, key=lambda f: f.share, default=None)


def curve_score(store: Store, s: Scored, found: Stranger) -> float:
    """The score of ``s`` with a free curve beside it: its gain on blocks that it has not seen, less its price."""
    c = store.constants
    gain = -0.5 * math.log(max(1.0 - found.share, 1e-12)) * store.counted / store.outputs
    room = store.room(s)[found.output]
    return store.score(s) + min(gain, room) - c.per_name - c.per_parameter * CURVE


@dataclass(frozen=True)
class Rest:
    """What a model leaves: ``fit`` with what nothing predicts as its residual, ``left`` what that follows per output,
    ``floors`` the interval of the noise rms."""

    fit: Fit = field(repr=False)
    left: Mapping[str, Leftover]
    floors: Mapping[str, tuple[float, float]]


def rest_of(problem: Problem, fitted: Fit) -> Rest:
    """What a model leaves. It is real, too, where it is louder than the noise can be, whether it follows anything or
    not. Readings on a lattice are as loud as its rounding: beside an edge nobody knows the side."""
    rest = unpredicted(problem, fitted)
    left: dict[str, Leftover] = {}
    floors: dict[str, tuple[float, float]] = {}
    for o in problem.twin.outputs:
        v = leftover(problem, rest, o)
        follows = max((d.strength for d in v.follows), default=0.0) if v.real else 0.0
        held = rest.residual[o][problem.held_rows]
        low, most = floor_interval(problem.floors[o], held, follows, 1 / problem.recording.dt)
        most = max(most, problem.floors[o].step / math.sqrt(12.0))
        left[o] = replace(v, real=v.real or v.ratio * problem.sigma(o) ** 2 > LOUD * most**2)
        floors[o] = low, most
    return Rest(rest, left, floors)


def worst_left(problem: Problem, base: Fit, rest: Rest, *, doubt: bool) -> tuple[float, float]:
    """(noise variances that follow something on the output where most does, those that were explained there). With
    ``doubt`` the noise is as loud as it can be, else as it was estimated."""
    noise = {o: max(rest.floors[o][1], problem.sigma(o)) if doubt else problem.sigma(o) for o in rest.left}
    real = {o: v.ratio * (problem.sigma(o) / noise[o]) ** 2 for o, v in rest.left.items() if v.real}
    if not real:
        return 0.0, 0.0
    o = max(real, key=lambda o: real[o])
    before = float(np.mean((base.residual[o][problem.held_rows] / noise[o]) ** 2))
    return max(real[o] - 1.0, 0.0), max(before - real[o], 0.0)


def is_whole(rest: float, taken: float, c: Constants) -> bool:
    """Whether what is left and follows a signal is no more than the form of what is named may leave."""
    return rest <= max(c.cut, c.cut_share * taken)


def _with_leads(problem: Problem, rest: Rest) -> dict[str, Leftover]:
    """What is left, led by the recorded condition that most of it follows."""
    found = {o: lead(problem, rest.fit, o) if v.real else None for o, v in rest.left.items()}
    return {o: v if (led := found[o]) is None else v.led_by(led) for o, v in rest.left.items()}


UNLIKELY = 0.5
"""Share of the probability that the surest name has beside something unexplained, below which a name is not stated."""


def decide(store: Store, first: Sequence[Trial]) -> Answer:
    """The answer of a finished search. ``first``: the candidates that were screened beside the base."""
    p, c = store.problem, store.constants
    good, withheld = borne_out(store, accepted(store))
    chosen = good[0]
    strange = free_curve(p, store.base.fitted, candidate_signals(first))
    if strange is not None and curve_score(store, store.base, strange) > store.score(chosen):
        chosen, withheld = store.base, ()
    else:
        strange = None
    said = store.with_events(chosen)
    rest = rest_of(p, said.fitted)
    if strange is not None:
        left = {o: v.led_by(strange) if o == strange.output else v for o, v in rest.left.items()}
    else:
        left = _with_leads(p, rest)
    quiet, loud = (is_whole(*worst_left(p, store.base.fitted, rest, doubt=doubt), c) for doubt in (False, True))
    # with nothing named the doubt is what is said
    whole = strange is None and (loud if said.placed else quiet)
    doubtful = tuple(o for o, (_, hi) in rest.floors.items() if hi > p.sigma(o)) if loud and not quiet else ()
    sure = surenesses(chosen.names, [(s.names, store.score(s)) for s in good], whole, c)
    sure |= {name: stated(1.0 - p_value, whole, c) for name, p_value in store.eventful[chosen.key][1].items()}
    least = 0.0 if whole else UNLIKELY * stated(1.0, False, c)
    unlikely = {name for name, v in sure.items() if v < least}
    if unlikely:
        withheld += tuple(entry_of(store, said, k) for k, e in enumerate(said.placed) if e.effect.name in unlikely)
        said = store.without(said, lambda e: e.effect.name in unlikely)
        chosen = store.without(chosen, lambda e: e.effect.name in unlikely)
        rest = rest_of(p, said.fitted)
        left = _with_leads(p, rest)
    return Answer(said, sure, rivals_of(store, chosen), strange, left, rest.floors, whole, doubtful, withheld)


def recalibrated(store: Store, raw: Fit) -> bool:
    """Whether re-fitted base parameters predict better than the given ones by more than their price."""
    p, c = store.problem, store.constants
    before = float(np.mean([np.mean(w.density[p.held_rows]) for w in weigh(p, raw).values()]))
    gain = store.counted * (float(np.mean([*store.base.density.values()])) - before)
    return gain > c.per_parameter * store.base.fitted.model.n_base + c.per_name


__all__ = ["Answer", "Rival", "accepted", "decide", "recalibrated"]
