"""Sets of effects that were fitted and scored, each once, by what they consist of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import compare
from tools.mismatch.engine.screen import Candidate, bend, one_step, places
from tools.mismatch.engine.trial import LEAST_P
from tools.mismatch.engine.vary import added, beyond_limits, size
from tools.mismatch.infer.constants import Constants
from tools.mismatch.infer.density import (
    LEAST,
    best_log_density,
    exact_log_density,
    follower,
    gain_of_events,
    unpredicted,
    weigh,
)
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

Array = NDArray[np.float64]
Part = tuple[str, ...]
Key = frozenset[Part]


def part_of(placed: Placed) -> Part:
    """What tells an effect at its place from others; what it read off the data does not."""
    return (*placed.effect.form, placed.site, placed.target)


def key_of(placed: Sequence[Placed]) -> Key:
    """The set that these effects make, in whatever order."""
    return frozenset(part_of(p) for p in placed)


@dataclass(frozen=True)
class Scored:
    """One set with its joint fit. ``density``: mean log density of held-out samples per output; ``blocks``
    (blocks, outputs) the same per held-out block; ``parameters``: how many numbers the effects bring; ``proper``: the
    fit stayed within reach and every effect within what its physics can be; ``outputs``: how many outputs are
    averaged over (``Store.outputs``).
    """

    key: Key
    fitted: Fit = field(repr=False)
    density: dict[str, float]
    blocks: Array = field(repr=False)
    parameters: float
    proper: bool
    outputs: float = 1.0

    @property
    def names(self) -> frozenset[str]:
        return frozenset(p.effect.name for p in self.fitted.model.placed)

    @property
    def mean_density(self) -> float:
        """Nats per held-out sample, averaged over the outputs that have something to explain."""
        return sum(self.density.values()) / self.outputs

    @property
    def placed(self) -> tuple[Placed, ...]:
        return self.fitted.model.placed

    def score(self, c: Constants, counted: float) -> float:
        """Nats: the tempered log density (Miller and Dunson 2019: a likelihood raised to a power below one, because the
        form of a model is never quite right) less the prices of names and parameters. ``counted``: samples that a
        residual counts for.

        The mean over the outputs that have something to explain counts: what the form of an effect leaves on one of
        them it leaves on all.
        """
        return counted * self.mean_density - c.per_name * len(self.names) - c.per_parameter * self.parameters


class Store:
    """Every set that a search has fitted. ``seen``: how the screen saw an effect at its place, by its part;
    ``eventful``: sets with the events that were found beside them, by the set's key."""

    def __init__(self, problem: Problem, base: Fit, constants: Constants, events: Sequence[Effect] = ()) -> None:
        self.problem = problem
        self.events = tuple(events)
        self.constants = constants
        held = int(problem.held_rows.size)
        self.counted = min(constants.samples * recordings_held(problem), float(held))
        """Samples that a held-out residual counts for: form errors are systematic within one recording."""
        self.sets: dict[Key, Scored] = {}
        self.seen: dict[Part, Candidate] = {}
        self.eventful: dict[Key, tuple[Scored, dict[str, float]]] = {}
        self._tests: dict[tuple[Key, str], float] = {}
        self._best = best_log_density(problem)
        self._exact = exact_log_density(problem)
        self.outputs = float(len(problem.twin.outputs))
        self.outputs = outputs_at_odds([*self.room(self.scored(base)).values()])
        self.base = self.put(base)

    def put(self, fitted: Fit) -> Scored:
        """The fit scored. Of two fits of one set the better one is kept."""
        scored = self.scored(fitted)
        old = self.sets.get(scored.key)
        if old is None or (scored.proper, self.score(scored)) > (old.proper, self.score(old)):
            self.sets[scored.key] = scored
        return self.sets[scored.key]

    def scored(self, fitted: Fit) -> Scored:
        """The fit scored."""
        p = self.problem
        every = weigh(p, fitted)
        mean = {o: float(np.mean(w.density[p.held_rows])) for o, w in every.items()}
        blocks = np.array([[float(np.mean(every[o].density[a:b])) for o in p.twin.outputs] for a, b in p.held_blocks])
        proper = fitted.ok and not any(improper(fitted, e) for e in fitted.model.placed)
        proper = proper and all(self.lawful(w.predictable) for w in every.values())
        proper = proper and not any(follower(p, fitted, o, figures_of) for o in p.twin.outputs)
        # values that a law is free to follow have the price of parameters, among the samples that count
        free = self.counted / self.outputs * sum(w.free for w in every.values())
        figures = free + sum(figures_of(e) for e in fitted.model.placed)
        return Scored(key_of(fitted.model.placed), fitted, mean, blocks, figures, proper, self.outputs)

    def lawful(self, predictable: float) -> bool:
        """Whether so many nats per sample may be left in what a law of noise could not predict: no more than another
        name would cost."""
        return self.counted * predictable < self.constants.per_name

    def score(self, s: Scored) -> float:
        return s.score(self.constants, self.counted) if s.proper else -np.inf

    def ranked(self, sets: Sequence[Scored] | None = None) -> list[Scored]:
        """Proper sets, the best of each set of names, best first."""
        best: dict[frozenset[str], Scored] = {}
        for s in self.sets.values() if sets is None else sets:
            if s.proper and (s.names not in best or self.score(s) > self.score(best[s.names])):
                best[s.names] = s
        return sorted(best.values(), key=lambda s: (-self.score(s), sorted(s.names)))

    def room(self, s: Scored) -> dict[str, float]:
        """Nats per output by which a larger set can be better at most: up to noise at its floor, and where a set has
        found readings on a lattice, up to all of them exactly there."""
        n = self.counted / self.outputs
        best = {
            o: b if d < b else max(b, self._exact[o])
            for (o, d), b in zip(s.density.items(), self._best.values(), strict=True)
        }
        return {o: max(n * (best[o] - d), 0.0) for o, d in s.density.items()}

    def without(self, s: Scored, drop: Callable[[Placed], bool]) -> Scored:
        """The set less the effects that ``drop`` says, fitted again unless the store has it."""
        kept = [p for p in s.placed if not drop(p)]
        known = self.sets.get(key_of(kept))
        if known is not None:
            return known
        model = Model(self.problem.twin, kept)
        theta = model.carry(s.fitted.model, s.fitted.theta, self.problem.recording)
        return self.put(fit(self.problem, model, [theta], stride=2, iterations=12))

    def with_one(self, s: Scored, place: Placed) -> Scored:
        """The set with one more effect, prepared from what the set leaves."""
        known = self.sets.get(s.key | {part_of(place)})
        if known is not None:
            return known
        with np.errstate(all="ignore"):
            return self.put(added(self.problem, s.fitted, place))

    def joined(self, s: Scored, one: Scored) -> Scored:
        """The set with the single effect of another beside it, begun where that one ended."""
        (place,) = one.placed
        known = self.sets.get(s.key | one.key)
        if known is not None:
            return known
        model = Model(self.problem.twin, (*s.placed, place))
        theta = model.carry(s.fitted.model, s.fitted.theta, self.problem.recording)
        own = zip(model.slices(len(s.placed)), one.fitted.model.slices(0), strict=True)
        for here, there in own:
            theta[here] = one.fitted.theta[there]
        with np.errstate(all="ignore"):
            return self.put(fit(self.problem, model, [theta], stride=2, iterations=12))

    def refined(self, s: Scored) -> Scored:
        """The set fitted on every row until nothing moves."""
        with np.errstate(all="ignore"):
            return self.put(fit(self.problem, s.fitted.model, [s.fitted.theta], iterations=15))

    def with_events(self, s: Scored) -> Scored:
        """The set with those events (bursts) beside it that their own tests find in what it leaves, clearly on one
        output of all that were tested and at all on the others; ``eventful`` keeps it with the p-value per name.

        Few samples are no reason to doubt the form of a course, and a tempered score would temper them: events have
        no price, and a part in the density of whatever set they stand beside.
        """
        if s.key not in self.eventful:
            with np.errstate(all="ignore"):
                self.eventful[s.key] = self._with_events(s)
        return self.eventful[s.key][0]

    def _with_events(self, s: Scored) -> tuple[Scored, dict[str, float]]:
        p = self.problem
        tried = places(p, self.events, s.placed)
        if not tried:
            return s, {}
        ground = bend(p, s.fitted)
        found = [one_step(p, s.fitted, place, ground) for place in tried]
        best: dict[str, float] = {}
        for c in found:
            self.seen[part_of(c.placed)] = c
            best[c.placed.effect.name] = min(best.get(c.placed.effect.name, 1.0), c.p_value * len(found))
        clear = {n: v for n, v in best.items() if z_of_p(v) > self.constants.least_z and self.pays(s, n, found)}
        more = [c.placed for c in found if c.placed.effect.name in clear and c.p_value < LEAST_P]
        if not more:
            return s, {}
        model = Model(p.twin, (*s.placed, *more))
        theta = model.carry(s.fitted.model, s.fitted.theta, p.recording)
        return self.scored(fit(p, model, [theta], iterations=15)), clear

    def pays(self, s: Scored, name: str, found: Sequence[Candidate]) -> bool:
        """Whether what events ``name`` explain beyond heavy tails of the noise is worth a name: over all samples, since
        no course is extrapolated."""
        p = self.problem
        rows = np.union1d(p.fit_rows, p.held_rows)
        gain = 0.0
        for c in found:
            if c.placed.effect.name == name and c.p_value < LEAST_P and c.placed.effect.claims is not None:
                o = c.placed.outputs[0]
                r = unpredicted(p, s.fitted).residual[o][rows]
                taken = c.placed.effect.claims(c.placed.settings, p.recording.n)[p.index][rows]
                span, r = float(np.ptp(p.measured[o])), r - np.median(r)
                # a reading beside an edge of its lattice falls on either side
                taken &= np.abs(r) > EDGE * p.floors[o].step
                gain += gain_of_events(r, taken, span, LEAST * p.floors[o].rms)
        return gain > self.constants.per_name

    def z_of(self, s: Scored, name: str) -> float:
        """Whitened held-out correlation of what ``name`` does with what the set without it leaves.

        An effect of events or of noise has no course that could be predicted: its own test stands in for it.
        """
        if (s.key, name) not in self._tests:
            mine = [p for p in s.placed if p.effect.name == name]
            if all(e.effect.stochastic for e in mine):
                rest = self.without(s, lambda e: e.effect.name == name).fitted
                with np.errstate(all="ignore"):
                    ground = bend(self.problem, rest)
                    found = [one_step(self.problem, rest, e, ground) for e in mine]
                z = max((z_of_p(c.p_value * len(self.seen)) for c in found if c.tested), default=0.0)
            else:
                small = self.without(s, lambda p: p.effect.name == name)
                z = compare(self.problem, small.fitted, s.fitted).z
            self._tests[s.key, name] = z
        return self._tests[s.key, name]

    def least_z(self, s: Scored) -> float:
        """The weakest of the names of a set; infinite for the empty set."""
        return min((self.z_of(s, n) for n in s.names), default=np.inf)


