"""Searches sets of effects: add one, add it everywhere, drop, swap; a beam of three, screened by the score test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, ground_of
from tools.mismatch.engine.pose import hint_of, may_hint
from tools.mismatch.engine.problem import Hint, Problem
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import Effort, Trial, try_all
from tools.mismatch.infer.constants import Constants
from tools.mismatch.infer.store import Key, Scored, Store, part_of
from tools.mismatch.placed import Placed

Progress = Callable[[str, int, int], None]

BEAM = 3
"""Number of sets that are extended at a time."""
MOVES = 5
"""Largest number of extended sets besides the base; each costs a screen of the whole vocabulary."""
SWAPS = 2
"""Number of rounds in which every effect of the best set is removed and a better one is sought beside the others."""
REPLACEMENTS = 3
"""Number of sets that are extended to find an effect in place of one of the best set."""
WORTH_REPLACING = 0.5
"""Least gain that the best set leaves to one with another effect in place of one of its own, in prices of a name."""
RIVALS = 3
"""Number of names tried in place of each name of the best set, and beside it on each output that it does not change."""
FITS, FITS_LATER = (3, 6), (2, 4)
"""(Least, most) candidates of each kind per output that the screen passes to a fit, from the base and later."""
HALF = 0.5
"""Least gain over the base of a set that is extended, as a share of the best set's gain."""


@dataclass(frozen=True)
class Found:
    """Holds the result of a search: the ``store``, and the screened candidates beside the base (``first``)."""

    store: Store
    first: tuple[Trial, ...]


PATIENCE = 2
"""Number of consecutive extensions without a better set after which the search stops."""
WORTH_REFINING = 0.2
"""Least gain of a coarse fit that is refined, as a share of the gain of the best candidate's single step. It is below
``HALF``, since a coarse fit may end far from the best one."""


