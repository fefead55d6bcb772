"""Converts a model to plain values and back: the ``[twin]`` table of a corrected twin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast, get_args

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Array, Effect, Settings, Stage
from tools.errors import RecordingError, refuse_unknown_keys
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.cascade import between_of
from tools.mismatch.twins.core import core
from tools.mismatch.twins.feedback import FASTEST
from tools.numbers import is_finite_number

EFFECT_KEYS = ("name", "equation", "site", "target", "stage", "outputs", "settings", "parameters")
"""Keys of one of the ``[[twin.effects]]``."""


def describe(model: Model, theta: Array) -> dict[str, Any]:
    """Return the ``[twin]`` table: kind, parameters under the contract's names, one table per effect."""
    effects: list[dict[str, Any]] = []
    for k, pl in enumerate(model.placed):
        a, b = model.slices(k)
        values = [*theta[a].tolist(), *theta[b].tolist()]
        names = [p.name for p in (*pl.parts.nonlinear, *pl.parts.weights)]
        effects.append(
            {
                "name": pl.effect.name,
                "equation": pl.effect.equation,
                "site": pl.site,
                "target": pl.target,
                "stage": pl.stage,
                "outputs": list(pl.outputs),
                "settings": {n: list(v) for n, v in pl.settings.items()},
                "parameters": dict(zip(names, values, strict=True)),
            }
        )
    return {"kind": model.twin.kind, "parameters": model.base_text(theta), "effects": effects}


def restore(recording: Recording) -> tuple[Model, Array]:
    """Return the model of a recording's ``[twin]``, effects included, and its parameters.

    Raises RecordingError that names the effect and key that cannot be used.
    """
    twin = core(recording)
    placed: list[Placed] = []
    values: list[Array] = []
    for i, entry in enumerate(recording.twin.effects):
        where = f"{recording.path}: [[twin.effects]] {i + 1}"
        pl, p = _one(where, entry, twin)
        placed.append(pl)
        values.append(p)
    model = Model(twin, placed)
    theta = model.start(recording)
    for k, p in enumerate(values):
        a, b = model.slices(k)
        theta[a], theta[b] = p[: a.stop - a.start], p[a.stop - a.start :]
    return model, theta


def _one(where: str, entry: Mapping[str, Any], twin: Twin) -> tuple[Placed, Array]:
    refuse_unknown_keys(f"{where}:", entry, EFFECT_KEYS)
    name, site = entry.get("name"), entry.get("site", "output")
    effect = EFFECTS.get(name) if isinstance(name, str) else None
    if effect is None:
        raise RecordingError(f"{where}: name '{name}' is not in the vocabulary; see 'micron mismatch physics'")
    given = entry.get("parameters", {})
    if not isinstance(given, Mapping):
        raise RecordingError(f"{where}: parameters must be a table")
    stage = entry.get("stage", effect.stages[0])
    if stage not in get_args(Stage):
        raise RecordingError(f"{where}: stage must be one of {', '.join(get_args(Stage))}, got {stage!r}")
    target = str(entry.get("target", ""))
    outputs = entry.get("outputs", [target])
    if not isinstance(outputs, Sequence) or not outputs or any(o not in twin.outputs for o in outputs):
        raise RecordingError(f"{where}: outputs {outputs!r} are not among {', '.join(twin.outputs)}")
    if site == "input" and target not in (*twin.inputs, between_of(twin)):
        raise RecordingError(f"{where}: target '{target}' is not an input of the twin")
    try:
        settings = {k: tuple(float(x) for x in v) for k, v in dict(entry.get("settings", {})).items()}
    except (TypeError, ValueError):
        raise RecordingError(f"{where}: settings must be lists of numbers") from None
    fastest = settings.get(FASTEST, (0.0,))
    if not np.all(np.isfinite([x for v in settings.values() for x in v])) or not fastest or fastest[0] < 0.0:
        raise RecordingError(f"{where}: settings must be finite numbers, and {FASTEST} one that is not negative")
    effect = _variant(where, effect, site, settings, given, entry.get("equation"))
    pl = Placed(effect, site, target, cast(Stage, stage), tuple(outputs), settings)
    parameters = (*pl.parts.nonlinear, *pl.parts.weights)
    # a file of an earlier version may lack a parameter that has a value without influence
    values = {p.name: given.get(p.name, p.away) for p in parameters}
    missing = [n for n, v in values.items() if not is_finite_number(v)]
    if missing:
        raise RecordingError(f"{where}: parameters {', '.join(missing[:5])} missing or not finite numbers")
    refuse_unknown_keys(f"{where}: parameters:", given, values)
    return pl, np.array([float(v) for v in values.values()])


def _variant(
    where: str, effect: Effect, site: object, settings: Settings, given: Mapping[str, Any], equation: object
) -> Effect:
    """Return the form of an effect with this ``equation``, or, in files without one, by site and parameters."""
    if site not in ("input", "output", "feedback"):
        raise RecordingError(f"{where}: site must be input, output or feedback, got {site!r}")
    forms = [e for e in (effect, *effect.variants) if (e.kind == "feedback") == (site == "feedback")]
    if not forms:
        raise RecordingError(f"{where}: {effect.name} cannot sit at '{site}'")
    forms = [e for e in forms if e.equation == equation] or forms
    try:
        parts = [e.parts(settings) for e in forms]
    except (KeyError, IndexError, ValueError) as error:
        raise RecordingError(f"{where}: settings do not fit {effect.name} ({error!r})") from None
    fitting = [
        e for e, p in zip(forms, parts, strict=True) if {q.name for q in (*p.nonlinear, *p.weights)} == set(given)
    ]
    return fitting[0] if fitting else forms[0]
