"""Stores sets of effects that were fitted and scored, each once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from hal.arrays import Array
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.found import human_values
from tools.mismatch.engine.intervals import uncertainty
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import compare
from tools.mismatch.engine.screen import LEAST_P, Candidate, bend, one_step, places
from tools.mismatch.engine.unexplained import led_by
from tools.mismatch.engine.vary import added, beyond_limits, size, stripped, with_balance
from tools.mismatch.infer.constants import Constants
from tools.mismatch.infer.count import Count
from tools.mismatch.infer.density import (
    LEAST,
    best_log_density,
    exact_log_density,
    follower,
    gain_of_events,
    priced_likelihood,
    undone,
    unpredicted,
    walks,
    weigh,
)
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

Part = tuple[str, ...]
Key = frozenset[Part]


def part_of(placed: Placed) -> Part:
    """Return the key of an effect at its place; settings that were read off the data are not part of it."""
    return (*placed.effect.form, placed.site, placed.target)


def key_of(placed: Sequence[Placed]) -> Key:
    """Return the key of the set of these effects, independent of their order."""
    return frozenset(part_of(p) for p in placed)


@dataclass(frozen=True)
class Scored:
    """Holds a set with its joint fit.

    ``density`` is the mean log density of held-out samples per output, ``blocks`` (blocks, outputs) the same per
    held-out block; ``parameters`` is the number of parameters of the effects. ``choices`` are the nats that
    tell their places among all that they could have. ``proper`` is True if the fit did not diverge and every effect is
    within its physical range.
    """

    key: Key
    fitted: Fit = field(repr=False)
    density: dict[str, float]
    blocks: Array = field(repr=False)
    parameters: float
    choices: float
    proper: bool

    @property
    def names(self) -> frozenset[str]:
        return frozenset(p.effect.name for p in self.fitted.model.placed)

    @property
    def placed(self) -> tuple[Placed, ...]:
        return self.fitted.model.placed

    @property
    def laws(self) -> int:
        """Return the number of laws that the names stand for."""
        return sum(max(p.effect.laws for p in self.placed if p.effect.name == name) for name in self.names)


class Store:
    """Holds every set that a search has fitted.

    ``seen`` maps parts to the screened candidates; ``eventful`` maps a set's key to the set with the events that were
    found beside it.
    """

    def __init__(self, problem: Problem, base: Fit, constants: Constants, effects: Sequence[Effect] = ()) -> None:
        self.problem = problem
        self.effects = tuple(effects)
        self.events = tuple(e for e in effects if e.claims is not None)
        self._choices: dict[str, float] = {}
        self.constants = constants
        self.count = Count.of(constants, int(problem.held_rows.size), recordings_held(problem))
        self.sets: dict[Key, Scored] = {}
        self.seen: dict[Part, Candidate] = {}
        self.eventful: dict[Key, tuple[Scored, dict[str, float]]] = {}
        self._tests: dict[tuple[Key, str], float] = {}
        self._ahead: dict[tuple[Key, str], float] = {}
        self._dependent: dict[Key, tuple[Placed, Dependence] | None] = {}
        self._best = best_log_density(problem)
        self._exact = exact_log_density(problem)
        self.outputs = float(len(problem.twin.outputs))
        self.outputs = outputs_at_odds([max(v, 0.0) for v in self.short(self.scored(base)).values()])
        self.base = self.put(base)

    def listen(self, s: Scored) -> None:
        """Lower the noise floors to what the set shows them to be: what is missing may be rough enough to look like
        noise, and a search against such a floor would end too early."""
        quieter = self.problem.quieter(unpredicted(self.problem, s.fitted).residual)
        if quieter is self.problem:
            return
        self.problem = quieter
        self._best, self._exact = best_log_density(quieter), exact_log_density(quieter)
        self._tests.clear()
        self._ahead.clear()
        for key, old in self.sets.items():
            # the weight of a law of noise depends on the floor
            if any(p.effect.predict is not None for p in old.placed):
                self.sets[key] = self.scored(old.fitted)

    def put(self, fitted: Fit) -> Scored:
        """Score a fit. Of two fits of a set the better one is kept."""
        scored = self.scored(fitted)
        old = self.sets.get(scored.key)
        if old is None or (scored.proper, self.score(scored)) > (old.proper, self.score(old)):
            self.sets[scored.key] = scored
            for known in (self._tests, self._ahead):
                for of in [of for of in known if of[0] == scored.key]:
                    del known[of]
            self._dependent.pop(scored.key, None)
        return self.sets[scored.key]

    def scored(self, fitted: Fit) -> Scored:
        """Score a fit without storing it."""
        p = self.problem
        every = weigh(p, fitted)
        mean = {o: float(np.mean(w.density[p.held_rows])) for o, w in every.items()}
        blocks = np.array([[float(np.mean(every[o].density[a:b])) for o in p.twin.outputs] for a, b in p.held_blocks])
        proper = fitted.ok and not any(improper(p, fitted, e) for e in fitted.model.placed)
        proper = proper and all(self.lawful(w.predictable) for w in every.values())
        proper = proper and not any(follower(p, fitted, o, figures_of) for o in p.twin.outputs)
        # values that a law is free to follow have the price of parameters, among the samples that count
        free = self.count.noise / self.outputs * sum(w.free for w in every.values())
        # the loss is a mean over outputs, and so is what parameters of some of them fit by chance
        shares = [min(len(e.outputs) / self.outputs, 1.0) for e in fitted.model.placed]
        figures = free + sum(a * figures_of(e, fitted) for a, e in zip(shares, fitted.model.placed, strict=True))
        choices = sum(self.choices_of(name) for name in {e.effect.name for e in fitted.model.placed})
        return Scored(key_of(fitted.model.placed), fitted, mean, blocks, figures, choices, proper)

    def choices_of(self, name: str) -> float:
        """Return the nats that tell the place of an effect among all that this problem has for it.

        Of two descriptions that predict as well, the one that had fewer chances to do so is the more likely. Forms at
        one place are no chances: they predict alike.
        """
        if name not in self._choices:
            own = [e for e in self.effects if e.name == name]
            self._choices[name] = float(np.log(max(len({p.label for p in places(self.problem, own, ())}), 1)))
        return self._choices[name]

    def lawful(self, predictable: float) -> bool:
        """Return True if the prediction errors of a noise effect are white enough.

        Their predictable part, in nats per sample, must cost no more than another name.
        """
        return self.count.noise * predictable < self.constants.per_name

    def score(self, s: Scored) -> float:
        """Return the score in nats: the tempered log density less the prices of names, their places and parameters.

        The likelihood is raised to a power below one, because the form of a model is never exact (Miller and Dunson
        2019), and to a smaller one where form errors are most of the residual (``Count``). The loss is the mean over
        the outputs that have something to explain, because an error of form on one of them is repeated on all.
        """
        c = self.constants
        prices = c.per_name * s.laws + s.choices + c.per_parameter * s.parameters
        return -self.lost(s) - prices if s.proper else -np.inf

    def lost(self, s: Scored) -> float:
        """Return the nats by which a set predicts worse than noise at its floor would be predicted."""
        return sum(self.count.lost(v) for v in self.short(s).values()) / self.outputs

    def short(self, s: Scored) -> dict[str, float]:
        """Return the nats per held-out sample and output by which the density of a set is below that of noise."""
        return {o: self._best[o] - d for o, d in s.density.items()}

    def ranked(self, sets: Sequence[Scored] | None = None) -> list[Scored]:
        """Return the proper sets, the best of each set of names, best first, without walks that are outdone.

        Of the first ones those are left out in which an independent effect follows a signal.
        """
        left = self.every_ranked(sets)
        first: list[Scored] = []
        for k, s in enumerate(left):
            if len(first) == CHECKED:
                return [*first, *left[k:]]
            if self.dependent(s) is None:
                first.append(s)
        return first

    def dependent(self, s: Scored) -> tuple[Placed, Dependence] | None:
        """Return an effect of ``s`` that depends on no signal by its definition, and how it follows one.

        A course by a cause of its own follows no signal. What does stands for physics that is missing.
        """
        if s.key not in self._dependent:
            with np.errstate(all="ignore"):
                self._dependent[s.key] = next(self._follow(s), None)
        return self._dependent[s.key]

    def _follow(self, s: Scored) -> Iterator[tuple[Placed, Dependence]]:
        for k, placed in enumerate(s.placed):
            # what passes the dynamics of a plant follows its motion
            if placed.site != "output" or not placed.effect.is_independent or placed.effect.claims is not None:
                continue
            for o in placed.outputs:
                course = undone(self.problem, s.fitted, o, [k])
                if np.all(np.isfinite(course)) and (found := led_by(self.problem, s.fitted, o, course)) is not None:
                    yield placed, found

    def every_ranked(self, sets: Sequence[Scored] | None = None) -> list[Scored]:
        """Return the proper sets as ``ranked`` does, with those in which an independent effect follows a signal."""
        best: dict[frozenset[str], Scored] = {}
        for s in self.sets.values() if sets is None else sets:
            if s.proper and (s.names not in best or self.score(s) > self.score(best[s.names])):
                best[s.names] = s
        left = [s for s in best.values() if not self.outdone(s, best.values())]
        return sorted(left, key=lambda s: (-self.score(s), sorted(s.names)))

    def ahead(self, s: Scored, output: str) -> float:
        """Return the log likelihood of ``output`` one step ahead, less prices (``density.priced_likelihood``)."""
        if (s.key, output) not in self._ahead:
            self._ahead[s.key, output] = priced_likelihood(self.problem, s.fitted, output, figures_of)
        return self._ahead[s.key, output]

    def outdone(self, s: Scored, others: Iterable[Scored]) -> bool:
        """Return True if one of ``others`` that follows signals alone, with no more names, predicts the outputs with
        walks of ``s`` better one step ahead.

        A walk predicts each sample from those before it and a free run does not, so that any slow error of form would
        look better as a walk. Here the rest of either is coloured noise, as that of the smaller sets is which the walk
        stands beside. A course in time is no rival, because it may be fitted to a course of the walk.
        """
        outputs = [o for o in self.problem.twin.outputs if walks(s.fitted, o)]
        if not outputs:
            return False

        def worth(x: Scored) -> float:
            return sum(self.ahead(x, o) for o in outputs) - self.constants.per_name * len(x.names)

        free = [d for d in others if not any(p.effect.is_independent for p in d.placed)]
        own = max(worth(x) for x in (s, self.base, *(d for d in free if d.names < s.names)))
        return any(worth(d) > own for d in free if len(d.names) <= len(s.names))

    def room(self, s: Scored) -> dict[str, float]:
        """Return the most nats per output by which a larger set can be better.

        The bound is noise at its floor or, if a set has found readings on a lattice, the prediction of all of them.
        """
        out: dict[str, float] = {}
        for o, short in self.short(s).items():
            # a set that is better than noise has found the lattice
            least = 0.0 if short > 0.0 else min(0.0, self._best[o] - self._exact[o])
            out[o] = max(self.count.lost(short) - self.count.lost(least), 0.0) / self.outputs
        return out

    def without(self, s: Scored, drop: Callable[[Placed], bool]) -> Scored:
        """Return the set without the effects that ``drop`` selects, fitted again unless the store has it."""
        kept = [p for p in s.placed if not drop(p)]
        known = self.sets.get(key_of(kept))
        if known is not None:
            return known
        model = Model(self.problem.twin, kept)
        theta = model.carry(s.fitted.model, s.fitted.theta, self.problem.recording)
        with np.errstate(all="ignore"):
            begin = with_balance(self.problem, model, [theta])
            return self.put(fit(self.problem, model, begin, stride=2, iterations=12))

    def with_one(self, s: Scored, place: Placed) -> Scored:
        """Return the set with one more effect, prepared from the residual of the set."""
        known = self.sets.get(s.key | {part_of(place)})
        if known is not None:
            return known
        with np.errstate(all="ignore"):
            return self.put(added(self.problem, s.fitted, place))

    def instead(self, s: Scored, name: str, place: Placed) -> Scored:
        """Return the set with another effect in place of ``name``.

        The others start as they are beside ``name``; fitted without it, they have bent.
        """
        with np.errstate(all="ignore"):
            rest = stripped(self.problem, s.fitted, lambda p: p.effect.name == name)
            return self.put(added(self.problem, rest, place))

    def joined(self, s: Scored, one: Scored) -> Scored:
        """Return the set joined with the single effect of another set, started from that fit."""
        (place,) = one.placed
        known = self.sets.get(s.key | one.key)
        if known is not None:
            return known
        model = Model(self.problem.twin, (*s.placed, place))
        theta = model.carry(s.fitted.model, s.fitted.theta, self.problem.recording)
        own = zip(model.slices(len(s.placed)), one.fitted.model.slices(0), strict=True)
        for target, source in own:
            theta[target] = one.fitted.theta[source]
        with np.errstate(all="ignore"):
            begin = with_balance(self.problem, model, [theta])
            return self.put(fit(self.problem, model, begin, stride=2, iterations=12))

    def with_law(self, s: Scored, k: int, law: Effect) -> Scored:
        """Return the set with another law in place of that of effect ``k``, started from the same parameters."""
        placed = [replace(p, effect=law) if i == k else p for i, p in enumerate(s.placed)]
        with np.errstate(all="ignore"):
            return self.put(fit(self.problem, Model(self.problem.twin, placed), [s.fitted.theta], iterations=15))

    def refined(self, s: Scored) -> Scored:
        """Return the set fitted on every row until convergence."""
        with np.errstate(all="ignore"):
            return self.put(fit(self.problem, s.fitted.model, [s.fitted.theta], iterations=15))

    def with_events(self, s: Scored) -> Scored:
        """Return the set with the events (bursts) that their own tests find in its residual.

        The test must be clear on one of the tested outputs and positive on the others; ``eventful`` keeps the result
        with the p-value per name. Tempering suits errors of form and not the few samples of events, so events have no
        price and are part of the density of any set beside which they stand.
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
        """Return True if the events ``name`` explain enough beyond heavy tails of the noise to pay for a name.

        All samples count, since no course is extrapolated.
        """
        p = self.problem
        rows = np.union1d(p.fit_rows, p.held_rows)
        gain = 0.0
        for c in found:
            if c.placed.effect.name == name and c.p_value < LEAST_P and c.placed.effect.claims is not None:
                o = c.placed.outputs[0]
                r = unpredicted(p, s.fitted).residual[o][rows]
                claimed = c.placed.effect.claims(c.placed.settings, p.recording.n)[p.index][rows]
                span, r = float(np.ptp(p.measured[o])), r - np.median(r)
                # a reading beside an edge of its lattice falls on either side
                claimed &= np.abs(r) > EDGE * p.floors[o].step
                gain += gain_of_events(r, claimed, span, LEAST * p.floors[o].rms)
        return gain > self.constants.per_name

    def z_of(self, s: Scored, name: str) -> float:
        """Return the whitened held-out correlation of the contribution of ``name`` with the residual without it.

        An effect of events or of noise has no predictable course: its own test replaces the correlation. The samples
        of events beside the set do not count, because the whitening would take bursts for the colour of the noise.
        """
        if (s.key, name) not in self._tests:
            placed = [p for p in s.placed if p.effect.name == name]
            if all(e.effect.stochastic for e in placed):
                rest = self.without(s, lambda e: e.effect.name == name).fitted
                with np.errstate(all="ignore"):
                    ground = bend(self.problem, rest)
                    found = [one_step(self.problem, rest, e, ground) for e in placed]
                z = max((z_of_p(c.p_value * len(self.seen)) for c in found if c.tested), default=0.0)
            else:
                small = self.without(s, lambda p: p.effect.name == name)
                usual = {o: ~self.with_events(s).fitted.model.excused(self.problem.view, o) for o in s.density}
                before, after = (_only(f.fitted, usual) for f in (small, s))
                z = compare(self.problem, before, after).z
            self._tests[s.key, name] = z
        return self._tests[s.key, name]

    def least_z(self, s: Scored) -> float:
        """Return the weakest test of the names of a set; infinite for the empty set."""
        return min((self.z_of(s, n) for n in s.names), default=np.inf)


