"""Assembles the report from the results of the search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hal.arrays import Array
from tools.mismatch.engine.checks import first_look
from tools.mismatch.engine.colour import fit_whitener, ljung_box
from tools.mismatch.engine.exported import raw_values, without_events
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.found import physics_found, values_of_forms
from tools.mismatch.engine.identifiability import LeastNamed, detection
from tools.mismatch.engine.intervals import uncertainty
from tools.mismatch.engine.locate import follow, regime, windows
from tools.mismatch.engine.many import compare_recordings
from tools.mismatch.engine.one_way import one_way
from tools.mismatch.engine.pose import Ended, Posed
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.reach import imitable, much_left, not_tried, out_of_reach, tempered
from tools.mismatch.engine.report import (
    BaseShift,
    Checks,
    DependsOn,
    FitSummary,
    Location,
    ParameterValue,
    PhysicsFound,
    Pictures,
    Report,
    Window,
    Withheld,
)
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.unexplained import Leftover, about
from tools.mismatch.engine.verdict import OF_THE_CLOCK, Decision, compare_ratio, within_tolerance
from tools.mismatch.engine.workers import mapped
from tools.mismatch.report.wording import number, scaled
from tools.mismatch.simulate import Model
from tools.mismatch.twins.ode import inside_of


def base_shifts(raw: Fit, base: Fit, fitted: Fit, deviations: Array) -> list[BaseShift]:
    """Return the shift of the base parameters by the missing effects."""
    shifts: list[BaseShift] = []
    for i in range(base.model.n_base):
        p = base.model.parameters[i]
        half = 1.96 * float(deviations[i])
        v = float(fitted.theta[i])
        shifts.append(BaseShift(p.name, p.unit, float(raw.theta[i]), float(base.theta[i]), v, (v - half, v + half)))
    return shifts


def human_shifts(raw: Fit, base: Fit, found: Mapping[str, ParameterValue]) -> list[BaseShift]:
    """Return ``base_shifts`` under the names and units of the twin's file."""
    given, alone = ({h.name: float(h.value) for h in fit.model.human(fit.theta)["base"]} for fit in (raw, base))
    return [
        BaseShift(name, v.unit, given[name], alone[name], v.value, v.ci95)
        for name, v in found.items()
        if name in given and name in alone
    ]


