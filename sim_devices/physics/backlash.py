"""Backlash: after each reversal the output stands still (or nearly) until the gap is taken up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.memory import stops
from sim_devices.physics.statistics import best_starts, thin


def _parts(settings: Settings) -> Parts:
    span = settings.get("span", (1.0,))[0]
    return Parts(
        (
            Parameter("half_gap", "{in}", 1e-5 * span, 0.45 * span, log=True, scale=0.01 * span),
            # a little more than from contact to contact, so that a run that begins at one does not end at a bound
            Parameter("first_in_gap", "1", -1.05, 1.05, scale=0.2, away=0.0),
        ),
        (Parameter("missing_slope", "{out}/{in}"),),
    )


def in_gap(x: Array, half_gaps: Array, first: float, starts: tuple[int, ...]) -> Array:
    """Return the distance x - P_r[x] (n, k) of x from the middle of each gap, ``first`` half gaps at each start."""
    out = np.empty((x.size, half_gaps.size))
    for a, b in pairwise((*starts, x.size)):
        for j, r in enumerate(half_gaps):
            begin = float(x[a]) - float(np.clip(first, -1.0, 1.0)) * float(r)
            out[a:b, j] = stops(x[a:b], half_gaps[j : j + 1], begin, np.zeros(1, np.int64))[:, 0]
    return out


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return -in_gap(x, q[:1], q[1], ctx.starts)


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    span = settings["span"][0]
    k = thin(ctx.keep, 8000)
    straight = ctx.line(x, k)
    grid = span * np.geomspace(5e-4, 0.4, 16)
    every = dict(zip(grid.tolist(), in_gap(x, grid, 0.0, ctx.starts).T, strict=True))
    column = lambda q: ctx.to_output(np.ascontiguousarray(every[q[0]]))[k]  # noqa: E731
    return best_starts([(r, 0.0) for r in every], column, straight, residual[k])[:3]


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    lost = (Human("slope_lost_inside", float(p[2] / scale) if scale else 0.0, "1"),) if p.size > 2 else ()
    return (Human("gap", 2 * float(p[0]), "{in}"), *lost)


_PARTIAL = Effect(
    name="backlash",
    summary="free play: output stands still for a fixed travel after each reversal",
    kind="add",
    stages=("mechanics", "actuator"),
    parts=_parts,
    equation=r"y = x - w\,(x - P_r[x])",
    source="M. Nordin, P.-O. Gutman, Automatica 38 (2002) 1633, section 2; play operator as in Kuhnen 2003, eq. 2",
    excitation="reversals with travel of several gaps",
    confusable_with=("hysteresis", "dead_zone", "coulomb_friction", "dead_time"),
    prepare=lambda x, residual, ctx: {"span": (float(np.ptp(x)) or 1.0,)},
    guess=_guess,
    basis=_basis,
    report=_report,
    vanishes_with=(("gap",), ("slope_lost_inside",)),
    # an output that is stiffer inside, or turns back, has no play: it is that of a hysteresis
    limits={"slope_lost_inside": (0.0, 1.0)},
    estimated=("slope_lost_inside",),
    essential=("half_gap",),
)
_WHOLE = replace(
    _PARTIAL,
    kind="nonlinear",
    parts=lambda settings: Parts(_parts(settings).nonlinear),
    equation="y = P_r[x]",
    apply=lambda x, ctx, q, settings: x - in_gap(x, q[:1], q[1], ctx.starts)[:, 0],
    basis=None,
    vanishes_with=(("gap",),),
    limits={},
    estimated=(),
)
BACKLASH = replace(_PARTIAL, variants=(_WHOLE,))
