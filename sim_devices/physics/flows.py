"""Flows between storages inside differential equations: outflow that goes with the root of a level, and overflow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.forces import ABOVE, FLOW, ROOT

PAIRS = "pairs"
"""Name of a fact of a place: flattened pairs (state that a flow depends on, state whose derivative it is added to). The
outflow of each storage comes first, then the flows from it into others."""


NO_LEVELS = ("degC", "K", "A")
"""Units of states that have no rim and no opening: temperatures and currents."""
RANGES = "ranges"
"""Name of a fact of a place: lowest level, highest level, rms rate and highest possible rim of each storage, flattened
in the order of ``storages_of``. A recorded level shows its rim; a simulated one moves with the fit."""


def _settings(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    low, high = float(np.min(x[k])), float(np.max(x[k]))
    alone = (low, high, float(np.sqrt(np.mean(np.gradient(x, ctx.dt)[k] ** 2))), high)
    found = _by(4, ctx.facts.get(RANGES, alone))
    return {
        "range": tuple(v for low, high, *_ in found for v in (low, high if high > low else low + 1.0)),
        "rate": tuple(rate or 1.0 for _, _, rate, _ in found),
        "top": tuple(top if top > low else low + 1.0 for low, _, _, top in found),
        PAIRS: ctx.facts.get(PAIRS, (0.0, 0.0)),
    }


def _by(count: int, flat: Sequence[float]) -> list[tuple[float, ...]]:
    return [tuple(flat[i : i + count]) for i in range(0, len(flat), count)]


def flow_pairs(settings: Settings) -> list[tuple[int, int]]:
    flat = settings.get(PAIRS, (0.0, 0.0))
    return [(int(a), int(b)) for a, b in zip(flat[::2], flat[1::2], strict=True)]


def storages_of(settings: Settings) -> list[int]:
    """Return the states that the flows depend on, each once."""
    return list(dict.fromkeys(a for a, _ in flow_pairs(settings)))


def _spans(settings: Settings) -> list[tuple[float, float, float]]:
    """Return lowest level, highest level and rate of each storage. A twin file of one range uses it for all."""
    stores = storages_of(settings)
    ranges, rates = _by(2, settings.get("range", (0.0, 1.0))), settings.get("rate", (1.0,))
    return [(*ranges[min(i, len(ranges) - 1)], rates[min(i, len(rates) - 1)]) for i in range(len(stores))]  # pyright: ignore[reportReturnType]


def level_names(name: str, settings: Settings) -> list[str]:
    """Return the names of the level parameters; states count from one where there are several storages."""
    stores = storages_of(settings)
    return [name] if len(stores) == 1 else [f"{name}_{a + 1}" for a in stores]


def _names(settings: Settings) -> list[str]:
    """Return a name for each flow; states count from one."""
    return [f"outflow_{a + 1}" if a == b else f"inflow_{b + 1}_from_{a + 1}" for a, b in flow_pairs(settings)]


def _root_parts(settings: Settings) -> Parts:
    spans = _spans(settings)
    size = dict(zip(storages_of(settings), (r / np.sqrt(high - low) for low, high, r in spans), strict=True))
    levels = [
        Parameter(n, "{out}", low - 2.0 * (high - low), low + 0.1 * (high - low), scale=0.05 * (high - low))
        for n, (low, high, _) in zip(level_names("empty_level", settings), spans, strict=True)
    ]
    return Parts(tuple(levels), _strengths(settings, size, "{out}^0.5/s"))


def _strengths(settings: Settings, size: dict[int, float], unit: str) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(n, unit, 0.0, scale=float(size[a]))
        for n, (a, _) in zip(_names(settings), flow_pairs(settings), strict=True)
    )


def _root_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    spans = _spans(settings)
    return (
        tuple(float(np.clip(0.0, low - 2.0 * (high - low), low)) for low, high, _ in spans),
        tuple(low - 0.1 * (high - low) for low, high, _ in spans),
    )


def _level_by_flow(q: Array, settings: Settings) -> list[tuple[int, int, float]]:
    """Return (state it depends on, state it changes, level) of each flow."""
    level = dict(zip(storages_of(settings), (float(v) for v in q), strict=True))
    return [(a, b, level[a]) for a, b in flow_pairs(settings)]


def _root_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    rows = [(1.0 if a != b else -1.0) * np.sqrt(np.maximum(x - q0, 0.0)) for a, b, q0 in _level_by_flow(q, settings)]
    return np.stack(rows, axis=1)


def _fill(law: int, q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    rows = np.zeros((w.size, FLOW))
    for row, (a, b, level), strength in zip(rows, _level_by_flow(q, settings), w, strict=True):
        row[:] = law, a, b, -strength if a == b else strength, level
    return {"flows": rows.ravel()}


def _report(level: str, unit: str, p: Array, settings: Settings) -> Sequence[Human]:
    levels, flows = level_names(level, settings), _names(settings)
    return (
        *(Human(n, float(v), unit) for n, v in zip(flows, p[len(levels) :], strict=True)),
        *(Human(n, float(v), "{out}") for n, v in zip(levels, p, strict=False)),
    )


SQUARE_ROOT_OUTFLOW = Effect(
    name="square_root_outflow",
    summary="outflow through an opening goes with the root of the level above it",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_root_parts,
    equation=r"\dot h_i = \dots - a_i \sqrt{h_i - e_i},\; \dot h_j = \dots + a_{ij} \sqrt{h_i - e_i}",
    source="M. Schoukens, J. P. Noel, Three Benchmarks Addressing Open Challenges in Nonlinear System Identification,"
    " IFAC-PapersOnLine 50-1 (2017) 446, eqs. 1-3 (Bernoulli, Torricelli)",
    excitation="high and low levels",
    confusable_with=("static_nonlinearity", "overflow"),
    prepare=_settings,
    guess=_root_guess,
    basis=_root_basis,
    fill=lambda q, w, s: _fill(ROOT, q, w, s),
    report=lambda p, s, g: _report("empty_level", "{out}^0.5/s", p, s),
    acts_on=("storage", "storages"),
    not_units=NO_LEVELS,
)


def _over_parts(settings: Settings) -> Parts:
    spans = _spans(settings)
    size = dict(zip(storages_of(settings), (r / (0.1 * (high - low)) for low, high, r in spans), strict=True))
    tops = settings.get("top", tuple(high for _, high, _ in spans))
    levels = [
        Parameter(n, "{out}", low + 0.4 * (high - low), top, scale=0.02 * (high - low))
        for n, (low, high, _), top in zip(level_names("level", settings), spans, tops, strict=True)
    ]
    return Parts(tuple(levels), _strengths(settings, size, "1/s"))


def _over_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    return tuple(tuple(low + f * (high - low) for low, high, _ in _spans(settings)) for f in (0.75, 0.9))


def _over_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    rows = [(1.0 if a != b else -1.0) * np.maximum(x - level, 0.0) for a, b, level in _level_by_flow(q, settings)]
    return np.stack(rows, axis=1)


OVERFLOW = Effect(
    name="overflow",
    summary="what stands above a level flows over, in part into the next storage",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_over_parts,
    equation=r"\dot h_i = \dots - b_i \max(h_i - L_i, 0),\; \dot h_j = \dots + b_{ij} \max(h_i - L_i, 0)",
    source="M. Schoukens, J. P. Noel, IFAC-PapersOnLine 50-1 (2017) 446, section 2: overflow of the upper tank, part"
    " of it into the lower",
    excitation="levels up to the rim and well below it",
    confusable_with=("saturation", "square_root_outflow"),
    prepare=_settings,
    guess=_over_guess,
    basis=_over_basis,
    fill=lambda q, w, s: _fill(ABOVE, q, w, s),
    report=lambda p, s, g: _report("level", "1/s", p, s),
    acts_on=("storage", "storages"),
    not_units=NO_LEVELS,
)
