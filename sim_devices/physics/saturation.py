"""Saturation: the output is limited, abruptly or gently, at two limits that need not be symmetric."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Parameter, Parts, Settings, reports
from sim_devices.physics.statistics import rank_starts, thin


@kernel
def limit(x, lo, hi, soft):
    """Clip with rounded corners: identity far from the limits, ``soft`` is the width of the corner.

    Softplus form: hi - w*log(1 + exp((hi - x)/w)), likewise below; w -> 0 is the hard clip.
    """
    y = np.empty_like(x)
    for i in range(x.size):
        v = x[i]
        if soft <= 0.0:
            y[i] = min(max(v, lo), hi)
            continue
        a = (hi - v) / soft
        v = hi - soft * (a if a > 40.0 else np.log1p(np.exp(a)))
        b = (v - lo) / soft
        y[i] = lo + soft * (b if b > 40.0 else np.log1p(np.exp(b)))
    return y


def _parts(settings: Settings) -> Parts:
    lo, hi = settings.get("range", (-1.0, 1.0))
    span = hi - lo or 1.0
    return Parts(
        (
            Parameter("lower_limit", "{in}", lo - 0.5 * span, lo + 0.7 * span, scale=0.1 * span, away=lo - 0.4 * span),
            Parameter("upper_limit", "{in}", hi - 0.7 * span, hi + 0.5 * span, scale=0.1 * span, away=hi + 0.4 * span),
            Parameter("corner", "{in}", 1e-4 * span, 0.5 * span, log=True, scale=0.05 * span),
        )
    )


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    lo, hi = settings["range"]
    span = hi - lo
    wanted = ctx.wanted(x, residual)
    cut = (-0.4, 0.03, 0.12, 0.3)
    # a limit that was not reached is taken to mirror the other one
    centres = (0.0, 0.5 * (lo + hi)) if lo < 0.0 < hi else (0.5 * (lo + hi),)
    grid: list[tuple[float, ...]] = [
        (c - r, c + r, w * span)
        for c in centres
        for r in np.linspace(0.2, 1.0, 7) * max(hi - c, c - lo)
        for w in (0.005, 0.1)
    ]
    grid += [(lo + a * span, hi - b * span, w * span) for a in cut for b in cut for w in (0.005, 0.1) if a > 0 or b > 0]
    # a gentle bend whose limits lie outside what was reached
    grid += [
        (lo + a * span, hi - b * span, w * span) for a, b in ((-0.1, -0.1), (-0.4, 0.0), (0.0, -0.4)) for w in (0.3,)
    ]
    k = thin(ctx.keep, 4000)
    return rank_starts(grid, lambda q: ctx.to_output(limit(x, q[0], q[1], q[2])), wanted, k, ctx.bends)[:4]


SATURATION = Effect(
    name="saturation",
    summary="output limited, hard or soft, at unequal limits",
    kind="nonlinear",
    stages=("amplifier", "actuator", "sensor", "acquisition"),
    parts=_parts,
    equation=r"y = \mathrm{clip}_w(x;\, x_\mathrm{min}, x_\mathrm{max})",
    source="H. K. Khalil, Nonlinear Systems, 3rd ed., section 1.2.7; corners by the softplus function",
    excitation="amplitudes that reach the limits, and smaller ones for comparison",
    confusable_with=("static_nonlinearity", "slew_limit"),
    prepare=lambda x, residual, ctx: {"range": (float(x.min()), float(x.max()))},
    guess=_guess,
    apply=lambda x, ctx, q, settings: limit(x, min(q[0], q[1]), max(q[0], q[1]), q[2]),
    report=reports(("lower_limit", "{in}"), ("upper_limit", "{in}"), ("corner", "{in}")),
)
