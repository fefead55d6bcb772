"""Implements ``micron mismatch plan``: the distinguishable effects, and the input that separates equivalent ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.errors import InputError
from tools.mismatch import units
from tools.mismatch.apply import check_report
from tools.mismatch.plan import structure
from tools.mismatch.plan.design import Plan, Progress, design
from tools.mismatch.plan.limits import Limits, Wish, limits_json, settle_limits
from tools.mismatch.plan.models import Rival
from tools.mismatch.plan.rivals import groups_of, noise_of, rivals_of
from tools.mismatch.plan.separable import Separable, channel_gains, separable
from tools.mismatch.plan.situation import Situation, situation

STACKS = (1, 2, 3)
"""Stacks of a bench."""


@dataclass(frozen=True)
class Asked:
    """Holds the options of the command line. ``inputs``: signals to be designed (none: all)."""

    wish: Wish = field(default_factory=Wish)
    inputs: tuple[str, ...] = ()
    noise: float | None = None
    rate_hz: float | None = None
    size: float = 3.0
    evaluations: int = 80
    seed: int = 0
    bench: Mapping[str, float] | None = None
    stacks: tuple[int, ...] = ()
    """Stacks of the bench (1 to 3) that the planned inputs move; none: all for one input, else one for each."""


@dataclass(frozen=True)
class Prospect:
    """Holds the effects that could be distinguished before anything more is recorded.

    ``channels``: for each context channel that is not recorded, the effects that could be named with it; ``places``:
    groups of places that structure cannot split, with the unknowns that would.
    """

    where: Situation
    limits: Mapping[str, Limits]
    sigma: Mapping[str, float]
    found: Separable
    channels: Mapping[str, tuple[str, ...]]
    places: Mapping[tuple[str, ...], tuple[str, ...]]
    isolable: tuple[tuple[str, ...], ...]

    def to_json(self) -> dict[str, Any]:
        """Return the JSON of the command."""
        unit = self.where.template.unit
        found = {"shown" if k == "visible" else k: v for k, v in asdict(self.found).items()}
        return {
            "format": 1,
            "twin": str(self.where.path),
            "limits": {s: limits_json(box) for s, box in self.limits.items()},
            "noise_rms": {o: {"value": v, "unit": unit[o]} for o, v in self.sigma.items()},
            **found,
            "channels": {s: list(names) for s, names in self.channels.items()},
            "structure": {
                "groups": [list(g) for g in self.isolable],
                "split_by": [{"group": list(g), "sensors": list(s)} for g, s in self.places.items()],
            },
        }


@dataclass(frozen=True)
class Designed:
    """Holds a plan for a group of equivalent effects."""

    where: Situation
    group: tuple[str, ...]
    rivals: tuple[Rival, ...]
    sigma: Mapping[str, float]
    plan: Plan
    stacks: tuple[int, ...] = ()
    """Stacks of the bench that the inputs move, in their order; none without a bench."""

    def to_json(self) -> dict[str, Any]:
        """The JSON of the command."""
        p = self.plan
        return {
            "format": 1,
            "twin": str(self.where.path),
            "group": list(self.group),
            "rivals": [r.name for r in self.rivals],
            "input": p.description,
            "limits": {s: limits_json(box) for s, box in p.limits.items()},
            "separation_sd": p.separation,
            "random_multisine_sd": p.random_separation,
            "pairs_sd": dict(p.pairs),
            "inputs_tried": p.evaluations,
        }


def open_situation(path: Path, asked: Asked) -> Situation:
    """Return the situation of the command line; the stated noise is used for channels that declare none."""
    where = situation(path, asked.noise, asked.rate_hz)
    if asked.noise is None:
        return where
    rec = where.template
    noise = {o: v if v is not None else asked.noise for o, v in rec.noise.items()}
    return replace(where, template=replace(rec, noise=noise))


def limits_of(where: Situation, asked: Asked) -> dict[str, Limits]:
    """Return the limits of every input to be designed, in the twin's units."""
    rec = where.template
    unknown = [s for s in asked.inputs if s not in rec.inputs]
    if unknown:
        raise InputError(f"--input {unknown[0]}: {where.path} has no such input; it has {', '.join(rec.inputs)}")
    signals = asked.inputs or tuple(rec.inputs)
    if len({rec.unit[s] for s in signals}) > 1 and (asked.wish.amplitude or asked.wish.rate_per_s or asked.wish.rms):
        raise InputError(f"{where.path}: its inputs have different units; name one with --input")
    if asked.bench is not None and all(rec.unit[s] != "V" for s in signals):
        raise InputError(f"{where.path}: none of its inputs is in V, and the outputs of a bench are; leave --bench out")
    out: dict[str, Limits] = {}
    for s in signals:
        wish = _in_twin_units(asked.wish, rec.file_unit[s], rec.unit[s])
        course = rec.inputs[s] if where.recorded else None
        bench = asked.bench if rec.unit[s] == "V" else None
        out[s] = settle_limits(wish, rec.unit[s], where.dt, course, str(where.path), bench)
    return out


