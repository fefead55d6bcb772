"""Which of the selected effects the report may name: those whose size the data show to differ from zero.

A search accepts an effect because the held-out residual falls. That alone does not say that the effect is what its name
says: a gap of 0.00007 between -0.0003 and 0.0004 lowers a residual, too. What fails here is taken out of the model,
everything else is fitted again, and the report lists it as tried and not named, with the reason.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from scipy.stats import norm

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.found import human_values, parameters_of
from tools.mismatch.engine.intervals import uncertainty
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import ParameterValue, Withheld, WithheldReason
from tools.mismatch.engine.score import held_rms, misfits
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.selection import Selection
from tools.mismatch.engine.vary import reduced, replaced, size
from tools.mismatch.placed import Placed


@dataclass(frozen=True)
class Doubt:
    """Why effect ``k`` of a model is not named: ``reason``, and the parameters that show it."""

    k: int
    reason: WithheldReason
    shown_by: tuple[str, ...]


def holds_zero(p: ParameterValue, among: int = 1) -> bool:
    """Return whether the interval contains zero that holds at 95 % for ``among`` parameters together (Z. Sidak, J. Am.
    Stat. Assoc. 62 (1967) 626); an interval that is not finite does.

    The more sizes an effect has, the likelier is one of them away from zero by chance.
    """
    lo, hi = p.ci95
    if not (np.isfinite(lo) and np.isfinite(hi)):
        return True
    wider = float(norm.isf(0.5 * (1.0 - 0.95 ** (1.0 / among))) / norm.isf(0.025))
    return p.value - wider * (p.value - lo) <= 0.0 <= p.value + wider * (hi - p.value)


def absent_groups(effect: Effect, parameters: Mapping[str, ParameterValue]) -> list[tuple[str, ...]]:
    """The groups of ``effect.vanishes_with`` all of whose parameters may be zero, as the parameters' names."""
    out: list[tuple[str, ...]] = []
    for patterns in effect.vanishes_with or (("*",),):
        names = tuple(n for n in parameters if any(fnmatchcase(n, q) for q in patterns))
        if names and all(holds_zero(parameters[n], len(names)) for n in names):
            out.append(names)
    return out


def doubt_of(
    placed: Placed, k: int, parameters: Mapping[str, ParameterValue], at_bound: Collection[str]
) -> Doubt | None:
    """Why this effect may not be named; None when it may."""
    stuck = tuple(n for n in placed.effect.essential if f"{placed.label}.{n}" in at_bound)
    if stuck:
        return Doubt(k, "at_limit", stuck)
    absent = absent_groups(placed.effect, parameters)
    return Doubt(k, "holds_zero", tuple(dict.fromkeys(n for of in absent for n in of))) if absent else None


def weigh_evidence(
    problem: Problem, selection: Selection, effects: Sequence[Effect] = ()
) -> tuple[Selection, tuple[Withheld, ...]]:
    """The selection without the effects that the data do not bear out, one at a time, weakest first.

    Where an effect generalises a plainer one of ``effects``, the plainer one takes its place and is weighed in turn.
    """
    withheld: list[Withheld] = []
    current = selection
    for _ in range(2 * len(selection.fitted.model.placed)):
        fitted = current.fitted
        values = human_values(problem, fitted, uncertainty(problem, fitted))
        doubts: list[tuple[float, Doubt, Fit]] = []
        for k, placed in enumerate(fitted.model.placed):
            doubt = doubt_of(placed, k, values.get(placed.label, {}), fitted.at_bound)
            limits = [problem.recording.tolerance.get(o, 0.0) for o in placed.outputs]
            if doubt is None and not all(limits):
                continue
            without = reduced(problem, fitted, k)
            if doubt is None and all(
                float(np.std((without.residual[o] - fitted.residual[o])[problem.held_rows])) < most
                for o, most in zip(placed.outputs, limits, strict=True)
            ):
                doubt = Doubt(k, "below_tolerance", ())
            if doubt is not None:
                doubts.append((sum(misfits(problem, without).values()), doubt, without))
        if not doubts:
            break
        _, doubt, without = min(doubts, key=lambda d: (d[0], d[1].k))
        placed = fitted.model.placed[doubt.k]
        o = max(placed.outputs, key=lambda q: held_rms(problem, without)[q] / problem.sigma(q))
        shown = parameters_of(problem, placed, o, values.get(placed.label, {}))
        plainer = _plainer(problem, fitted, doubt, effects)
        withheld.append(
            Withheld(
                placed.effect.name,
                o,
                doubt.reason,
                shown,
                doubt.shown_by,
                held_rms(problem, without)[o],
                held_rms(problem, fitted)[o],
                plainer.model.placed[-1].effect.name if plainer is not None else "",
            )
        )
        current = _with_plainer(current, doubt.k, plainer, problem) if plainer else _dropped(current, placed, without)
    if current is selection:
        return selection, ()
    again = fit(problem, current.fitted.model, [current.fitted.theta], iterations=15)
    if again.ok and again.cost <= current.fitted.cost * 1.001:
        current = replace(current, fitted=again)
    return current, tuple(withheld)


def _dropped(selection: Selection, placed: Placed, fitted: Fit) -> Selection:
    """The selection without one effect."""
    keep = [i for i, s in enumerate(selection.steps) if s.label != placed.label]
    steps, rivals = tuple(selection.steps[i] for i in keep), tuple(selection.rivals[i] for i in keep)
    return replace(selection, fitted=fitted, steps=steps, rivals=rivals)


def _plainer(problem: Problem, fitted: Fit, doubt: Doubt, effects: Sequence[Effect]) -> Fit | None:
    """The fit with the plainer effect in the same place, if the vocabulary has it there."""
    placed = fitted.model.placed[doubt.k]
    others = tuple(p for j, p in enumerate(fitted.model.placed) if j != doubt.k)
    named = [e for e in effects if placed.effect.plain and e.name == placed.effect.plain]
    for place in places(problem, named, others):
        if (place.site, place.target, place.outputs) == (placed.site, placed.target, placed.outputs):
            with np.errstate(all="ignore"):
                found = replaced(problem, fitted, doubt.k, place)
            return found if found.ok else None
    return None


def _with_plainer(selection: Selection, k: int, fitted: Fit, problem: Problem) -> Selection:
    """The selection with the plainer effect (last of ``fitted``) where effect ``k`` was."""
    before, now = selection.fitted.model.placed[k], fitted.model.placed[-1]
    steps, rivals = list(selection.steps), list(selection.rivals)
    for i, s in enumerate(steps):
        if s.label == before.label:
            steps[i] = replace(s, placed=now, fitted=fitted, misfits=misfits(problem, fitted), parameters=size(now))
            rivals[i] = tuple(t for t in rivals[i] if t.name != now.effect.name)
    return replace(selection, fitted=fitted, steps=tuple(steps), rivals=tuple(rivals))
