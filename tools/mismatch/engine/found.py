"""Lists the accepted physics for the report: parameters with intervals, probabilities, and rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tools.mismatch.engine.events import half_widths
from tools.mismatch.engine.evidence import absent_groups
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.intervals import Uncertainty
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import ParameterValue, PhysicsFound
from tools.mismatch.engine.score import compare
from tools.mismatch.engine.vary import reduced
from tools.mismatch.placed import Placed
from tools.mismatch.twins.ode import inside_of
from tools.numbers import rms


def human_values(problem: Problem, fitted: Fit, unsure: Uncertainty) -> dict[str, dict[str, ParameterValue]]:
    """Return human parameters with 95 % intervals by the delta method, per effect label and "base"."""
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
    # the interval is clipped to the bounds within which the parameter was searched
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


def values_of_forms(
    problem: Problem, fitted: Fit, unsure: Uncertainty, forms: Sequence[Fit]
) -> dict[str, dict[str, ParameterValue]]:
    """Return the human parameters of ``fitted`` with intervals that are as wide around the values of all ``forms``.

    Data that do not tell two forms of an effect apart leave its parameters uncertain by both (Chatfield, J. R. Stat.
    Soc. A 158, 1995).
    """
    out = human_values(problem, fitted, unsure)
    for form in forms:
        for label, group in form.model.human(form.theta).items():
            here = out.get(label, {})
            here |= {h.name: _around(here[h.name], h.value) for h in group if h.name in here}
    return out


def _around(p: ParameterValue, other: float) -> ParameterValue:
    """Return ``p`` with its interval widened to one that is as wide around another value."""
    lo, hi = p.ci95
    return replace(p, ci95=(min(lo, other - (p.value - lo)), max(hi, other + (hi - p.value))))


def _units(problem: Problem, trial_unit: str, target: str, output: str, placed: Placed) -> str:
    inside = inside_of(problem.twin) if placed.site == "feedback" else None
    if inside is not None:
        u_in, u_out = inside.place_units(placed.target)
        return trial_unit.replace("{in}", u_in).replace("{out}", u_out)
    units = problem.twin.units
    drive = problem.twin.drive(output) or target
    # a force inside the equation of motion has the unit of its driving signal, and an addition to a static twin's
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
    """Return the human parameters of a placed effect with the units of the adjacent signals."""
    return {
        n: ParameterValue(v.value, _units(problem, v.unit, placed.target, output, placed), v.ci95)
        for n, v in values.items()
    }


def physics_found(
    problem: Problem, base: Fit, fitted: Fit, values: Mapping[str, Mapping[str, ParameterValue]],
    sure: Mapping[str, float],
) -> list[PhysicsFound]:  # fmt: skip
    """Return the effects of a model; ``base``: the fit without any; ``values``: its parameters; ``sure``: the
    probability of every name."""
    rows = problem.held_rows
    out: list[PhysicsFound] = []
    for k, placed in enumerate(fitted.model.placed):
        small = min(reduced(problem, fitted, k), base, key=lambda f: f.cost)  # a poor minimum would flatter the effect
        c = compare(problem, small, fitted)
        worst = max(placed.outputs, key=lambda o: c.effect_rms.get(o, 0.0) / problem.sigma(o))
        if placed.site == "feedback":
            worst = placed.target if placed.target in small.residual else worst  # its unit is that of the parameters
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
                round(sure[placed.effect.name], 4),
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
                bool(absent_groups(placed.effect.vanishes_with, parameters)),
            )
        )
    return out
