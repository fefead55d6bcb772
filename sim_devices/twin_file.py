"""A corrected twin (``micron mismatch apply``) read back: the emulated bench runs what a diagnosis found.

The file holds a ``[twin]`` table: kind, base parameters under the contract's names, and per effect its place, settings
and parameters. Twins without memory in their base physics can be run here: ``piezo_stack``, ``accelerometer``,
``magnetometer``. The effects are those of ``sim_devices.physics``, the same code that the diagnosis fitted.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.errors import BenchError
from hal.toml_file import parse_toml, read_text
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import STAGES, Array, Context, Effect, Settings

KINDS = {
    "piezo_stack": ("offset_um", "gain_um_per_V", ""),
    "accelerometer": ("bias_V", "scale_V_per_g", "specific_force"),
    "magnetometer": ("bias_V", "scale_V_per_uT", "field"),
}


@dataclass(frozen=True)
class PlacedEffect:
    """Holds one fitted effect with its parameters ``q`` (searched) and ``weights``."""

    effect: Effect
    site: str
    target: str
    stage: str
    outputs: tuple[str, ...]
    settings: Settings
    q: Array
    weights: Array


@dataclass(frozen=True)
class FileTwin:
    """``run`` gives what the corrected twin measures without noise. ``base[output]``: offset and scale."""

    kind: str
    path: Path
    base: Mapping[str, tuple[float, float]]
    effects: tuple[PlacedEffect, ...]

    def drive(self, output: str) -> str:
        """The input that an output follows."""
        prefix = KINDS[self.kind][2]
        return f"{prefix}_{output[-1]}" if prefix else "command"

    def run(self, dt: float, signals: Mapping[str, Array], begin_s: float = 0.0) -> dict[str, Array]:
        """Outputs (n,) in the contract's units for inputs and context signals (n,), from rest at the first sample.

        ``begin_s``: time of the first sample, for what ages (warm-up). BenchError names a signal that an effect needs
        and ``signals`` does not have.
        """
        n = next(iter(signals.values())).size
        t = np.asarray(begin_s + np.arange(n) * dt, np.float64)
        inputs = dict(signals)
        for output in self.base:
            self._present(signals, self.drive(output), "the twin")
        ordered = sorted(self.effects, key=lambda e: STAGES.index(e.stage))  # pyright: ignore[reportArgumentType]
        for e in ordered:
            for name in e.effect.needs:
                self._present(signals, name, e.effect.name)
            if e.site == "input":
                ctx = self._context(t, dt, signals, e.target, e.outputs[0])
                inputs[e.target] = _pass(e, inputs[e.target], inputs[e.target], ctx)
        out = {o: offset + scale * inputs[self.drive(o)] for o, (offset, scale) in self.base.items()}
        for e in ordered:
            if e.site == "output":
                for o in e.outputs:
                    ctx = self._context(t, dt, signals, o, o)
                    out[o] = _pass(e, out[o], inputs[self.drive(o)], ctx)
        return out

    def _present(self, signals: Mapping[str, Array], name: str, who: str) -> None:
        if name not in signals:
            raise BenchError(f"{self.path}: {who} needs the signal '{name}', which is not there")

    def _context(self, t: Array, dt: float, signals: Mapping[str, Array], target: str, output: str) -> Context:
        facts = {"axis": (float("xyz".find(output[-1])),)} if "_" in output else {}
        return Context(t, dt, signals, target, output, self.drive(output), (0,), facts=facts)


def _pass(e: PlacedEffect, x: Array, drive: Array, ctx: Context) -> Array:
    if e.effect.kind in ("linear", "nonlinear"):
        assert e.effect.apply is not None
        return e.effect.apply(x, ctx, e.q, e.settings)
    assert e.effect.basis is not None
    return x + e.effect.basis(drive if e.effect.driven else x, ctx, e.q, e.settings) @ e.weights


def load_twin(path: Path) -> FileTwin:
    """The twin of a file that ``micron mismatch apply`` wrote. BenchError says what is wrong with it and where."""
    try:
        table = parse_toml(read_text(path, "name the file that `micron mismatch apply` wrote"), str(path)).get("twin")
    except tomllib.TOMLDecodeError as error:
        raise BenchError(f"{path}: {error}") from error
    if not isinstance(table, Mapping) or table.get("kind") not in KINDS:
        raise BenchError(f"{path}: no [twin] that a bench can run; its kind must be one of {', '.join(KINDS)}")
    entries = table.get("effects", [])
    if not isinstance(entries, list):
        raise BenchError(f"{path}: [[twin.effects]] must be tables")
    effects = tuple(_effect(f"{path}: [[twin.effects]] {i + 1}", entry) for i, entry in enumerate(entries))
    outputs = _outputs(path, str(table["kind"]), table.get("parameters", {}), effects)
    return FileTwin(str(table["kind"]), path, outputs, effects)


def _outputs(path: Path, kind: str, parameters: Any, effects: Sequence[PlacedEffect]) -> dict[str, tuple[float, float]]:
    offset, scale, prefix = KINDS[kind]
    both: list[Mapping[str, Any]] = []
    for name in (offset, scale):
        value = parameters.get(name) if isinstance(parameters, Mapping) else None
        if isinstance(value, int | float):
            known = {o for e in effects for o in e.outputs}
            names = ["displacement"] if not prefix else sorted(known) or ["voltage_x"]
            value = dict.fromkeys(names, value)
        if not isinstance(value, Mapping) or not value or not all(_finite(v) for v in value.values()):
            raise BenchError(f"{path}: [twin.parameters] {name} must be a finite number, or one per output")
        both.append(value)
    if set(both[0]) != set(both[1]):
        raise BenchError(f"{path}: [twin.parameters] {offset} and {scale} name different outputs")
    return {o: (float(both[0][o]), float(both[1][o])) for o in both[0]}


def _effect(where: str, entry: Any) -> PlacedEffect:
    if not isinstance(entry, Mapping) or entry.get("name") not in EFFECTS:
        raise BenchError(f"{where}: no effect of the vocabulary (micron mismatch physics)")
    site, stage = entry.get("site", "output"), entry.get("stage")
    given, outputs = entry.get("parameters", {}), entry.get("outputs")
    if site not in ("input", "output") or stage not in STAGES:
        raise BenchError(f"{where}: site '{site}' or stage '{stage}' cannot be run here")
    if not isinstance(given, Mapping) or not isinstance(outputs, list) or not outputs:
        raise BenchError(f"{where}: parameters must be a table, outputs a list")
    family = EFFECTS[entry["name"]]
    try:
        settings = {str(k): tuple(float(x) for x in v) for k, v in dict(entry.get("settings", {})).items()}
        family_forms = [e for e in (family, *family.variants) if e.kind != "feedback"]
        same_form = [e for e in family_forms if e.equation == entry.get("equation")]
        forms = [(e, e.parts(settings)) for e in same_form or family_forms]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise BenchError(f"{where}: settings do not fit {family.name} ({error!r})") from error
    for effect, parts in forms:
        searched, weights = [p.name for p in parts.nonlinear], [p.name for p in parts.weights]
        if {*searched, *weights} == set(given) and all(_finite(v) for v in given.values()):
            q, w = (np.array([float(given[n]) for n in names]) for names in (searched, weights))
            return PlacedEffect(effect, site, str(entry.get("target", "")), stage, tuple(outputs), settings, q, w)
    raise BenchError(f"{where}: the parameters of {family.name} are not complete finite numbers")


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
