"""Turns a report into a corrected twin: a ``[twin]`` table with re-fitted base parameters and the effects found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from tools.errors import InputError, RecordingError
from tools.mismatch.recording import Recording, TwinText
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_text import describe, restore
from tools.mismatch.twins.fmu import with_equations
from tools.mismatch.twins.make import make
from tools.toml_text import toml_text

EVENTS = ("spikes", "step_shift", "random_walk", "dropped_samples")
"""Effects that are events of one recording. They do not recur at the same time and are not part of a twin."""


@dataclass(frozen=True)
class Corrected:
    """Holds the ``text`` of the twin file, its ``effects`` in order, and ``notes`` on omissions with their reasons.

    ``recording`` has the corrected base, ``model`` the effects placed in it, and ``theta`` is its parameter vector.
    """

    kind: str
    text: str
    effects: tuple[str, ...]
    notes: tuple[str, ...]
    recording: Recording
    model: Model
    theta: np.ndarray


def corrected_twin(path: Path, report: Mapping[str, Any]) -> Corrected:
    """Build the twin file for a recording from the JSON report of its diagnosis.

    Raises InputError for a report that is not one or belongs to another recording, RecordingError for the recording.
    """
    recording = with_equations(load(path))
    found = _physics(report)
    check_outputs(recording, report)
    base = dict(report["corrected_base"])
    before = list(base.pop("effects", []))
    kept = [p for p in found if p["name"] not in EVENTS]
    notes = [f"{p['name']} is an event of that recording and no part of the twin" for p in found if p["name"] in EVENTS]
    notes += _other_recording(recording.path, report.get("recording"))
    effects = [*before, *report_effects(kept)]
    with_effects = replace(recording, twin=TwinText(recording.twin.kind, base, tuple(effects)))
    try:
        model, theta = restore(with_effects)
    except RecordingError as error:
        raise InputError(
            f"the report does not fit the recording: {error}; check [twin.parameters] and diagnose the recording again"
        ) from error
    theta = _same_weight(recording, report, model, theta)
    table = describe(model, theta)
    head = (
        f"# Corrected twin of {recording.path}: {report['verdict']}.\n# Refer to it from a recording: [twin] file = ..."
    )
    return Corrected(
        recording.twin.kind,
        f"{head}\nformat = 1\n\n{twin_toml(table)}",
        tuple(str(e["name"]) for e in table["effects"]),
        tuple(notes),
        with_effects,
        model,
        theta,
    )


def _physics(report: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    if report.get("format") != 1:
        raise InputError(f"the report has format {report.get('format')!r}, expected 1; run diagnose --json again")
    missing = [k for k in ("verdict", "physics", "fit", "twin", "corrected_base") if k not in report]
    if missing:
        raise InputError(f"the report has no {', '.join(missing)}; give the whole JSON that diagnose wrote")
    found = report["physics"]
    if not isinstance(found, list) or not isinstance(report["corrected_base"], Mapping):
        raise InputError(
            "the report was changed by hand: its physics or corrected_base has another form; run diagnose --json again"
        )
    for i, p in enumerate(found):
        where = f"the report's physics {i + 1}"
        if not isinstance(p, Mapping) or not isinstance(p.get("name"), str):
            raise InputError(f"{where} has no name; give the JSON that diagnose wrote")
        if p["name"] not in EFFECTS:
            raise InputError(f"{where}: '{p['name']}' is not in the vocabulary; see 'micron mismatch physics'")
        absent = [k for k in ("site", "target", "stage", "outputs", "settings", "raw") if k not in p]
        if absent:
            raise InputError(f"{where} ({p['name']}) has no {', '.join(absent)}; give the JSON that diagnose wrote")
    return found


def check_report(recording: Recording, report: Mapping[str, Any]) -> None:
    """Raise InputError if the JSON is not the report of a diagnosis, or if it belongs to another recording or twin."""
    _physics(report)
    check_outputs(recording, report)


def check_outputs(recording: Recording, report: Mapping[str, Any]) -> None:
    """Raise InputError if twin or outputs of a report are not those of a recording."""
    if report["twin"] != recording.twin.kind:
        raise InputError(
            f"the report is of a {report['twin']} and {recording.path} of a {recording.twin.kind};"
            " give the report of this recording"
        )
    fit = report["fit"]
    unit = fit.get("unit") if isinstance(fit, Mapping) else None
    outputs = set(unit) if isinstance(unit, Mapping) else set[str]()
    if outputs != set(recording.outputs):
        reported, have = ", ".join(sorted(outputs)) or "none", ", ".join(recording.outputs)
        raise InputError(
            f"the report's outputs ({reported}) are not those of {recording.path} ({have});"
            " give the report of this recording"
        )


def _other_recording(path: Path, named: object) -> list[str]:
    """Return a note if a report names another recording than ``path``; a folder that was moved is the same one."""
    parts = [part for part in Path(named).parts if part not in (".", "..")] if isinstance(named, str) else []
    same = min(len(parts), 2)  # the file, and its folder if the report names it
    if not parts or list(path.resolve().parts[-same:]) == parts[-same:]:
        return []
    return [f"the report names the recording {named}, and this is {path}; its figures are taken as they are"]


def report_effects(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the physics of a report as effects of a ``[twin]`` table."""
    return [_entry(p) for p in found]


def _entry(p: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("name", "equation", "site", "target", "stage", "outputs", "settings")
    return {**{k: p[k] for k in keys if k in p}, "parameters": p["raw"]}


def _same_weight(recording: Recording, report: Mapping[str, Any], model: Model, theta: np.ndarray) -> np.ndarray:
    """Rescale the weights of effects in front of the base physics, which carry its input gain (``Twin.input_gain``).

    A twin that is written and read again may have other state coordinates and hence another gain; the effect must stay
    the same.
    """
    try:
        shifts = {str(b["name"]): float(b["with_effects"]) for b in report["fit"].get("base_parameters", [])}
        exported = [float(v) for v in report.get("corrected_parameters") or ()]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the report was changed by hand: a figure of its parameters is missing or no number ({error!r});"
            " run diagnose --json again"
        ) from None
    old = make(recording)
    if set(shifts) != {p.name for p in old.parameters}:
        return theta
    fitted = np.array(exported or [shifts[p.name] for p in old.parameters])
    theta = theta.copy()
    for k, placed in enumerate(model.placed):
        if placed.site == "output":
            continue
        signal = placed.target if placed.site == "input" else model.twin.inputs[0]
        was, now = old.input_gain(signal, fitted), model.twin.input_gain(signal, theta[: model.n_base])
        if was != 0.0:
            theta[model.slices(k)[1]] *= now / was
    return theta


def twin_toml(table: Mapping[str, Any]) -> str:
    """Return the ``[twin]`` table as TOML. Raises ``InputError`` for a figure that is not finite."""
    _require_finite(table)
    return toml_text({"twin": table})


def _require_finite(value: Any) -> None:
    for inner in value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ():
        _require_finite(inner)
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"the report holds {value}, which no twin can use; diagnose the recording again")