def assemble(
    posed: Posed, ended: Ended, screened: Sequence[Trial], left: dict[str, Leftover], *, decision: Decision,
    sure: Mapping[str, float], least: LeastNamed, withheld: Sequence[Withheld] = (), jobs: int = 1,
) -> Report:  # fmt: skip
    """Assemble the report of the contract.

    ``screened``: the candidates beside the base; ``sure``: the probability per name; ``withheld``: effects that are not
    named.
    """
    problem, raw, base, fitted = posed.problem, posed.raw, ended.base, ended.fitted
    rec, twin, official = problem.recording, problem.twin, ended.official
    verdict = decision.verdict
    unsure = uncertainty(problem, fitted)
    shifts = base_shifts(raw, base, fitted, unsure.deviations())
    values = values_of_forms(problem, fitted, unsure, ended.forms)
    physics = physics_found(problem, base, fitted, values, sure)
    exported = without_events(problem, fitted)
    raws = raw_values(exported)
    labels = [p.label for p in fitted.model.placed]
    physics = [replace(f, raw=raws.get(label, f.raw)) for f, label in zip(physics, labels, strict=True)]
    off = imitable(physics, twin)
    if inside_of(twin) is not None and much_left(physics, {o: hi for o, (_, hi) in decision.floors.items()}):
        # an incomplete account limits the probability of its names
        physics = tempered(physics)
    physics = [tempered([f])[0] if it else f for f, it in zip(physics, off, strict=True)]
    if (off and all(off)) or out_of_reach(physics, twin, {o: hi for o, (_, hi) in decision.floors.items()}):
        verdict, physics = "unexplained", tempered(physics)
        decision = replace(decision, verdict=verdict, meaning=decision.meaning or "place_not_reachable")
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
    if verdict == "unexplained":
        followed = [(list(left[o].follows), left[o].memory_p) for o in guilty]
    else:
        followed = mapped(problem, follow, [(problem, looked, o) for o in guilty], jobs)
    for found, mp in followed:
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
    span = windows(problem, looked, guilty, {o: hi for o, (_, hi) in decision.floors.items()}) if guilty else []
    stage = ""
    if physics and verdict == "missing_physics":
        stage = physics[0].stage
    elif guilty:
        stage = guess_stage(twin.chain, depends)
    noise_filters = {o: fit_whitener(fitted.residual[o], stretches=problem.held_spans) for o in twin.outputs}
    known = {
        (t.name, t.placed.effect.kind, t.placed.site, t.placed.target): (t.placed, t.candidate.starts) for t in screened
    }
    limits = detection(problem, base, posed.effects, noise_filters, least, known=known)
    held = problem.split.held_out_mask()[problem.index]
    rows = problem.held_rows
    simulated = lambda f: {o: problem.measured[o] - f.residual[o] for o in twin.outputs}  # noqa: E731
    return Report(
        recording=str(rec.path),
        twin=twin.kind,
        verdict=verdict,
        summary=summary(decision, physics, guilty, depends, problem, (base, fitted)),
        location=Location(
            tuple(guilty),
            stage,
            tuple(Window(round(a, 9), round(b, 9)) for a, b in span),
            regime(problem, looked, guilty[0]) if guilty else "nowhere",
            tuple(depends[:6]),
        ),
        physics=tuple(physics),
        alternatives=(),
        equivalent=(),
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
            tuple(shifts),
            decision.floors,
            dict(rec.tolerance),
            {o: rec.file_unit[o] for o in twin.outputs if rec.file_unit[o] != twin.units[o]},
            tuple(human_shifts(raw, base, values["base"])),
        ),
        checks=Checks(
            all(ljung_box(base.residual[o][rows]) > 0.01 for o in twin.outputs),
            all(ljung_box(fitted.residual[o][rows]) > 0.01 for o in twin.outputs),
            decision.p_value,
            tuple(first_look(posed.recording, posed.raw.model, posed.raw.theta)),
            memory_p,
        ),
        seconds=0.0,
        seed=problem.seed,
        chain=twin.chain,
        corrected_base=exported.model.base_text(exported.theta),
        corrected_parameters=tuple(float(v) for v in exported.theta[: Model(twin).n_base]),
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
            for t in screened
        ),
        withheld=tuple(withheld),
        meaning=decision.meaning,
        trouble=decision.trouble,
        doubtful=decision.doubtful,
        hold=posed.holds,
        one_way=one_way(problem, fitted, shifts),
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
        not_tried=not_tried(twin),
    )


def conclude(
    posed: Posed, ended: Ended, screened: Sequence[Trial], left: dict[str, Leftover], *, decision: Decision,
    sure: Mapping[str, float], least: LeastNamed, withheld: Sequence[Withheld] = (), jobs: int = 1,
) -> Report:  # fmt: skip
    """Return the report of a finished search; ``screened``: the candidates beside the base; ``sure``: per name."""
    report = assemble(
        posed, ended, screened, left, decision=decision, sure=sure, least=least, withheld=withheld, jobs=jobs
    )
    if posed.recording.parts:
        # recordings are compared under the model of the named effects only
        named = ended.fitted if report.physics else ended.base
        report = replace(report, together=compare_recordings(posed.problem, ended.base, named, jobs))
    return report


