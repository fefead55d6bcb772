"""Withholds effects that lower the residual but have an essential figure that the data do not support."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tools.mismatch.engine.evidence import Doubt, doubt_of
from tools.mismatch.engine.fit import as_given
from tools.mismatch.engine.found import human_values, parameters_of
from tools.mismatch.engine.intervals import Uncertainty, uncertainty
from tools.mismatch.engine.report import ParameterValue, Withheld
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.trust import broken
from tools.mismatch.infer.store import Scored, Store

Values = dict[str, dict[str, ParameterValue]]


def borne_out(store: Store, sets: Sequence[Scored]) -> tuple[list[Scored], tuple[Withheld, ...]]:
    """Return ``sets`` (best first, the last one empty) from the first supported one on, and the withheld effects.

    A set with an effect all of whose sizes may be zero is skipped, and so is every larger set; beside fewer others the
    same effect may be sure.
    """
    left, withheld = list(sets), dict[str, Withheld]()
    given = as_given(store.problem).residual
    while left[0].placed:
        s = left[0]
        if broken(store.problem, given, s.fitted.theta, s.fitted.residual):
            # candidates are fitted on some of the rows
            left[0] = s = store.refined(s)
        if broken(store.problem, given, s.fitted.theta, s.fitted.residual):
            left.pop(0)
            continue
        unsure = uncertainty(store.problem, s.fitted)
        values = human_values(store.problem, s.fitted, unsure)
        doubts = [d for k in range(len(s.placed)) if (d := _doubt(store, s, k, values, unsure)) is not None]
        if not doubts:
            break
        left = [other for other in left if not s.names <= other.names]
        for d in doubts:
            withheld.setdefault(s.placed[d.k].effect.name, _entry(store, s, d, values, left[0].names))
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


def entry_of(store: Store, s: Scored, k: int) -> Withheld:
    """Return the entry of effect ``k`` of a set that is not likely enough to be named."""
    values = human_values(store.problem, s.fitted, uncertainty(store.problem, s.fitted))
    return _entry(store, s, Doubt(k, "unlikely", ()), values, frozenset())


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