def _only(fitted: Fit, usual: Mapping[str, NDArray[np.bool_]]) -> Fit:
    """Return ``fitted`` with a residual of zero outside the samples ``usual`` (m,) of each output."""
    return replace(fitted, residual={o: np.where(usual[o], r, 0.0) for o, r in fitted.residual.items()})


def recordings_held(problem: Problem) -> int:
    """Return the number of recordings with held-out samples; 1 for a single recording."""
    held = problem.split.held_out
    return max(sum(any(a < p.stop and p.start < b for a, b in held) for p in problem.recording.parts), 1)


def outputs_at_odds(room: Sequence[float]) -> float:
    """Return the effective number of outputs with something to explain, from the room of each above its noise.

    It is the inverse participation ratio: all of them if the rooms are equal, one if a single output has it all.
    """
    left = np.asarray(room)
    squares = float(left @ left)
    return float(np.sum(left)) ** 2 / squares if squares > 0.0 else float(left.size)


CHECKED = 6
"""Number of sets, best first, of which none has an independent effect that follows a signal."""
EDGE = 1.001
"""Residual, in steps of the lattice of readings, up to which a sample is no event; above one because of rounding."""
EVENTS = 2
"""Number of parameters of an effect that is noise or events: its rate and its size. Its course is not a parameter,
because the density pays for it sample by sample."""


