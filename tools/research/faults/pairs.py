"""Pairs of faults: the second strikes while the first is being answered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tools.research.faults.fault import Both, Expected, Fault, Kill

GAP_S = 0.1
"""The second fault strikes up to so long after the first: within the ramp, the hold, or before anything is known."""
GROUP = 10
"""Pairs that strike the same run at the same instant."""


def draw_pairs(faults: Sequence[Fault], n: int, seed: int) -> list[tuple[Fault, ...]]:
    """``n`` pairs of ``faults`` that are drawn from ``seed``, in groups of ``GROUP``.

    A pair is judged by what holds for any two faults: no unsafe output, no uncounted sample, a message that names one
    of the two causes, and outputs that rest at the end where one of the two latches. A killed firmware is no member:
    nothing that comes after it has anything to break.
    """
    rng = np.random.default_rng([seed, n])
    members = [fault for fault in faults if fault.how != Kill("firmware")]
    pairs: dict[str, Fault] = {}
    while len(pairs) < min(n, len(members) * (len(members) - 1)):
        first, second = (members[int(k)] for k in rng.choice(len(members), 2, replace=False))
        pair = join(first, second, round(GAP_S * float(rng.random()), 6))
        pairs.setdefault(pair.name, pair)
    every = list(pairs.values())
    return [tuple(every[k : k + GROUP]) for k in range(0, len(every), GROUP)]


def join(first: Fault, second: Fault, gap_s: float) -> Fault:
    """The two as one fault."""
    latches: Expected = "safe state" if "safe state" in (first.expected, second.expected) else "any"
    return Fault(
        name=f"{first.name} + {second.name}",
        how=Both(first.how, second.how, gap_s),
        expected=latches,
        names=first.names + second.names,
        watch_s=gap_s + first.watch_s + second.watch_s,
        own_output=first.own_output or second.own_output,
        is_pair=True,
    )
