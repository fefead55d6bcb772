"""Asks again for the hold of inputs when effects are known: a missing effect may have hidden it from the twin alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tools.mismatch.engine.fit import fit, fit_base
from tools.mismatch.engine.hold import DELAYS, as_held, hold_groups
from tools.mismatch.engine.report import Hold
from tools.mismatch.infer.store import Scored, Store
from tools.mismatch.simulate import Model

TRIED = 4
"""Number of sets, best first, that are fitted again with inputs of another hold."""
EVIDENCE = 3.0
"""Nats by which another hold must be better if it changes no name: strong evidence (Kass and Raftery, J. Am. Stat.
Assoc. 90, 1995, 773). Below it a new search would tell nothing new."""


def better_holds(store: Store, chosen: Scored, holds: Mapping[str, Hold]) -> dict[str, Hold]:
    """Return held inputs with which a set of effects scores better than ``chosen``; empty if there are none.

    Tried are the inputs whose hold was assumed, one by one where each may have its own, and together. Holds have no
    price, so that a set without a delay of half a sample, which held inputs explain, is better by the price of that
    name.
    """
    assumed = [s for s, h in holds.items() if h.how == "assumed"]
    if not assumed or not chosen.placed:
        return {}
    groups = hold_groups(store.problem, assumed)
    alternatives = [*groups, tuple(assumed)] if len(groups) > 1 else groups
    found = [(*_best(store, held), held) for held in alternatives]
    score, names, held = max(found, key=lambda f: f[0])
    before, _ = _best(store, ())  # with the same effort
    if not score > before + (EVIDENCE if names == chosen.names else 0.0):
        return {}
    lost = chosen.names - names
    return dict.fromkeys(held, Hold("zero", "instead_of_delay" if lost & DELAYS else "inferred"))


def _best(store: Store, held: Sequence[str]) -> tuple[float, frozenset[str]]:
    """Return the best score of the first sets with these inputs held, and the names of that set."""
    other = as_held(store.problem, dict.fromkeys(held, "zero"))
    with np.errstate(all="ignore"):
        again = type(store)(other, fit_base(other), store.constants)
        for s in store.ranked()[:TRIED]:
            model = Model(other.twin, s.placed)
            theta = model.carry(s.fitted.model, s.fitted.theta, other.recording)
            again.put(fit(other, model, [theta], iterations=15))
    best = again.ranked()[0]
    return again.score(best), best.names