class Search:
    """Searches the sets of effects of a problem.

    ``stride`` thins the rows of a candidate's fit. ``ground``: the fit beside which the first effects are sought.
    """

    def __init__(
        self, problem: Problem, base: Fit, effects: Sequence[Effect], constants: Constants, *,
        jobs: int = 1, progress: Progress | None = None, moves: int = MOVES,
    ) -> None:  # fmt: skip
        self.jobs, self.progress = jobs, progress
        self.effects = tuple(e for e in effects if e.claims is None)
        self.store = Store(problem, base, constants, effects)
        self.ground = ground_of(problem, base)
        self.expanded: set[Key] = set()
        self.moves = moves
        self.replacements = REPLACEMENTS
        self.idle = 0
        self.stride = max(1, problem.fit_rows.size // 12000)
        c = constants
        # by half of the price of its name
        least = 1.0 - float(np.exp(-c.per_name / max(self.store.count.noise, 1.0)))
        self.effort = Effort(WORTH_REFINING, least)
        self.first: tuple[Trial, ...] = ()

    def run(self) -> Found:
        """Extend until nothing can gain, then swap; refine the sets between which the decision is made."""
        self.expand(self.store.base)
        self.combine()
        self.store.listen(self.store.ranked()[0])
        self.pair()
        self.grow()
        self.moves = max(self.moves, 1)  # for an account without the first name of the best one
        for _ in range(SWAPS):
            best = self.store.ranked()[0]
            if len(best.names) < 2 or not self.can_be_beaten(best):
                break
            for name in sorted(best.names):
                rest = self.best_without(best, name)
                if rest.key not in self.expanded and self.moves:
                    self.moves -= 1
                    self.expand(rest)
            if self.store.ranked()[0].key == best.key:
                break
            self.grow()
        for _ in range(SWAPS):
            best = self.pruned()
            if len(best.names) < 2:
                break
            self.swap(best)
            if self.store.ranked()[0].key == best.key:
                self.replace(best)
            if self.store.ranked()[0].key == best.key:
                break
        for s in self.store.ranked()[:BEAM]:
            self.store.with_events(self.store.refined(s) if s.placed else s)
        return Found(self.store, self.first)

    def pruned(self) -> Scored:
        """Drop names of the best set while the score grows, and return the best one.

        A larger set may lead a fit past an optimum at which the smaller one has ended.
        """
        while True:
            best = self.store.ranked()[0]
            for name in sorted(best.names):
                self.store.without(best, lambda p, n=name: p.effect.name == n)
            if self.store.ranked()[0].key == best.key:
                return best

    def replace(self, best: Scored) -> None:
        """Extend what is left of ``best`` without each name in turn, until another effect does better in its place.

        What belongs beside the other names may not even pass the screen beside the base, if they explain most.
        """
        c = self.store.constants
        spare = c.per_name * (len(best.names) - 2) + c.per_parameter * (best.parameters - len(best.names))
        if self.most_gain(best) + spare < WORTH_REPLACING * c.per_name:
            return
        rests = [self.store.without(best, lambda p, n=name: p.effect.name == n) for name in sorted(best.names)]
        for rest in sorted(rests, key=lambda s: -self.store.score(s)):
            if rest.key in self.expanded or not self.replacements:
                continue
            self.replacements -= 1
            self.expand(rest)
            grown = [s for s in self.store.ranked() if rest.names < s.names and len(s.names) == len(rest.names) + 1]
            for s in grown[: RIVALS + 1]:
                # beside a right name another may be one that stood for it
                for name in sorted(rest.names):
                    self.store.without(s, lambda p, n=name: p.effect.name == n)
            if self.store.ranked()[0].key != best.key:
                return

    def best_without(self, best: Scored, name: str) -> Scored:
        """Return the best set without ``name``: a beam of sets that share their first name grows no other account."""
        self.store.without(best, lambda p: p.effect.name == name)
        return next(s for s in self.store.ranked() if name not in s.names)

    def combine(self) -> None:
        """Join the best single effects of the outputs, the best first, while the score grows.

        If outputs share nothing, the missing effects are independent, and extending one by one may not find them all.
        """
        if not self.store.problem.twin.apart or len(self.store.problem.twin.outputs) < 2:
            return
        alone = [s for s in self.store.sets.values() if len(s.placed) == 1 and s.proper]
        alone.sort(key=lambda s: (-self.store.score(s), sorted(s.names)))
        grown, tried = self.store.base, dict.fromkeys(self.store.problem.twin.outputs, 0)
        for s in alone:
            where = s.placed[0].outputs
            if {o for p in grown.placed for o in p.outputs} & set(where) or max(tried[o] for o in where) >= RIVALS:
                continue
            tried.update({o: tried[o] + 1 for o in where})
            more = self.store.joined(grown, s)
            if more.proper and self.store.score(more) > self.store.score(grown):
                grown = more

    def pair(self) -> None:
        """Extend the effects that fit best, where no set explains half of what can be explained.

        Of two effects that only together make the recording, each alone may gain less than its price, and an effect
        at many places less than at one. A ranking by score would not extend them.
        """
        if self.explains_half():
            return
        alone = [s for s in self.store.sets.values() if len(s.placed) == 1 and s.proper]
        # a half of a pair may be worse than nothing held out, and a flexible effect fits anything: all samples count
        left = {s.key: self.left_over_all(s) for s in alone}
        alone.sort(key=lambda s: (left[s.key], sorted(s.key)))
        best = {s.names: s for s in reversed(alone)}
        for s in [s for s in alone if best[s.names] is s][:BEAM]:
            if self.moves and not self.explains_half():
                self.moves -= 1
                self.expand(s)

    def explains_half(self) -> bool:
        """Return True if a set explains half of what can be explained beside the base."""
        gains = (self.gain_before_prices(s) for s in self.store.sets.values() if s.proper)
        return max(gains, default=0.0) >= HALF * self.most_gain(self.store.base)

    def left_over_all(self, s: Scored) -> float:
        """Return the log of the residual rms over fitted and held-out samples, summed over the outputs."""
        p = self.store.problem
        rows = np.concatenate([p.fit_rows, p.held_rows])
        return sum(0.5 * float(np.log(np.mean(r[rows] ** 2))) for r in s.fitted.residual.values())

    def gain_before_prices(self, s: Scored) -> float:
        """Return the nats that a set gains over the base before the prices of its names and parameters."""
        return self.store.lost(self.store.base) - self.store.lost(s)

    def swap(self, best: Scored) -> None:
        """Replace every name of ``best`` by those that do about as well alone on the same outputs.

        Beside the base only one of two similar effects is extended; the other must be tried in its place.
        """
        alone = [s for s in self.store.sets.values() if len(s.placed) == 1 and s.proper]
        alone.sort(key=lambda s: (-self.store.score(s), sorted(s.names)))
        for name in sorted(best.names):
            outputs = {o for p in best.placed if p.effect.name == name for o in p.outputs}
            here = [s for s in alone if outputs & set(s.placed[0].outputs)]
            own_score = max((self.store.score(s) for s in here if name in s.names), default=np.inf)
            near = [s for s in here if self.store.score(s) > own_score - 2.0 * self.store.constants.per_name]
            rest = self.store.without(best, lambda p, n=name: p.effect.name == n)
            # alone the general effect may stand for what another name explains beside its plain case
            plain = [p.effect.plain for p in best.placed if p.effect.name == name]
            rivals = dict.fromkeys([*plain, *(n for s in near for n in s.names)])
            for rival in [n for n in rivals if n and n not in best.names][:RIVALS]:
                grown, left = rest, set(outputs)
                for s in (s for s in here if rival in s.names):
                    if left & set(s.placed[0].outputs):
                        left -= set(s.placed[0].outputs)
                        if grown is rest:
                            self.store.instead(best, name, s.placed[0])
                        grown = self.store.with_one(grown, s.placed[0])

    def grow(self) -> None:
        """Extend the best of the beam that can gain, one at a time, until the best set can hardly be beaten."""
        base = self.store.score(self.store.base)
        while self.moves:
            ranked = self.store.ranked()
            if not self.can_be_beaten(ranked[0]):
                return
            best = self.store.score(ranked[0])
            # beside the physics that its course follows an independent effect may stand
            wide = self.store.every_ranked()[:BEAM]
            beam = [s for s in wide if s.key not in self.expanded and self.can_gain(s, best)]
            chosen = next((s for s in beam if self.store.score(s) - base >= HALF * (best - base)), None)
            if chosen is None:
                return
            self.moves -= 1
            self.expand(chosen)
            self.store.listen(self.store.ranked()[0])
            self.idle = 0 if self.store.score(self.store.ranked()[0]) > best else self.idle + 1
            if self.idle >= PATIENCE:
                return

    def can_be_beaten(self, best: Scored) -> bool:
        """Return True if a set with one more name may score more than ``best``; the noise floor bounds the score."""
        c = self.store.constants
        return self.most_gain(best) + c.per_parameter * (best.parameters - 1) > c.per_name

    def can_gain(self, s: Scored, best: float) -> bool:
        """Return True if ``s`` with one more name can score more than ``best`` by explaining all down to the noise."""
        c = self.store.constants
        return self.store.score(s) + self.most_gain(s) - c.per_name - c.per_parameter > best

    def most_gain(self, s: Scored) -> float:
        """Return the most nats that one more name can add: on the output with most room, or on all in their mean.

        Small rooms on many outputs are errors of their noise floors and support no name.
        """
        room = self.store.room(s)
        return max(max(room.values()), sum(room.values()) * self.store.outputs / len(room))

    def expand(self, s: Scored) -> None:
        """Screen every candidate beside ``s``, fit the promising ones and put them into the store."""
        self.expanded.add(s.key)
        room, least = self.store.room(s), self.store.constants.per_parameter
        pool = [
            p
            for p in places(self.store.problem, self.effects, s.placed)
            if not s.placed or p.effect.test is not None or any(room[o] > least for o in p.outputs)
        ]
        least_fits, most_fits = FITS_LATER if s.placed else FITS
        beside = s.fitted if s.placed else self.ground
        trials = try_all(
            self.store.problem, beside, pool, stride=self.stride, jobs=self.jobs, progress=self.progress,
            what=f"{len(s.names)}", least=least_fits, most=most_fits, effort=self.effort,
        )  # fmt: skip
        if not s.placed:
            self.first = tuple(trials)
        children: list[tuple[Scored, Placed]] = []
        for t in trials:
            part = part_of(t.placed)
            if part not in self.store.seen or t.candidate.share > self.store.seen[part].share:
                self.store.seen[part] = t.candidate
            if t.fitted is not None:
                children.append((self.store.put(t.fitted), t.placed))
        if self.store.problem.twin.apart and len(self.store.problem.twin.outputs) > 1:
            self.spread(s, children)

    def spread(self, s: Scored, children: Sequence[tuple[Scored, Placed]]) -> None:
        """Place the two best new names on every other output where the same effect fits well alone, in one move."""
        best = [c for c in self.store.ranked([c for c, _ in children]) if c.names - s.names][:2]
        for child in best:
            (name,) = child.names - s.names
            grown = child
            own = self.store.score(s)
            others = sorted(
                ((c, p) for c, p in children if p.effect.name == name and c.key != child.key),
                key=lambda cp: -self.store.score(cp[0]),
            )
            free = self.store.constants.per_name
            for c, place in others:
                covered = {o for p in grown.placed if p.effect.name == name for o in p.outputs}
                if covered & set(place.outputs) or self.store.score(c) + free <= own:
                    continue
                grown = self.store.with_one(grown, place)


def search(
    problem: Problem, base: Fit, effects: Sequence[Effect], constants: Constants, *,
    jobs: int = 1, progress: Progress | None = None,
) -> Found:  # fmt: skip
    """Find, fit and score the sets of effects for a decision. ``base``: the recalibrated twin."""
    with np.errstate(all="ignore"):
        return Search(problem, base, effects, constants, jobs=jobs, progress=progress).run()


NOMINATED = 8
"""Number of sets of a search, best first, whose names another one tries: of the whole, or with other holds."""


def look(
    constants: Constants, jobs: int, progress: Progress | None, problem: Problem, base: Fit, allowed: tuple[Effect, ...]
) -> tuple[set[str], list[Hint]]:
    """Return the names in the best sets of a short search on a part of a recording, with their fits as hints.

    ``nominated`` calls it.
    """
    with np.errstate(all="ignore"):
        store = Search(problem, base, allowed, constants, jobs=jobs, progress=progress, moves=2).run().store
    hints = {
        part_of(p): hint_of(p, s.fitted)
        for s in reversed(best_sets(store))
        for p in s.placed
        if part_of(p) in store.seen and may_hint(p, store.seen[part_of(p)])
    }
    return {e.name for e in nominees(store, allowed)}, list(hints.values())


def best_sets(store: Store) -> list[Scored]:
    """Return the sets whose names another search tries."""
    return [s for s in store.ranked() if s.names][:NOMINATED]


def nominees(store: Store, allowed: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return those of ``allowed`` that another search of the same physics has to try.

    Events are among them in any case, because the searched part may have none.
    """
    names = {n for s in best_sets(store) for n in s.names}
    return tuple(e for e in allowed if e.name in names or e.claims is not None)