def led_by_physics(problem: Problem, base: Fit, fitted: Fit, depends: Sequence[DependsOn]) -> list[DependsOn]:
    """Order the followed signals so that the one which the first named effect follows by its nature comes first.

    This is the context signal that it needs, time for an addition from outside, or recorded signals for an effect that
    they drive (slow motion also correlates with time). Its strength is the share of the residual that the effects
    explain.
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
    """Return the same parameters simulated for another problem."""
    if problem is None:
        return fitted
    return replace(fitted, residual=residuals(problem, fitted.model, fitted.theta))


def guess_stage(chain: Sequence[str], depends: Sequence[DependsOn]) -> str:
    """Return the stage of an unnamed rest: the environment if it follows context or time, else the middle."""
    if depends and depends[0].signal == "time" and "environment" in chain:
        return "environment"
    for s in ("actuator", "mechanics", "sensor"):
        if s in chain:
            return s
    return chain[0] if chain else ""


def summary(
    decision: Decision,
    physics: Sequence[PhysicsFound],
    guilty: Sequence[str],
    depends: Sequence[DependsOn],
    problem: Problem,
    fits: tuple[Fit, Fit],
) -> str:
    """Summarise the answer in a sentence for a bench engineer, and a large rest in a second one.

    ``fits``: the twin alone and with the physics.
    """
    base, fitted = fits
    verdict, outputs = decision.verdict, ", ".join(guilty)
    a, b = held_rms(problem, base), held_rms(problem, fitted)
    if verdict == "agrees":
        if problem.recording.tolerance and all(within_tolerance(problem, base).values()):
            return "The recording is within the declared tolerance of the simulation as given."
        return "The recording is within its noise of the simulation as given." + if_noise(decision, problem, b)
    if verdict == "recalibrate":
        return "New base parameters explain the recording; no physics is missing." + if_noise(decision, problem, b)
    if verdict == "missing_physics":
        o = physics[0].output
        text = (
            f"The simulation lacks {_names_of(physics)} at the {physics[0].stage} ({outputs}): with it the held-out"
            f" residual {_fall(problem, o, a, b)}."
        )
        times = b[o] / max(decision.floors[o][1], 1e-300)
        if times > MUCH_LEFT and b[o] > problem.recording.tolerance.get(o, 0.0):
            text += f" That is still {number(times)} times the noise: it is not the whole account."
        return text
    if decision.meaning == "place_not_reachable" and physics and all(imitable(physics, problem.twin)):
        least = ", down to the noise," if all(b[o] <= MUCH_LEFT * decision.floors[o][1] for o in guilty) else ""
        return (
            f"What {_names_of(physics)} explains of {outputs}{least} may also be a wrong parameter of the simulation"
            " that made the columns."
        )
    what = f" and follows {depends[0].signal} ({depends[0].feature})" if depends else ""
    part = (
        f" With {_names_of(physics)} the held-out residual {_fall(problem, physics[0].output, a, b)}."
        if physics
        else ""
    )
    if decision.meaning == "floor_doubtful":
        return f"Something may be left in {outputs}{what}; whether it is noise this recording does not say.{part}"
    if decision.meaning == "fit_failed":
        return f"Something is left in {outputs}{what}, but the fit failed: {decision.trouble[0]}.{part}"
    return f"Something is left in {outputs} that no known effect explains{what}.{part}"


def _names_of(physics: Sequence[PhysicsFound]) -> str:
    return " and ".join(dict.fromkeys(p.name.replace("_", " ") for p in physics))


def _fall(problem: Problem, output: str, before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """Return from what and to what the held-out residual of an output falls, with its unit."""
    largest = max(before[output], after[output])
    factor, unit = scaled(largest, problem.twin.units[output], problem.recording.file_unit[output])
    return f"falls from {number(factor * before[output])} to {number(factor * after[output])} {unit}"


def if_noise(decision: Decision, problem: Problem, left: Mapping[str, float]) -> str:
    """Return the condition of a verdict without physics where it rests on the upper end of a noise floor; else ""."""
    if not decision.doubtful:
        return ""
    o = max(decision.doubtful, key=lambda o: left[o] / max(decision.floors[o][0], 1e-300))
    factor, unit = scaled(left[o], problem.twin.units[o], problem.recording.file_unit[o])
    return (
        f" That holds if all of the {number(factor * left[o])} {unit} that are left of {o} are noise; the spectrum"
        f" vouches for {number(factor * decision.floors[o][0])}."
    )


MUCH_LEFT = 2.0
"""Ratio of the rest to the upper end of the noise floor above which the summary mentions the rest."""
