"""Withholds effects that lower the residual but have an essential figure that the data do not support."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tools.mismatch.engine.evidence import Doubt, doubt_of
from tools.mismatch.engine.fit import Fit, as_given
from tools.mismatch.engine.found import human_values, parameters_of
from tools.mismatch.engine.intervals import Uncertainty, uncertainty
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import ParameterValue, Withheld
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.trust import broken
from tools.mismatch.infer.store import Scored, Store

Values = dict[str, dict[str, ParameterValue]]


Out = Callable[[Scored], bool]
"""Returns True for a set that is no candidate any more."""


def borne_out(
    store: Store, accepted: Callable[[Store, Sequence[Out]], list[Scored]]
) -> tuple[list[Scored], tuple[Withheld, ...]]:
    """Return the accepted sets, best first and the last one empty, of which the first is supported, and the withheld
    effects.

    A set with an effect all of whose sizes may be zero is no candidate, and neither is a larger one; beside fewer
    others the same effect may be sure. The set without the effect is fitted, and ranked with the others. Effects that
    follow a signal without being defined by one are withheld where their set is the better one.
    """
    gone, withheld = list[Out](), dict[str, Withheld]()
    given = as_given(store.problem).residual
    while (left := accepted(store, gone))[0].placed:
        s = left[0]
        if broken(store.problem, given, s.fitted.theta, s.fitted.residual):
            # candidates are fitted on some of the rows
            left[0] = s = store.refined(s)
        if broken(store.problem, given, s.fitted.theta, s.fitted.residual):
            gone.append(lambda other, names=s.names: other.names == names)
            continue
        unsure = uncertainty(store.problem, s.fitted)
        values = human_values(store.problem, s.fitted, unsure)
        doubts = [d for k in range(len(s.placed)) if (d := _doubt(store, s, k, values, unsure)) is not None]
        if not doubts:
            break
        gone.append(lambda other, names=s.names: names <= other.names)
        doubted = {s.placed[d.k].effect.name for d in doubts}
        rest = store.without(s, lambda e, doubted=doubted: e.effect.name in doubted)
        for d in doubts:
            withheld.setdefault(s.placed[d.k].effect.name, _entry(store, s, d, values, rest.names))
    for s in store.every_ranked():
        if s.key == left[0].key:
            break
        if (found := store.dependent(s)) is not None:
            effect, followed = found
            withheld.setdefault(
                effect.effect.name,
                entry_of(store, s, Doubt(s.placed.index(effect), "follows_signal", (followed.signal,))),
            )
    return left, tuple(w for name, w in withheld.items() if name not in left[0].names)


def _doubt(store: Store, s: Scored, k: int, values: Values, unsure: Uncertainty) -> Doubt | None:
    """Return why effect ``k`` of a set is not named: a figure, or a size within the recording's tolerances."""
    p, placed = store.problem, s.placed[k]
    doubt = doubt_of(s.fitted, k, values.get(placed.label, {}), unsure)
    if doubt is not None:
        return doubt
    limits = {o: p.recording.tolerance.get(o, 0.0) for o in placed.outputs}
    if not all(limits.values()):
        return None
    without = store.without(s, lambda e: e is placed).fitted
    small = all(
        float(np.std((without.residual[o] - s.fitted.residual[o])[p.held_rows])) < most for o, most in limits.items()
    )
    return Doubt(k, "below_tolerance", ()) if small else None


def doubts_of(problem: Problem, fitted: Fit) -> list[Doubt]:
    """Return the effects of a fit that are in doubt: a size that they need may be zero, or is at a limit."""
    unsure = uncertainty(problem, fitted)
    values = human_values(problem, fitted, unsure)
    found = (doubt_of(fitted, k, values.get(e.label, {}), unsure) for k, e in enumerate(fitted.model.placed))
    return [d for d in found if d is not None]


def entry_of(store: Store, s: Scored, doubt: Doubt) -> Withheld:
    """Return the entry of an effect of a set that is in ``doubt``."""
    values = human_values(store.problem, s.fitted, uncertainty(store.problem, s.fitted))
    return _entry(store, s, doubt, values, frozenset())


def _entry(store: Store, s: Scored, doubt: Doubt, values: Values, named: frozenset[str]) -> Withheld:
    """Return the entry of a withheld effect; ``named`` are the names that replace it."""
    p, placed = store.problem, s.placed[doubt.k]
    with_it = held_rms(p, s.fitted)
    without = held_rms(p, store.without(s, lambda e: e is placed).fitted)
    o = max(placed.outputs, key=lambda q: without[q] / p.sigma(q))
    plain = placed.effect.plain
    return Withheld(
        placed.effect.name, o, doubt.reason, parameters_of(p, placed, o, values.get(placed.label, {})), doubt.shown_by,
        without[o], with_it[o], plain if plain and plain in named - s.names else "",
    )  # fmt: skip
