"""One-sided conduction: a diode behind a resistance bends a signal down on one side of its knee."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import wrightomega

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.statistics import rank_starts, thin, value_range


def conducted(x: Array, knee: float, width: float, side: float) -> Array:
    """Voltage (n,) across a diode that a source ``x`` (n,) feeds through a resistance.

    The current i meets y = x - R i with R i = width exp((y - knee) / width): Shockley's equation with its saturation
    current inside ``knee``. Solved by Wright's omega function, y = x - width omega((x - knee) / width). ``side`` -1
    mirrors it at zero.
    """
    u = side * x
    return side * (u - width * np.asarray(wrightomega((u - knee) / width), np.float64))


def _grid(lo: float, hi: float, side: float) -> list[tuple[float, float]]:
    low, high = (lo, hi) if side > 0 else (-hi, -lo)
    span = high - low
    return [(low + a * span, w * span) for a in (0.4, 0.55, 0.7, 0.85, 1.0, 1.15) for w in (0.01, 0.03, 0.1, 0.3)]


def _ranked(x: Array, residual: Array, ctx: Context, lo: float, hi: float, side: float) -> list[tuple[float, ...]]:
    measured = ctx.to_output(x) + residual
    return rank_starts(
        _grid(lo, hi, side),
        lambda q: ctx.to_output(conducted(x, q[0], q[1], side)),
        measured,
        thin(ctx.keep, 4000),
        ctx.bends,
    )


def _misfit(x: Array, residual: Array, ctx: Context, q: Sequence[float], side: float) -> float:
    k = thin(ctx.keep, 4000)
    design = np.column_stack([ctx.line(x, k), ctx.to_output(conducted(x, q[0], q[1], side))[k]])
    target = (ctx.to_output(x) + residual)[k]
    left = target - design @ np.linalg.lstsq(design, target, rcond=1e-10)[0]
    return float(left @ left)


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    lo, hi = value_range(x)
    sides = (1.0, -1.0)
    misfits = [_misfit(x, residual, ctx, _ranked(x, residual, ctx, lo, hi, side)[0], side) for side in sides]
    return {"range": (lo, hi), "side": (sides[int(np.argmin(misfits))],)}


def _side(settings: Settings) -> float:
    return settings.get("side", (1.0,))[0]


def _parts(settings: Settings) -> Parts:
    lo, hi = settings.get("range", (-1.0, 1.0))
    low, high = (lo, hi) if _side(settings) > 0 else (-hi, -lo)
    span = high - low or 1.0
    return Parts(
        (
            Parameter("knee", "{in}", low - 0.2 * span, high + 0.2 * span, scale=0.02 * span),
            Parameter("width", "{in}", 1e-3 * span, 0.5 * span, log=True, scale=0.02 * span),
        )
    )


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    lo, hi = settings["range"]
    return _ranked(x, residual, ctx, lo, hi, _side(settings))[:3]


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("knee", _side(settings) * float(p[0]), "{in}"),
        Human("exponential_width", float(p[1]), "{in}"),
    )


ONE_SIDED_CONDUCTION = Effect(
    name="one_sided_conduction",
    summary="a diode behind a resistance: beyond its knee one side follows the logarithm of the input",
    kind="nonlinear",
    stages=("actuator", "amplifier", "sensor"),
    parts=_parts,
    equation=r"y = x - w\,\omega\!\left(\pm(x - x_0)/w\right),\; \omega + \ln\omega = z",
    source="W. Shockley, Bell Syst. Tech. J. 28 (1949) 435, eq. 1.1; solved by R. M. Corless, D. J. Jeffrey, ISSAC 2002"
    " (Wright omega)",
    excitation="both signs of the signal, up to well beyond the knee",
    confusable_with=("saturation", "static_nonlinearity", "dead_zone"),
    prepare=_prepare,
    guess=_guess,
    apply=lambda x, ctx, q, settings: conducted(x, float(q[0]), float(q[1]), _side(settings)),
    report=_report,
    sites=("input", "output", "between"),
    # elsewhere it would stand in for saturation, and neither would be named
    end_units=("V", "mV", "kV"),
    # with a sharp knee it is a limit
    plain_without=(("exponential_width",),),
    plain="saturation",
    essential=("knee",),
)