def recordings_held(problem: Problem) -> int:
    """How many recordings have samples that are held out; 1 where there is one recording."""
    held = problem.split.held_out
    return max(sum(any(a < p.stop and p.start < b for a, b in held) for p in problem.recording.parts), 1)


def outputs_at_odds(room: Sequence[float]) -> float:
    """How many outputs have something to explain, from what each leaves above its noise: all of them where each leaves
    as much, one where one leaves it all (the inverse participation ratio).
    """
    left = np.asarray(room)
    squares = float(left @ left)
    return float(np.sum(left)) ** 2 / squares if squares > 0.0 else float(left.size)


EDGE = 1.001
"""Steps of the lattice of readings up to which a residual is no event; above one by its rounding."""
EVENTS = 2
"""Numbers that a law of noise has: how much of it there is, and of what size. What it did at which sample is not a
number of the law: the density has paid for that, sample by sample."""


def figures_of(placed: Placed) -> int:
    """How many numbers an effect brings."""
    noise = placed.effect.predict is not None or placed.effect.claims is not None
    return EVENTS if noise else size(placed)


def improper(fitted: Fit, placed: Placed) -> bool:
    """Whether a figure of a fitted effect is beyond its physics, or one without which it says nothing at its bound."""
    stuck = any(f"{placed.label}.{n}" in fitted.at_bound for n in placed.effect.essential)
    return stuck or beyond_limits(fitted, placed)


def z_of_p(p: float) -> float:
    """Normal quantile of a p-value that was corrected for how many candidates were screened (Bonferroni)."""
    return float(norm.isf(min(max(p, 1e-300), 1.0 - 1e-9)))
