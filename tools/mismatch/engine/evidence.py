"""Judges the evidence for an effect: a report names only effects whose size differs significantly from zero.

A search accepts an effect because the held-out residual falls. That alone does not prove the effect: a gap of 0.00007
with the interval -0.0003 to 0.0004 lowers a residual, too. The report lists effects that fail here as tried and not
named, with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from scipy.stats import norm

from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.intervals import Uncertainty
from tools.mismatch.engine.report import ParameterValue, WithheldReason
from tools.mismatch.placed import Free


@dataclass(frozen=True)
class Doubt:
    """Holds the ``reason`` why effect ``k`` of a model is not named, and the parameters that show it."""

    k: int
    reason: WithheldReason
    shown_by: tuple[str, ...]


def holds_zero(p: ParameterValue, among: int = 1) -> bool:
    """Return True if the simultaneous 95 % interval for ``among`` parameters contains zero or is not finite.

    Z. Sidak, J. Am. Stat. Assoc. 62 (1967) 626: with more sizes of an effect, one of them differs from zero by chance
    more often.
    """
    lo, hi = p.ci95
    if not (np.isfinite(lo) and np.isfinite(hi)):
        return True
    wider = float(norm.isf(0.5 * (1.0 - 0.95 ** (1.0 / among))) / norm.isf(0.025))
    return p.value - wider * (p.value - lo) <= 0.0 <= p.value + wider * (hi - p.value)


def reaches(p: ParameterValue, span: tuple[float, float]) -> bool:
    """Return True if the 95 % interval of a parameter reaches into ``span`` or is not finite."""
    lo, hi = p.ci95
    return not (np.isfinite(lo) and np.isfinite(hi)) or (lo <= span[1] and hi >= span[0])


def absent_groups(groups: Sequence[Sequence[str]], parameters: Mapping[str, ParameterValue]) -> list[tuple[str, ...]]:
    """Return the ``groups`` (patterns) of which all parameters may be zero, as the parameters' names."""
    out: list[tuple[str, ...]] = []
    for patterns in groups:
        names = tuple(n for n in parameters if any(fnmatchcase(n, q) for q in patterns))
        if names and all(holds_zero(parameters[n], len(names)) for n in names):
            out.append(names)
    return out


def doubt_of(fitted: Fit, k: int, parameters: Mapping[str, ParameterValue], unsure: Uncertainty) -> Doubt | None:
    """Return why effect ``k`` of a model may not be named; None if it may.

    An effect that several figures show is significant if what it adds as a whole is: of a narrow play the width times
    the slope is certain, and neither figure is.
    """
    placed, at_bound = fitted.model.placed[k], fitted.at_bound
    effect = placed.effect
    stuck = tuple(n for n in effect.essential if f"{placed.label}.{n}" in at_bound)
    if stuck:
        return Doubt(k, "at_limit", stuck)
    plain = tuple(n for n, span in effect.plain_in.items() if n in parameters and reaches(parameters[n], span))
    if plain:
        return Doubt(k, "holds_plain", plain)
    absent = absent_groups(effect.plain_without, parameters)
    if not absent and (effect.vanishes_with or not effect.plain_without):
        absent = absent_groups(effect.vanishes_with or (("*",),), parameters)
        if absent and _adds_something(fitted, k, unsure):
            return None
    return Doubt(k, "holds_zero", tuple(dict.fromkeys(n for of in absent for n in of))) if absent else None


def _adds_something(fitted: Fit, k: int, unsure: Uncertainty) -> bool:
    """Return True if what effect ``k`` adds differs significantly from nothing, whatever each of its figures is.

    The best of all values of the searched figures is tested, which do not exist where there is nothing (R. B. Davies,
    Biometrika 64, 1977, 247): the p-value is corrected for the values that the data could tell apart.
    """
    placed = fitted.model.placed[k]
    own, weights = fitted.model.slices(k)
    searched = fitted.model.parameters[own]
    figures = len(searched) + weights.stop - weights.start - placed.weights_beside
    sizes = sum(len(group) for group in placed.effect.vanishes_with)
    if figures < 2 or not sizes or (searched and sizes < 2):
        return False
    return unsure.chance_of_none(k, figures) * math.prod(_cells(p) for p in searched) < 0.05


def _cells(p: Free) -> float:
    """Return the number of typical steps of a parameter between its bounds, at least one."""
    return max((p.hi - p.lo) / p.scale, 1.0)