def _in_twin_units(wish: Wish, given: str, to: str) -> Wish:
    def size(v: float | None) -> float | None:
        return None if v is None else units.convert_difference(v, given, to)

    centre = None if wish.centre is None else float(units.convert(np.array([wish.centre]), given, to)[0])
    sizes = {"amplitude": size(wish.amplitude), "rate_per_s": size(wish.rate_per_s), "rms": size(wish.rms)}
    return replace(wish, **sizes, centre=centre)


def prospect(path: Path, asked: Asked) -> Prospect:
    """Return the effects that the twin's channels could distinguish. Raises InputError or RecordingError on a fault."""
    where = open_situation(path, asked)
    limits = limits_of(where, asked)
    sigma = {o: where.noise(o, {}) for o in where.template.outputs}
    as_recorded = where.recorded and asked.wish == Wish() and not asked.inputs
    given = dict(where.template.inputs) if as_recorded else None
    found = separable(where, limits, sigma, size=asked.size, given=given, seed=asked.seed)
    shape = structure.structure_of(where.template)
    return Prospect(
        where,
        limits,
        sigma,
        found,
        channel_gains(where, limits, sigma, size=asked.size, seed=asked.seed),
        structure.splitting_sensors(shape),
        tuple(structure.groups(shape)),
    )


def stacks_of(where: Situation, signals: Sequence[str], asked: Asked) -> tuple[int, ...]:
    """Return the stacks that a program moves: those of ``asked``, else all for one input and one for each of several.

    Raises InputError for inputs that are not voltages, and if there is not one stack for each of several inputs.
    """
    unit = where.template.unit
    volts = [s for s in signals if unit[s] == "V"]
    if len(volts) < len(signals):
        other = next(s for s in signals if unit[s] != "V")
        raise InputError(
            f"{where.path}: a program plays volts, and {other} is in {unit[other]};"
            f" add --input {' --input '.join(volts)}"
        )
    if len(signals) == 1:
        return asked.stacks or STACKS
    stacks = asked.stacks or STACKS[: len(signals)]
    if len(stacks) != len(signals) or len(set(stacks)) < len(stacks):
        raise InputError(
            f"{where.path}: {len(signals)} inputs are planned ({', '.join(signals)}), and each moves a stack of its"
            " own; give as many different --stack, or fewer --input"
        )
    return stacks


def plan_for(path: Path, report: Mapping[str, Any], asked: Asked, progress: Progress | None = None) -> Designed:
    """Design the input that splits the first group of a report that can be fitted. Raises InputError without one."""
    where = open_situation(path, asked)
    limits = limits_of(where, asked)
    stacks = stacks_of(where, tuple(limits), asked) if asked.bench is not None else ()
    floors = noise_of(report)
    sigma = {o: where.noise(o, floors) for o in where.template.outputs}
    check_report(where.template, report)
    groups = groups_of(report)
    if not groups:
        raise InputError(
            f"{path}: the report names nothing that is equivalent to something else, so there is nothing to split; "
            "leave --report out to see what this recording could tell apart"
        )
    for group in groups:
        rivals = rivals_of(where, report, group, sigma)
        if len(rivals) > 1:
            found = design(
                where, rivals, limits, sigma, evaluations=asked.evaluations, seed=asked.seed, progress=progress
            )
            return Designed(where, group, tuple(rivals), sigma, found, stacks)
    raise InputError(f"{path}: none of the equivalent effects could be fitted to this recording; diagnose it again")


def words(names: Sequence[str]) -> str:
    """Return names of effects for people."""
    return ", ".join(n.replace("_", " ") for n in names)
