"""Flows between storages inside differential equations: outflow that goes with the root of a level, and overflow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.forces import ABOVE, FLOW, ROOT

PAIRS = "pairs"
"""Fact of a place: flattened pairs (state that a flow depends on, state whose derivative it is added to), the outflow
of each storage first, then what goes from it into others."""


def _settings(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    low, high = float(np.min(x[k])), float(np.max(x[k]))
    rate = float(np.sqrt(np.mean(np.gradient(x, ctx.dt)[k] ** 2))) or 1.0
    pairs = ctx.facts.get(PAIRS, (0.0, 0.0))
    return {"range": (low, high if high > low else low + 1.0), "rate": (rate,), PAIRS: pairs}


def flow_pairs(settings: Settings) -> list[tuple[int, int]]:
    flat = settings.get(PAIRS, (0.0, 0.0))
    return [(int(a), int(b)) for a, b in zip(flat[::2], flat[1::2], strict=True)]


def _names(settings: Settings) -> list[str]:
    """A name for each flow; states count from one."""
    return [f"outflow_{a + 1}" if a == b else f"inflow_{b + 1}_from_{a + 1}" for a, b in flow_pairs(settings)]


def _root_parts(settings: Settings) -> Parts:
    low, high = settings.get("range", (0.0, 1.0))
    rate, span = settings.get("rate", (1.0,))[0], high - low
    strength = [Parameter(n, "{out}^0.5/s", 0.0, scale=rate / np.sqrt(span)) for n in _names(settings)]
    empty = Parameter("empty_level", "{out}", low - 2.0 * span, low + 0.1 * span, scale=0.05 * span)
    return Parts((empty,), tuple(strength))


def _root_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    low, high = settings["range"]
    span = high - low
    return ((float(np.clip(0.0, low - 2.0 * span, low)),), (low - 0.1 * span,))


def _root_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    root = np.sqrt(np.maximum(x - q[0], 0.0))
    return np.stack([-root if a == b else root for a, b in flow_pairs(settings)], axis=1)


def _fill(law: int, level: float, w: Array, settings: Settings) -> dict[str, Array]:
    rows = np.zeros((w.size, FLOW))
    for row, (a, b), strength in zip(rows, flow_pairs(settings), w, strict=True):
        row[:] = law, a, b, -strength if a == b else strength, level
    return {"flows": rows.ravel()}


def _root_fill(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    return _fill(ROOT, float(q[0]), w, settings)


def _report(level: str, unit: str, p: Array, settings: Settings) -> Sequence[Human]:
    flows = [Human(n, float(v), unit) for n, v in zip(_names(settings), p[1:], strict=True)]
    return (*flows, Human(level, float(p[0]), "{out}"))


SQUARE_ROOT_OUTFLOW = Effect(
    name="square_root_outflow",
    summary="outflow through an opening goes with the root of the level above it",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_root_parts,
    equation=r"\dot h_i = \dots - a_i \sqrt{h_i - h_0},\; \dot h_j = \dots + a_{ij} \sqrt{h_i - h_0}",
    source="M. Schoukens, J. P. Noel, Three Benchmarks Addressing Open Challenges in Nonlinear System Identification,"
    " IFAC-PapersOnLine 50-1 (2017) 446, eqs. 1-3 (Bernoulli, Torricelli)",
    excitation="high and low levels",
    confusable_with=("static_nonlinearity", "overflow"),
    prepare=_settings,
    guess=_root_guess,
    basis=_root_basis,
    fill=_root_fill,
    report=lambda p, s, g: _report("empty_level", "{out}^0.5/s", p, s),
    acts_on=("storage", "storages"),
)


def _over_parts(settings: Settings) -> Parts:
    low, high = settings.get("range", (0.0, 1.0))
    rate, span = settings.get("rate", (1.0,))[0], high - low
    level = Parameter("level", "{out}", low + 0.4 * span, high, scale=0.02 * span)
    return Parts((level,), tuple(Parameter(n, "1/s", 0.0, scale=rate / (0.1 * span)) for n in _names(settings)))


def _over_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    low, high = settings["range"]
    return tuple((low + f * (high - low),) for f in (0.75, 0.9))


def _over_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    over = np.maximum(x - q[0], 0.0)
    return np.stack([-over if a == b else over for a, b in flow_pairs(settings)], axis=1)


def _over_fill(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    return _fill(ABOVE, float(q[0]), w, settings)


OVERFLOW = Effect(
    name="overflow",
    summary="what stands above a level flows over, in part into the next storage",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_over_parts,
    equation=r"\dot h_i = \dots - b_i \max(h_i - L, 0),\; \dot h_j = \dots + b_{ij} \max(h_i - L, 0)",
    source="M. Schoukens, J. P. Noel, IFAC-PapersOnLine 50-1 (2017) 446, section 2: overflow of the upper tank, part"
    " of it into the lower",
    excitation="levels up to the rim and well below it",
    confusable_with=("saturation", "square_root_outflow"),
    prepare=_settings,
    guess=_over_guess,
    basis=_over_basis,
    fill=_over_fill,
    report=lambda p, s, g: _report("level", "1/s", p, s),
    acts_on=("storage",),
)
