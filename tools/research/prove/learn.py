"""Learns the constants of the decision from searches whose answer is known.

Fits are not repeated: what a decision reads of a search is a few numbers per set (``traits_of``), and all of the
learning works on these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from tools.mismatch.infer.constants import START, Constants
from tools.mismatch.infer.count import Count
from tools.mismatch.infer.decide import (
    CURVE,
    candidate_signals,
    dispensable,
    free_curve,
    is_whole,
    log_odds,
    rest_of,
    stated,
    surenesses,
    tested,
    worst_left,
)
from tools.mismatch.infer.run import Inferred
from tools.mismatch.infer.store import z_of_p

Traits = Mapping[str, Any]

CLIP = -4.0
"""Least log probability of the right set that counts: a few deep misses of the search shall not own the constants."""
LOOKED_AT = 3
"""Sets of names, best first, whose leftovers are looked at."""
FOLDS = 5
TOP = 0.8
"""Raw probability from which a name counts for the most that is stated."""
WIDE = 4.0
"""Log odds that an account which is not whole may take from a name before the cases have spoken."""
SETS = 60
"""Sets kept of a search, best first."""


@dataclass(frozen=True)
class SetTraits:
    """Holds the figures of a set of names that a decision uses.

    ``short`` is that of ``Store.short`` per output; ``z`` is that of the weakest name (None: not tested); ``rest`` and
    ``explained`` are those of ``worst_left`` (None: not computed); ``events`` has the p-values of events found beside
    the set.
    """

    names: frozenset[str]
    short: tuple[float, ...]
    parameters: float
    laws: int
    choices: float
    z: float | None
    rest: float | None
    explained: float | None
    events: Mapping[str, float] = field(default_factory=dict[str, float])

    def with_events(self, c: Constants) -> frozenset[str]:
        """Return the names that a report of this set has."""
        return self.names | {n for n, p in self.events.items() if z_of_p(p) > c.least_z}

    def score(self, c: Constants, held: int, outputs: float) -> float:
        """Return the score as ``Store.score`` does."""
        count = Count.of(c, held)
        lost = sum(count.lost(v) for v in self.short) / outputs
        return -lost - c.per_name * self.laws - self.choices - c.per_parameter * self.parameters


def traits_of(inferred: Inferred) -> dict[str, Any]:
    """Return the figures of a search that a decision uses, as plain JSON."""
    store = inferred.found.store
    weakest = {s.key: z for s, z in tested(store, ()) if s.names}
    ranked = store.ranked()  # tests may have fitted sets anew
    leaves: dict[frozenset[tuple[str, ...]], tuple[float, float]] = {}
    events: dict[frozenset[tuple[str, ...]], dict[str, float]] = {}
    for s in [*ranked[:LOOKED_AT], store.base]:
        eventful = store.with_events(s)
        rest = rest_of(store.problem, eventful.fitted)
        leaves[s.key] = worst_left(store.problem, store.base.fitted, rest, doubt=bool(eventful.placed))
        events[s.key] = store.eventful[s.key][1]
    strange = free_curve(store.problem, store.base.fitted, candidate_signals(inferred.found.first))
    names = {s.names for s in ranked}
    kept = sorted((s for s in store.sets.values() if s.proper and s.names in names), key=lambda s: -store.score(s))
    return {
        "held": int(store.problem.held_rows.size),
        "outputs": store.outputs,
        "sets": [
            {"names": sorted(s.names), "short": [*store.short(s).values()], "parameters": s.parameters,
             "laws": s.laws, "choices": s.choices, "tested": weakest.get(s.key), "left": leaves.get(s.key),
             "events": events.get(s.key, {})}
            for s in [*kept[:SETS], *([] if store.base in kept[:SETS] else [store.base])]
        ],
        "strange": None if strange is None else {
            "share": strange.share,
            "short": store.short(store.base)[strange.output],
        },
    }  # fmt: skip


def sets_of(traits: Traits) -> list[SetTraits]:
    """The sets of a search. What was tested of one set of names stands for its other places and forms, too."""
    passed: dict[frozenset[str], float] = {}
    left: dict[frozenset[str], tuple[float, float]] = {}
    events: dict[frozenset[str], Mapping[str, float]] = {}
    for s in traits["sets"]:
        names = frozenset(s["names"])
        if s["tested"] is not None:
            passed.setdefault(names, float(s["tested"]))
        if s["left"] is not None:
            left.setdefault(names, (float(s["left"][0]), float(s["left"][1])))
            events.setdefault(names, {n: float(p) for n, p in s["events"].items()})
    out: list[SetTraits] = []
    for s in traits["sets"]:
        names = frozenset(s["names"])
        rest, explained = left.get(names, (None, None))
        beside = events.get(names, {})
        out.append(
            SetTraits(
                names,
                tuple(s["short"]),
                float(s["parameters"]),
                int(s["laws"]),
                float(s["choices"]),
                passed.get(names),
                rest,
                explained,
                beside,
            )
        )
    return out


@dataclass(frozen=True)
class Case:
    """Holds a search with its answer: the true ``names`` and the true ``verdict`` up to recalibration."""

    case: str
    kind: str
    names: frozenset[str]
    held: int
    sets: tuple[SetTraits, ...]
    curve: tuple[float, float] | None
    """(Share of the residual of the twin that the best free curve of a signal removes about which no effect is, nats
    per sample that the twin is short of noise there)."""
    outputs: float = 1.0

    @staticmethod
    def of(case: str, kind: str, names: Sequence[str], traits: Traits) -> Case:
        strange = traits["strange"]
        curve = None if strange is None else (float(strange["share"]), float(strange["short"]))
        sets = tuple(sets_of(traits))
        return Case(case, kind, frozenset(names), int(traits["held"]), sets, curve, float(traits["outputs"]))

    def score(self, s: SetTraits, c: Constants) -> float:
        return s.score(c, self.held, self.outputs)

    def ranked(self, c: Constants) -> list[SetTraits]:
        """The best set of each set of names, best first."""
        best: dict[frozenset[str], SetTraits] = {}
        for s in self.sets:
            if s.names not in best or self.score(s, c) > self.score(best[s.names], c):
                best[s.names] = s
        return sorted(best.values(), key=lambda s: (-self.score(s, c), sorted(s.names)))

    def accepted(self, c: Constants) -> list[SetTraits]:
        """Sets whose every name passes its test, best first, down to the empty one; as ``decide.accepted``."""
        out: list[SetTraits] = []
        for s in self.ranked(c):
            if not s.names:
                return [*out, s]
            if s.z is not None and s.z > c.least_z:
                out.append(s)
        return out

    def says(self, c: Constants) -> tuple[str, SetTraits]:
        """(unexplained, named or nothing; the chosen set)."""
        chosen = self.accepted(c)[0]
        empty = next(s for s in self.ranked(c) if not s.names)
        if self.curve is not None:
            share, short = self.curve
            gain = Count.of(c, self.held).curve_gain(short, share) / self.outputs
            if self.score(empty, c) + gain - c.per_name - c.per_parameter * CURVE > self.score(chosen, c):
                return "unexplained", empty
        rest = chosen.rest if chosen.rest is not None else 0.0
        if not is_whole(rest, chosen.explained or 0.0, c):
            return "unexplained", chosen
        return ("named" if chosen.with_events(c) else "nothing"), chosen

    def right(self, c: Constants) -> bool:
        """Return True if verdict (up to recalibration) and set are exact."""
        verdict, chosen = self.says(c)
        if self.kind == "unknown":
            return verdict == "unexplained"
        if self.kind == "beside":
            # what is left of the other effect may be more than a form error or not
            return verdict != "nothing" and chosen.with_events(c) == self.names
        return verdict == ("named" if self.names else "nothing") and chosen.with_events(c) == self.names

    def log_probability(self, c: Constants) -> float:
        """Log probability of the true set among those of the search, clipped."""
        ranked = self.ranked(c)
        values = np.array([self.score(s, c) for s in ranked])
        own_scores = [
            v for s, v in zip(ranked, values, strict=True) if s.names | (self.names & s.events.keys()) == self.names
        ]
        if not own_scores:
            return CLIP
        top = float(values.max())
        return max(float(own_scores[0] - top - np.log(np.sum(np.exp(values - top)))), CLIP)


def learn(cases: Sequence[Case]) -> Constants:
    """Constants from cases: weights by the clipped log loss of the true set, then the test, then the cuts."""
    known = [c for c in cases if c.kind != "unknown"]

    def loss(x: np.ndarray) -> float:
        c = _weights(x)
        # weakly towards the start, by what one case in ten may say
        pull = 0.05 * float(np.sum((x - _start()) ** 2))
        return -float(np.mean([k.log_probability(c) for k in known])) + pull

    found = minimize(loss, _start(), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 1e-4, "maxiter": 600})
    c = _weights(found.x)
    c = best_of(c, ({"least_z": z} for z in np.arange(2.0, 6.1, 0.25)), cases)
    cuts = ({"cut": a, "cut_share": b} for a in np.geomspace(0.1, 3.0, 10) for b in np.geomspace(0.01, 0.3, 9))
    return best_of(c, cuts, cases)


def _start() -> np.ndarray:
    return np.log([START.samples, START.form_samples, START.per_name, START.per_parameter])


def _weights(x: np.ndarray) -> Constants:
    n, form, name, parameter = (float(v) for v in np.exp(np.clip(x, -7.0, 9.0)))
    return replace(START, samples=n, form_samples=min(form, n), per_name=name, per_parameter=parameter)


def best_of(c: Constants, options: Iterator[Mapping[str, float]], cases: Sequence[Case]) -> Constants:
    """Take the option that gets most cases exactly right; of those within a standard error of it the nearest to
    ``START`` (by logarithms): what the cases do not say stays as it was (Breiman et al., Classification and Regression
    Trees, 1984, section 3.4.3). The error of a difference is the root of the number of cases that differ."""
    tried = [replace(c, **{k: float(v) for k, v in o.items()}) for o in options]
    right = np.array([[case.right(t) for case in cases] for t in tried])
    best = right[int(np.argmax(right.sum(axis=1)))]
    lost = best.sum() - right.sum(axis=1)
    top = [t for t, less, of in zip(tried, lost, right, strict=True) if less <= np.sqrt(np.sum(of != best))]
    at = np.log([[t.least_z, t.cut, t.cut_share] for t in top])
    prior = np.log([START.least_z, START.cut, START.cut_share])
    return top[int(np.argmin(np.sum((at - prior) ** 2, axis=1)))]


class StatedName(NamedTuple):
    """A name of a report: its raw probability, if it is right, and if the rest is noise (``Judged.known``)."""

    sure: float
    right: bool
    known: bool


def learn_sure(c: Constants, stated_names: Sequence[StatedName]) -> Constants:
    """The map from log odds to stated ones by logistic regression (Platt 1999) on names of cases that the constants
    were not learned on, held weakly at the identity; and the most that is stated, by the rule of succession (Laplace
    1774) over the sure ones beside noise alone: so many cases cannot vouch for more."""
    if not stated_names:
        return c
    x = np.array([log_odds(n.sure) for n in stated_names])
    right = np.array([float(n.right) for n in stated_names])
    is_open = np.array([float(not n.known) for n in stated_names])

    def loss(v: np.ndarray) -> float:
        z = v[0] + np.exp(v[1]) * x - v[2] * is_open
        return float(np.sum(np.logaddexp(0.0, z) - right * z) + 0.5 * float(v[0] ** 2 + v[1] ** 2 + (v[2] / WIDE) ** 2))

    offset, slope, less = minimize(loss, np.zeros(3), method="Nelder-Mead", options={"maxiter": 2000}).x
    top = right[(x > log_odds(TOP)) & (is_open == 0.0)]
    most = (float(top.sum()) + 1.0) / (top.size + 2.0)
    return replace(
        c, sure_offset=float(offset), sure_slope=float(np.exp(slope)), sure_open=max(float(less), 0.0),
        most_sure=max(most, TOP),
    )  # fmt: skip


def raw_surenesses(c: Constants, cases: Sequence[Case]) -> Iterator[StatedName]:
    """Every name that would be reported, with its probability before the map.

    Where the rest is not noise the map decides which are, and the map is not learned yet: all of them count.
    """
    c = replace(c, sure_offset=0.0, sure_slope=1.0, sure_open=0.0, most_sure=1.0)
    for case in cases:
        verdict, chosen = case.says(c)
        known = verdict != "unexplained" and (chosen.rest or 0.0) <= c.cut
        sets = [(s.names, case.score(s, c)) for s in case.accepted(c)]
        sure = surenesses(chosen.names, sets, known, c)
        sure |= {n: stated(1.0 - chosen.events[n], known, c) for n in chosen.with_events(c) - chosen.names}
        scores = {s.names: case.score(s, c) for s in reversed(case.ranked(c))}
        withheld = frozenset[str]()
        if known:
            withheld = dispensable(chosen.names, sets, known, c, lambda kept, of=scores: of.get(kept, -np.inf))
        for name, p in sure.items():
            if name in withheld:
                continue
            yield StatedName(p, name in case.names, known)


@dataclass(frozen=True)
class CrossValidated:
    """Holds the results of the constants on held-out cases, every fold by constants learned on the others.

    ``stated`` are the names per case, before the map.
    """

    cases: int
    exactly_right: int
    mean_log_probability: float
    stated: Sequence[Sequence[StatedName]]


def cross_validated(cases: Sequence[Case], learner: Callable[[Sequence[Case]], Constants] = learn) -> CrossValidated:
    """The learner on cases that it has not seen."""
    right, values = 0, list[float]()
    stated_names: list[Sequence[StatedName]] = [()] * len(cases)
    for fold in range(FOLDS):
        constants = learner([c for i, c in enumerate(cases) if i % FOLDS != fold])
        for i, c in enumerate(cases):
            if i % FOLDS == fold:
                right += c.right(constants)
                values += [c.log_probability(constants)] if c.kind != "unknown" else []
                stated_names[i] = list(raw_surenesses(constants, [c]))
    return CrossValidated(len(cases), right, float(np.mean(values)) if values else 0.0, stated_names)
