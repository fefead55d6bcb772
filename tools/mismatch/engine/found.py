"""The physics that a search accepted, as the report lists it: parameters with intervals, how sure, and the rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from tools.mismatch.engine.events import half_widths
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.identifiability import experiment
from tools.mismatch.engine.intervals import Uncertainty
from tools.mismatch.engine.parsimony import Rule, as_good, complexity
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Alternative, Equivalent, ParameterValue, PhysicsFound
from tools.mismatch.engine.score import compare, misfits, paired_t
from tools.mismatch.engine.selection import Selection
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.vary import reduced
from tools.mismatch.placed import Placed
from tools.mismatch.twins.ode import inside_of
from tools.numbers import rms

Array = NDArray[np.float64]


def human_values(problem: Problem, fitted: Fit, unsure: Uncertainty) -> dict[str, dict[str, ParameterValue]]:
    """Human parameters with 95 % intervals by the delta method, per effect label and
    "base".
    """
    model, theta = fitted.model, fitted.theta
    values = model.human(theta)
    flat = np.array([h.value for group in values.values() for h in group])
    gradient = np.zeros((flat.size, theta.size))
    deviations = unsure.deviations()
    for i in range(theta.size):
        sd = float(deviations[i])
        p = model.parameters[i]
        h = min(0.1 * sd, 1e-2 * max(abs(theta[i]), p.scale)) or 1e-6 * max(abs(theta[i]), abs(p.scale))
        if not np.isfinite(h) or h == 0:
            continue
        shifted = theta.copy()
        shifted[i] = theta[i] + h if theta[i] + h <= p.hi else theta[i] - h
        moved = np.array([q.value for group in model.human(shifted).values() for q in group])
        gradient[:, i] = (moved - flat) / (shifted[i] - theta[i])
    gradient = np.nan_to_num(gradient)
    spread = unsure.spread(gradient)
    read_off = {p.label: half_widths(problem, fitted, k) for k, p in enumerate(model.placed)}
    out: dict[str, dict[str, ParameterValue]] = {}
    # beyond its bounds a parameter was not searched
    bounds = {p.name: (p.lo, p.hi) for p in model.parameters[model.n_base :]}
    i = 0
    for label, group in values.items():
        out[label] = {}
        for h in group:
            half = max(1.96 * float(np.hypot(spread[i], h.spread)), read_off.get(label, {}).get(h.name, 0.0))
            lo, hi = bounds.get(f"{label}.{h.name}", (-np.inf, np.inf))
            ends = (max(h.value - half, min(lo, h.value)), min(h.value + half, max(hi, h.value)))
            out[label][h.name] = ParameterValue(h.value, h.unit, ends)
            i += 1
    return out


def _units(problem: Problem, trial_unit: str, target: str, output: str, placed: Placed) -> str:
    inside = inside_of(problem.twin) if placed.site == "feedback" else None
    if inside is not None:
        u_in, u_out = inside.place_units(placed.target)
        return trial_unit.replace("{in}", u_in).replace("{out}", u_out)
    units = problem.twin.units
    drive = problem.twin.drive(output) or target
    # a force inside the equation of motion has the unit of what drives it, and what is added to a static twin's
    # output is driven by its input
    driven = placed.site == "feedback" or (problem.twin.static and placed.effect.kind == "add")
    source = drive if driven or target not in units else target
    moves = units.get(output, "1")
    if placed.site == "feedback" and problem.twin.counted:
        moves = moves.removesuffix("/s")  # forces depend on position
    return trial_unit.replace("{in}", units.get(source, "1")).replace("{out}", moves)


def parameters_of(
    problem: Problem, placed: Placed, output: str, values: Mapping[str, ParameterValue]
) -> dict[str, ParameterValue]:
    """Human parameters of a placed effect with the units of the signals that it stands between."""
    return {
        n: ParameterValue(v.value, _units(problem, v.unit, placed.target, output, placed), v.ci95)
        for n, v in values.items()
    }


def physics_found(
    problem: Problem, selection: Selection, unsure: Uncertainty, alike: Mapping[str, Sequence[Trial]]
) -> list[PhysicsFound]:
    """Accepted effects in the order of their acceptance, parameters from the joint fit.
    ``alike``: per label the rivals that this recording cannot tell from it.
    """
    fitted = selection.fitted
    if not fitted.model.placed:
        return []
    values = human_values(problem, fitted, unsure)
    rows = problem.held_rows
    out: list[PhysicsFound] = []
    for k, placed in enumerate(fitted.model.placed):
        small = reduced(problem, fitted, k)
        c = compare(problem, small, fitted)
        worst = max(placed.outputs, key=lambda o: c.effect_rms.get(o, 0.0) / problem.sigma(o))
        if placed.site == "feedback":
            worst = placed.target if placed.target in small.residual else worst  # whose unit its parameters have
        step = next((i for i, s in enumerate(selection.steps) if s.label == placed.label), None)
        sure = float(norm.cdf(min(c.z, 8.0)))
        if step is not None:
            same = alike.get(placed.label, ())
            others = [t for t in selection.rivals[step] if t.name not in {a.name for a in same}]
            sure *= against_rivals(selection.steps[step], others) * share_among(selection.steps[step], same)
        a, b = fitted.model.slices(k)
        raw = {
            fitted.model.parameters[i].name.rsplit(".", 1)[-1]: float(fitted.theta[i])
            for i in (*range(a.start, a.stop), *range(b.start, b.stop))
        }
        parameters = parameters_of(problem, placed, worst, values.get(placed.label, {}))
        out.append(
            PhysicsFound(
                placed.effect.name,
                worst,
                placed.stage,
                round(min(sure, 0.999), 4),
                parameters,
                placed.effect.equation,
                placed.effect.source,
                rms(small.residual[worst][rows]),
                rms(fitted.residual[worst][rows]),
                placed.site,
                placed.target,
                placed.outputs,
                dict(placed.settings),
                raw,
                placed.note,
                tuple(n for n in fitted.at_bound if n.startswith(placed.label + ".")),
            )
        )
    return out


def against_rivals(step: Trial, rivals: Sequence[Trial]) -> float:
    """How sure the named effect is against the best other name: a simpler one's lead counts in full, a family with more
    freedom that fits as well only casts some doubt.
    """
    sure = 1.0
    for t in rivals:
        if t.name == step.name or not set(t.placed.outputs) & set(step.placed.outputs):
            continue
        lead = float(norm.cdf(paired_t(t.energy, step.energy)))
        sure = min(sure, lead if t.parameters <= step.parameters else max(lead, 0.8))
    return sure


PER_PARAMETER = 0.4
"""Nats that a free parameter costs: the lower end of what two sets of generated cases gave (0.4 to 0.9), so that the
plainer of two equals is preferred by no more than was seen."""


def share_among(step: Trial, alike: Sequence[Trial]) -> float:
    """Probability of the named effect among those that fit as well: their likelihoods count as equal, so only what
    further parameters cost tells them apart. A rival with fewer parameters counts as much as the named effect.
    """
    odds = (np.exp(-PER_PARAMETER * max(complexity(t) - complexity(step), 0.0)) for t in alike)
    return 1.0 / (1.0 + float(sum(odds)))


AS_WELL = 1.05
"""Times what the named effect leaves: a rival that leaves more does not fit as well, however plain it is."""


def alternatives(
    problem: Problem, selection: Selection, rule: Rule
) -> tuple[list[Alternative], list[Equivalent], dict[str, list[Trial]]]:
    """Runners-up of each step with why not, groups that this recording cannot tell apart, and the rivals of these
    groups by the label of the effect that is named."""
    out: list[Alternative] = []
    groups: list[Equivalent] = []
    same_by_label: dict[str, list[Trial]] = {}
    named = {p.effect.name for p in selection.fitted.model.placed}
    rows = problem.held_rows
    before = misfits(problem, selection.base)
    for step, rivals in zip(selection.steps, selection.rivals, strict=True):
        alike: list[Trial] = []
        assert step.fitted is not None
        theirs = step.fitted.residual
        for t in rivals[:6]:
            if t.fitted is None or t.name in named:
                continue
            o = next(q for q in t.placed.outputs if q in step.placed.outputs)
            left = rms(t.fitted.residual[o][rows])
            same = as_good(t, step, rule, o, before[o]) and left <= AS_WELL * rms(theirs[o][rows])
            if same:
                why = f"fits as well; {step.name} is simpler" if t.parameters > step.parameters else "fits as well"
                if t.name not in (a.name for a in alike):
                    alike.append(t)
            else:
                mine, best = (np.mean([v.misfits.get(q, np.inf) for q in t.placed.outputs]) for v in (t, step))
                why = f"leaves {np.sqrt(mine / max(best, 1e-12)):.2f} times the residual of {step.name}"
            out.append(Alternative(t.name, o, left, why))
        if alike:
            names = (step.name, *(t.name for t in alike))
            groups.append(Equivalent(names, experiment(step.placed.effect, alike[0].placed.effect)))
            same_by_label[step.label] = alike
    return out, groups, same_by_label
