"""Builds rival models from a report with equivalent effects, each fitted to the recording of the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sim_devices.physics.catalogue import EFFECTS
from tools.errors import InputError, RecordingError
from tools.mismatch.apply import EVENTS, report_effects
from tools.mismatch.plan.models import Rival, best_rival, fitted_rival
from tools.mismatch.plan.situation import Situation, problem_of
from tools.mismatch.recording import TwinText
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_text import restore
from tools.mismatch.twins.make import make


def noise_of(report: Mapping[str, Any]) -> dict[str, float]:
    """Return the noise floors that a report states, by output."""
    fit = report.get("fit")
    floors = fit.get("noise_floor_rms", {}) if isinstance(fit, Mapping) else {}
    return {str(o): float(v) for o, v in floors.items() if isinstance(v, int | float) and v > 0}


def groups_of(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the groups of effects that a report could not distinguish, each with a named one first."""
    named = [str(p["name"]) for p in report.get("physics", [])]
    out: list[tuple[str, ...]] = []
    for entry in report.get("equivalent", []):
        names = [str(n) for n in entry.get("names", []) if n in EFFECTS]
        first = next((n for n in names if n in named), None)
        if first is not None and len(names) > 1:
            out.append((first, *(n for n in names if n != first)))
    return out


def rivals_of(
    where: Situation, report: Mapping[str, Any], group: tuple[str, ...], sigma: Mapping[str, float]
) -> list[Rival]:
    """Return the named model and, for each other effect of ``group``, the model with that one in its place.

    Raises InputError for a report of another twin, or if the recording has no samples to fit rivals to.
    """
    if not where.recorded:
        raise InputError(
            f"{where.path}: rivals are fitted to the recording of the report; give that recording, not a twin alone"
        )
    _same_twin(where, report)
    base = dict(report["corrected_base"])
    before = list(base.pop("effects", []))
    found = [p for p in report["physics"] if p["name"] not in EVENTS]
    text = TwinText(where.template.twin.kind, base, (*before, *report_effects(found)))
    recording = replace(where.template, twin=text)
    try:
        model, theta = restore(recording)
    except RecordingError as error:
        raise InputError(f"the report does not fit the recording: {error}") from error
    plain = replace(where.template, twin=TwinText(text.kind, base, tuple(before)))
    problem = problem_of(plain, sigma)
    if before:
        # the effects of an earlier correction are base physics of this problem
        raise InputError(f"{where.path}: its twin was corrected before; plan from the recording of the first diagnosis")
    out: list[Rival] = []
    rest = Model(problem.twin)
    begin = rest.carry(model, theta, problem.recording)
    # a report written by hand may leave the settings of effects out
    placed = [p if p.settings else prepare(rest, problem.fit_view, begin, p) for p in model.placed]
    first = fitted_rival(problem, group[0], placed, [theta])
    if first is not None:
        out.append(first)
    named = next(i for i, p in enumerate(model.placed) if p.effect.name == group[0])
    for name in group[1:]:
        rest = [p for i, p in enumerate(model.placed) if i != named]
        rival = best_rival(problem, Model(problem.twin, rest), model, theta, name)
        if rival is not None:
            out.append(rival)
    return out


def _same_twin(where: Situation, report: Mapping[str, Any]) -> None:
    """Raise InputError for a report of a twin with other given parameters than this one."""
    fit = report["fit"]
    reported = {str(b["name"]): float(b["given"]) for b in fit.get("base_parameters", [])}
    twin = make(where.template)
    given = dict(zip((p.name for p in twin.parameters), twin.start(where.template).tolist(), strict=False))
    if set(reported) != set(given):
        return  # a circuit that the diagnosis opened, or a state space in other coordinates
    for name, value in given.items():
        if abs(value - reported[name]) > 1e-6 * max(abs(value), abs(reported[name])) + 1e-12:
            raise InputError(
                f"the report is of another twin than {where.path}: its {name} was {reported[name]:g}, now {value:g}; "
                "diagnose this recording again"
            )
