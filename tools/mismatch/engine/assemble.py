"""The report put together from what the engine found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.colour import fit_whitener, ljung_box
from tools.mismatch.engine.events import half_widths
from tools.mismatch.engine.families import EXACT
from tools.mismatch.engine.fit import Fit, residuals
from tools.mismatch.engine.identifiability import detection, experiment
from tools.mismatch.engine.intervals import covariance
from tools.mismatch.engine.locate import follow, regime, windows
from tools.mismatch.engine.parsimony import Rule, as_good
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import (
    Alternative,
    BaseShift,
    Checks,
    DependsOn,
    Equivalent,
    FitSummary,
    Location,
    ParameterValue,
    PhysicsFound,
    Pictures,
    Report,
    Verdict,
    Window,
)
from tools.mismatch.engine.revise import reduced
from tools.mismatch.engine.score import compare, held_rms, misfits, paired_t
from tools.mismatch.engine.select import Selection
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.unexplained import Leftover, about, lone_event
from tools.mismatch.report.wording import number, scaled
from tools.mismatch.simulate import Model, Placed

Array = NDArray[np.float64]


def human_values(problem: Problem, fitted: Fit) -> dict[str, dict[str, ParameterValue]]:
    """Human parameters with 95 % intervals by the delta method, per effect label and "base"."""
    model, theta = fitted.model, fitted.theta
    cov = covariance(problem, fitted)
    values = model.human(theta)
    flat = np.array([h.value for group in values.values() for h in group])
    gradient = np.zeros((flat.size, theta.size))
    for i in range(theta.size):
        sd = float(np.sqrt(max(cov[i, i], 0.0)))
        p = model.parameters[i]
        h = min(0.1 * sd, 1e-2 * max(abs(theta[i]), p.scale)) or 1e-6 * max(abs(theta[i]), abs(p.scale))
        if not np.isfinite(h) or h == 0:
            continue
        shifted = theta.copy()
        shifted[i] = theta[i] + h if theta[i] + h <= p.hi else theta[i] - h
        moved = np.array([q.value for group in model.human(shifted).values() for q in group])
        gradient[:, i] = (moved - flat) / (shifted[i] - theta[i])
    gradient = np.nan_to_num(gradient)
    spread = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", gradient, cov, gradient), 0.0))
    read_off = {p.label: half_widths(problem, fitted, k) for k, p in enumerate(model.placed)}
    out: dict[str, dict[str, ParameterValue]] = {}
    i = 0
    for label, group in values.items():
        out[label] = {}
        for h in group:
            half = max(1.96 * float(spread[i]), read_off.get(label, {}).get(h.name, 0.0))
            out[label][h.name] = ParameterValue(h.value, h.unit, (h.value - half, h.value + half))
            i += 1
    return out


def _rms(r: Array) -> float:
    return float(np.sqrt(np.mean(r**2)))


def _units(problem: Problem, trial_unit: str, target: str, output: str, placed: Placed) -> str:
    units = problem.twin.units
    drive = problem.twin.drive(output) or target
    # a force inside the equation of motion has the unit of what drives it, and what is added to a static twin's
    # output is driven by its input
    driven = placed.site == "feedback" or (problem.twin.static and placed.effect.kind == "add")
    source = drive if driven or target not in units else target
    return trial_unit.replace("{in}", units.get(source, "1")).replace("{out}", units.get(output, "1"))


def physics_found(problem: Problem, selection: Selection) -> list[PhysicsFound]:
    """Accepted effects in the order of their acceptance, parameters from the joint fit."""
    fitted = selection.fitted
    if not fitted.model.placed:
        return []
    values = human_values(problem, fitted)
    rows = problem.held_rows
    out: list[PhysicsFound] = []
    for k, placed in enumerate(fitted.model.placed):
        small = reduced(problem, fitted, k)
        c = compare(problem, small, fitted)
        worst = max(placed.outputs, key=lambda o: c.effect_rms.get(o, 0.0) / problem.sigma(o))
        if placed.site == "feedback":
            worst = placed.target  # whose unit its parameters have
        step = next((i for i, s in enumerate(selection.steps) if s.label == placed.label), None)
        sure = float(norm.cdf(min(c.z, 8.0)))
        if step is not None:
            sure *= against_rivals(selection.steps[step], selection.rivals[step])
        a, b = fitted.model.slices(k)
        raw = {
            fitted.model.parameters[i].name.rsplit(".", 1)[-1]: float(fitted.theta[i])
            for i in (*range(a.start, a.stop), *range(b.start, b.stop))
        }
        parameters = {
            n: ParameterValue(v.value, _units(problem, v.unit, placed.target, worst, placed), v.ci95)
            for n, v in values.get(placed.label, {}).items()
        }
        out.append(
            PhysicsFound(
                placed.effect.name,
                worst,
                placed.stage,
                round(min(sure, 0.999), 4),
                parameters,
                placed.effect.equation,
                placed.effect.source,
                _rms(small.residual[worst][rows]),
                _rms(fitted.residual[worst][rows]),
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


def alternatives(problem: Problem, selection: Selection, rule: Rule) -> tuple[list[Alternative], list[Equivalent]]:
    """Runners-up of each step with why not, and groups that this recording cannot tell apart."""
    out: list[Alternative] = []
    groups: list[Equivalent] = []
    named = {p.effect.name for p in selection.fitted.model.placed}
    rows = problem.held_rows
    before = misfits(problem, selection.base)
    for step, rivals in zip(selection.steps, selection.rivals, strict=True):
        alike: list[Trial] = []
        for t in rivals[:6]:
            if t.fitted is None or t.name in named:
                continue
            o = next(q for q in t.placed.outputs if q in step.placed.outputs)
            rms = _rms(t.fitted.residual[o][rows])
            same = as_good(t, step, rule, o, before[o])
            if same:
                why = f"fits as well; {step.name} is simpler" if t.parameters > step.parameters else "fits as well"
                if t.name not in (a.name for a in alike):
                    alike.append(t)
            else:
                mine, best = (np.mean([v.misfits.get(q, np.inf) for q in t.placed.outputs]) for v in (t, step))
                why = f"leaves {np.sqrt(mine / max(best, 1e-12)):.2f} times the residual of {step.name}"
            out.append(Alternative(t.name, o, rms, why))
        if alike:
            names = (step.name, *(t.name for t in alike))
            groups.append(Equivalent(names, experiment(step.placed.effect, alike[0].placed.effect)))
    return out, groups


def base_shifts(problem: Problem, raw: Fit, base: Fit, fitted: Fit) -> list[BaseShift]:
    """How far the missing effects had pulled the base parameters."""
    cov = covariance(problem, fitted)
    shifts: list[BaseShift] = []
    for i in range(base.model.n_base):
        p = base.model.parameters[i]
        half = 1.96 * float(np.sqrt(max(cov[i, i], 0.0)))
        v = float(fitted.theta[i])
        shifts.append(BaseShift(p.name, p.unit, float(raw.theta[i]), float(base.theta[i]), v, (v - half, v + half)))
    return shifts


MUCH = 5.0
"""Mean square over noise variance beyond what the colour of noise adds to a floor that was read off its quiet end."""
WANDERS = 0.1
"""Share of what a random walk leaves that must follow a recorded signal before it is held against the walk: nobody
predicts a walk, so what it leaves on held-out data says nothing by itself."""


def beyond_form(selection: Selection) -> float:
    """Share of the mismatch that no form of the named effects accounts for: more than that is something else.

    What foreign forms of rightly named effects leave stays below 0.055, what imitations leave starts at 0.065.
    """
    return 0.03 if all(s.name in EXACT for s in selection.steps) else 0.06


LOUD = 9.0
"""Mean square over noise variance that no colour of noise accounts for, even when nothing is known to follow it."""
OF_THE_CLOCK = frozenset(
    (
        "clock_skew", "dropped_samples", "thermal_drift", "random_walk", "step_shift", "spikes", "mains_interference",
        "vibration",
    )
)  # fmt: skip
"""Effects that come with time or grow with it; all others are driven by recorded signals."""


def decide(
    problem: Problem, raw: Fit, base: Fit, selection: Selection, left: dict[str, Leftover], rule: Rule
) -> tuple[Verdict, float]:
    """The verdict and the p-value that nothing is missing."""
    if selection.strange is not None:
        return "unexplained", selection.strange.p_value
    if selection.steps:
        p = min(float(np.exp(s.comparison.log_p)) for s in selection.steps if s.comparison)
        worst = max(left.values(), key=lambda v: v.ratio)
        before = max(compare_ratio(problem, base, o) for o in left)
        left_over = (worst.ratio - 1) / max(before - 1, 1e-9)
        walks = any(s.name == "random_walk" and worst.output in s.placed.outputs for s in selection.steps)
        if walks and not any(d.signal != "time" and d.strength > WANDERS and d.p_value < 1e-4 for d in worst.follows):
            return "missing_physics", p
        if any(s.name == "quantization" and worst.output in s.placed.outputs for s in selection.steps):
            # readings beside an edge of the grid fall on either side, and nobody knows on which
            step = problem.floors[worst.output].step
            if worst.ratio * problem.sigma(worst.output) ** 2 < step**2 / 12:
                return "missing_physics", p
        if worst.real and left_over > 0.3 and worst.ratio > 1.3:
            return "unexplained", p
        if worst.real and not walks and worst.ratio > 2.0 and left_over > beyond_form(selection):
            return "unexplained", p
        if not walks and worst.ratio > MUCH and left_over > 0.1:
            return "unexplained", p
        return "missing_physics", p
    if any(v.real and v.ratio > 1.05 for v in left.values()):
        p = min((d.p_value for v in left.values() for d in v.follows), default=1.0)
        return "unexplained", p
    if any(lone_event(problem, base, o) for o in left):
        return "unexplained", 1e-6
    loud = [o for o, v in left.items() if v.ratio > LOUD and ljung_box(base.residual[o][problem.held_rows]) < 1e-6]
    if loud:
        return "unexplained", 1e-6
    moved = compare(problem, raw, base)
    if moved.z > rule.z and moved.gain > rule.gain:
        return "recalibrate", 1.0
    return "agrees", 1.0


def compare_ratio(problem: Problem, fitted: Fit, output: str) -> float:
    """Held-out mean square over noise variance."""
    return float(np.mean((fitted.residual[output][problem.held_rows] / problem.sigma(output)) ** 2))


def assemble(
    problem: Problem,
    raw: Fit,
    base: Fit,
    selection: Selection,
    left: dict[str, Leftover],
    effects: Sequence[Effect],
    rule: Rule,
    said: Sequence[str] = (),
    official: Problem | None = None,
) -> Report:
    """Everything the contract asks for. ``said``: messages of the checks; ``official``: the held-out part in one
    free run, when the decisions were made on shorter stretches.
    """
    rec, twin = problem.recording, problem.twin
    fitted = selection.fitted
    verdict, p = decide(problem, raw, base, selection, left, rule)
    physics = physics_found(problem, selection)
    runners, groups = alternatives(problem, selection, rule)
    looked = fitted if verdict == "unexplained" else base
    if verdict == "missing_physics":
        touched = [o for o in twin.outputs if any(o in f.outputs for f in physics)]
        gains = {
            o: 1 - compare_ratio(problem, fitted, o) / max(compare_ratio(problem, base, o), 1e-12) for o in touched
        }
        guilty = [o for o in touched if gains[o] > 0.02] or touched[:1]
    elif verdict == "unexplained":
        guilty = sorted((o for o, v in left.items() if v.real), key=lambda o: (-left[o].ratio, o))
        guilty = guilty or [max(left, key=lambda o: (left[o].ratio, o))]
    else:
        guilty = []
    depends: list[DependsOn] = []
    memory_p = 1.0
    seen: set[tuple[str, str]] = set()
    for o in guilty:
        if verdict == "unexplained":
            found, mp = list(left[o].follows), left[o].memory_p
        else:
            found, mp = follow(problem, looked, o)
        memory_p = min(memory_p, mp)
        for d in found[:6]:
            if (verdict == "unexplained" or (d.p_value < 1e-3 and d.strength > 0.01)) and (
                d.signal,
                d.feature,
            ) not in seen:
                seen.add((d.signal, d.feature))
                depends.append(DependsOn(d.signal, d.feature, d.strength, d.p_value, d.memory))
    if verdict == "missing_physics":
        depends.sort(key=lambda d: -d.strength)
        depends = led_by_physics(problem, base, fitted, depends)
    span = windows(problem, looked, guilty) if guilty else []
    stage = ""
    if physics and verdict == "missing_physics":
        stage = physics[0].stage
    elif guilty:
        stage = guess_stage(twin.chain, depends)
    noise_filters = {o: fit_whitener(fitted.residual[o], stretches=problem.held_spans) for o in twin.outputs}
    screened = {
        (t.name, t.placed.effect.kind, t.placed.site, t.placed.target): (t.placed, t.candidate.starts)
        for t in selection.first
    }
    limits = detection(problem, base, effects, noise_filters, z=rule.z, gain=rule.gain, known=screened)
    held = problem.split.held_out_mask()[problem.index]
    rows = problem.held_rows
    simulated = lambda f: {o: problem.measured[o] - f.residual[o] for o in twin.outputs}  # noqa: E731
    return Report(
        recording=str(rec.path),
        twin=twin.kind,
        verdict=verdict,
        summary=summary(verdict, physics, guilty, depends, problem, base, fitted),
        location=Location(
            tuple(guilty),
            stage,
            tuple(Window(round(a, 9), round(b, 9)) for a, b in span),
            regime(problem, looked, guilty[0]) if guilty else "nowhere",
            tuple(depends[:6]),
        ),
        physics=tuple(physics),
        alternatives=tuple(runners),
        equivalent=tuple(groups),
        detection_limit=limits.limit,
        cannot_show=limits.cannot,
        fit=FitSummary(
            {o: twin.units[o] for o in twin.outputs},
            True,
            held_rms(official or problem, anew(official, raw)),
            held_rms(official or problem, anew(official, base)),
            held_rms(official or problem, anew(official, fitted)),
            {o: problem.floors[o].rms for o in twin.outputs},
            {o: problem.floors[o].method for o in twin.outputs},
            problem.split.fit,
            problem.split.held_out,
            tuple(base_shifts(problem, raw, base, fitted)),
        ),
        checks=Checks(
            all(ljung_box(base.residual[o][rows]) > 0.01 for o in twin.outputs),
            all(ljung_box(fitted.residual[o][rows]) > 0.01 for o in twin.outputs),
            p,
            tuple(said),
            memory_p,
        ),
        seconds=0.0,
        seed=problem.seed,
        chain=twin.chain,
        corrected_base=twin.to_text(fitted.theta[: Model(twin).n_base]),
        tested=tuple(
            {
                "name": t.name,
                "target": t.placed.target,
                "share": t.candidate.share,
                "p_value": t.candidate.p_value,
                "z": t.comparison.z if t.comparison else 0.0,
                "gain": t.comparison.gain if t.comparison else 0.0,
                "misfit": float(np.mean(list(t.misfits.values()))) if t.misfits else None,
            }
            for t in selection.first
        ),
        pictures=Pictures(
            rec.t[problem.index],
            held,
            problem.measured,
            simulated(raw),
            simulated(base),
            simulated(fitted),
            {s: x[problem.index] for s, x in rec.signals.items()},
            rec.unit,
        ),
    )


def led_by_physics(problem: Problem, base: Fit, fitted: Fit, depends: Sequence[DependsOn]) -> list[DependsOn]:
    """What the first named effect follows by its nature comes first: the context signal that it needs, time for what
    comes from outside, recorded signals for what these drive (slow motion goes with some course in time as well). Its
    strength is the share of the residual that the effects took.
    """
    first = fitted.model.placed[0]
    effect = first.effect
    context = [s for s in about(effect) if s in problem.recording.context]
    o = first.outputs[0]
    if not context and effect.name not in OF_THE_CLOCK:
        drive = problem.twin.drive(o) or problem.twin.inputs[0]
        moved = [d for d in depends if d.signal != "time"] or [DependsOn(drive, "value", 0.0)]
        return [*moved, *(d for d in depends if d.signal == "time")]
    signal, feature = (context[0], "value") if context else ("time", "time itself")
    lead = next((d for d in depends if d.signal == signal), None)
    if lead is None:
        share = 1 - compare_ratio(problem, fitted, o) / max(compare_ratio(problem, base, o), 1e-12)
        lead = DependsOn(signal, feature, max(share, 0.0))
    return [lead, *(d for d in depends if d is not lead)]


def anew(problem: Problem | None, fitted: Fit) -> Fit:
    """The same parameters simulated for another problem."""
    if problem is None:
        return fitted
    return replace(fitted, residual=residuals(problem, fitted.model, fitted.theta))


def guess_stage(chain: Sequence[str], depends: Sequence[DependsOn]) -> str:
    """A stage for what has no name: the environment for what follows context or time, else the middle."""
    if depends and depends[0].signal == "time" and "environment" in chain:
        return "environment"
    for s in ("actuator", "mechanics", "sensor"):
        if s in chain:
            return s
    return chain[0] if chain else ""


def summary(
    verdict: Verdict,
    physics: Sequence[PhysicsFound],
    guilty: Sequence[str],
    depends: Sequence[DependsOn],
    problem: Problem,
    base: Fit,
    fitted: Fit,
) -> str:
    """One sentence a bench engineer would say."""
    outputs = ", ".join(guilty)
    a, b = held_rms(problem, base), held_rms(problem, fitted)
    if verdict == "agrees":
        return "The recording is within its noise of the simulation as given."
    if verdict == "recalibrate":
        return "New base parameters explain the recording; no physics is missing."
    if verdict == "missing_physics":
        names = " and ".join(dict.fromkeys(p.name.replace("_", " ") for p in physics))
        o = physics[0].output
        factor, unit = scaled(max(a[o], b[o]), problem.twin.units[o])
        return (
            f"The simulation lacks {names} at the {physics[0].stage} ({outputs}): with it the held-out residual falls"
            f" from {number(factor * a[o])} to {number(factor * b[o])} {unit}."
        )
    what = f" and follows {depends[0].signal} ({depends[0].feature})" if depends else ""
    return f"Something is left in {outputs} that no known effect explains{what}."