def figures_of(placed: Placed, fitted: Fit) -> float:
    """Return the number of parameters that an effect brings: of many weights those that the data determine."""
    if placed.effect.predict is not None or placed.effect.claims is not None:
        return EVENTS
    shrunk = fitted.shrunk.get(placed.label)
    return size(placed) - (0.0 if shrunk is None else shrunk.precision.size - shrunk.freedom)


def improper(problem: Problem, fitted: Fit, placed: Placed) -> bool:
    """Return True if a figure of a fitted effect is outside its physical range, or an essential one is at its bound.

    A figure that scatters with the noise (``Effect.estimated``) is outside only where its 95 % interval is.
    """
    if any(f"{placed.label}.{n}" in fitted.at_bound for n in placed.effect.essential):
        return True
    outside = beyond_limits(fitted, placed)
    if not outside or not set(outside) <= set(placed.effect.estimated):
        return bool(outside)
    values, limits = human_values(problem, fitted, uncertainty(problem, fitted))[placed.label], placed.effect.limits
    return any(values[n].ci95[1] < limits[n][0] or values[n].ci95[0] > limits[n][1] for n in outside)


def z_of_p(p: float) -> float:
    """Return the normal quantile of a p-value that was corrected for the number of screened candidates (Bonferroni)."""
    return float(norm.isf(min(max(p, 1e-300), 1.0 - 1e-9)))
