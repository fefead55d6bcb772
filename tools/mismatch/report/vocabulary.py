"""Describes the vocabulary of physics for people: each effect's formula, parameters, source and excitation."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context, Effect
from tools.errors import InputError
from tools.mismatch.engine.unexplained import about
from tools.mismatch.report.equations import plain
from tools.mismatch.report.wording import words
from tools.terminal import pairs_of

UNITS = (
    "units: {in} and {out} are those of the twin's input and output; of what acts inside the equations, "
    "{out} is that of the state. Temperatures of a fourth power are absolute, also where a state is in degC"
)


@dataclass(frozen=True)
class Entry:
    """Describes an effect. ``equations``: TeX, one per place in the equations; ``parameters``: as in reports."""

    name: str
    summary: str
    stages: tuple[str, ...]
    acts: str
    equations: tuple[str, ...]
    parameters: tuple[tuple[str, str], ...]
    source: str
    excitation: str
    confusable_with: tuple[str, ...]
    needs: tuple[str, ...]
    twins: tuple[str, ...]


_ACTS = {
    "add": "adds to the signal",
    "linear": "filters the signal",
    "nonlinear": "maps the signal",
}
_INSIDE = {
    "motion": "adds a force on a body",
    "joint": "adds a force between two bodies",
    "storage": "adds a flow of what a state stores",
    "storages": "adds a flow of what a state stores",
    "state": "changes a parameter of the equations",
    "parameter": "changes a parameter of the equations",
    "direction": "changes a parameter of the equations",
}


def _acts(effect: Effect) -> list[str]:
    return [_INSIDE[a] for a in effect.acts_on] if effect.kind == "feedback" else [_ACTS[effect.kind]]


def entries(names: Collection[str] = ()) -> list[Entry]:
    """Return the effects ``names``, or all, in the contract's order. Raises InputError for an unknown one."""
    for name in names:
        if name not in EFFECTS:
            similar = get_close_matches(name, EFFECTS, 1)
            advice = f"write '{similar[0]}'" if similar else "'micron mismatch physics' lists them"
            raise InputError(f"no effect '{name}'; {advice}")
    return [_entry(e) for e in EFFECTS.values() if not names or e.name in names]


def _entry(effect: Effect) -> Entry:
    forms = (effect, *effect.variants)
    return Entry(
        effect.name,
        effect.summary,
        tuple(effect.stages),
        "; ".join(dict.fromkeys(a for f in forms for a in _acts(f))),
        tuple(dict.fromkeys(f.equation for f in forms)),
        _parameters(effect),
        effect.source,
        effect.excitation,
        effect.confusable_with,
        about(effect),
        effect.twins,
    )


def _parameters(effect: Effect) -> tuple[tuple[str, str], ...]:
    """Return names and units of an effect's parameters in reports.

    They are read from a synthetic example, since several effects choose their elements by the data.
    """
    t = np.arange(512, dtype=np.float64) * 0.01
    wave = np.sin(2 * np.pi * t / 1.7) + 0.3 * np.sin(2 * np.pi * t / 0.4)
    residual = 0.1 * np.roll(wave, 5) + 0.05 * np.sin(2 * np.pi * 10 * t) + 0.02 * t
    names = ("command", "temperature", "supply", "actuator_current", "load", "velocity")
    vectors = tuple(f"{v}_{a}" for v in ("specific_force", "field", "angular_rate") for a in "xyz")
    signals = {s: np.roll(wave, 20 * i) for i, s in enumerate((*names, *vectors))}
    target = "voltage_x" if effect.name in ("misalignment", "soft_iron") else "displacement"
    ctx = Context(
        t, 0.01, signals, target, target, "specific_force_x" if target == "voltage_x" else "command",
        facts={"axis": (0.0,), "position_m": (0.1, 0.0, 0.0)}, measured=wave + residual, noise=0.01,
    )  # fmt: skip
    settings = effect.prepare(wave, residual, ctx)
    parts = effect.parts(settings)
    listed = (*parts.nonlinear, *parts.weights)
    if effect.report is None:
        return tuple((p.name, p.unit) for p in listed)
    middle = np.array([0.5 * (p.lo + p.hi) if np.isfinite(p.lo + p.hi) else p.scale for p in listed])
    return tuple((h.name, h.unit) for h in effect.report(middle, settings, 1.0))


def to_json(found: Sequence[Entry]) -> dict[str, Any]:
    """Return what ``micron mismatch physics --json`` writes."""
    return {
        "format": 1,
        "units": UNITS,
        "physics": [
            {
                **{k: v for k, v in asdict(e).items() if k != "parameters"},
                "formula": "; ".join(map(plain, e.equations)),
                "parameters": [{"name": n, "unit": u} for n, u in e.parameters],
            }
            for e in found
        ],
    }


def print_vocabulary(found: Sequence[Entry], console: Console) -> None:
    """Print the vocabulary on a terminal."""
    for e in found:
        console.print(Text.assemble((e.name, "bold yellow"), "  ", e.summary))
        rows = [("formula", "\n".join(map(plain, e.equations)))]
        rows.append(("parameters", ", ".join(f"{n} ({u})" if u != "1" else n for n, u in e.parameters)))
        # the stages are those of a chain of signals, and what acts inside the equations alone has none
        rows.append(
            ("where", f"{', '.join(e.stages)}; {e.acts}" if set(_ACTS.values()) & set(e.acts.split("; ")) else e.acts)
        )
        rows.append(("shown by", e.excitation))
        if e.needs:
            rows.append(("needs", f"recorded {' or '.join(e.needs)}"))
        if e.twins:
            rows.append(("only in", ", ".join(e.twins)))
        if e.confusable_with:
            rows.append(("looks like", ", ".join(words(n) for n in e.confusable_with)))
        rows.append(("source", e.source))
        console.print(Padding(pairs_of(rows), (0, 0, 1, 2)))
    console.print(Text(UNITS, "dim"))
