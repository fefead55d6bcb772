"""Static nonlinearity: memoryless curvature of one axis' own input-output line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, reports
from sim_devices.physics.statistics import least_squares, thin, value_range

KNOTS = 9


def curve_basis(x: Array, lo: float, hi: float, shape: int) -> Array:
    """Return the columns of a curve without its straight part.

    ``shape`` 2..5: Legendre polynomials up to that degree, continued by their tangents outside [lo, hi]; 0: hinges
    |x - knot| on a uniform grid and at zero (piecewise linear).
    """
    half = 0.5 * (hi - lo)
    z = (x - 0.5 * (lo + hi)) / half
    if shape > 0:
        inside = np.clip(z, -1.0, 1.0)
        beyond = z - inside
        cols: list[Array] = []
        for d in range(2, shape + 1):
            c = np.zeros(d + 1)
            c[d] = 1.0
            p = np.polynomial.Legendre(c)
            cols.append(p(inside) + p.deriv()(inside) * beyond)
        return np.stack(cols, axis=1)
    knots = list(np.linspace(-1, 1, KNOTS + 2)[1:-1])
    if lo < 0 < hi:
        zero = -0.5 * (lo + hi) / half
        knots[int(np.argmin(np.abs(np.array(knots) - zero)))] = zero
    return np.stack([np.abs(z - k) for k in knots], axis=1)


def _curve_choose(x: Array, target: Array, ctx: Context) -> tuple[float, int, float, float]:
    """Return (score, shape, lo, hi) of the curve over x with the best fit for its number of columns."""
    lo, hi = value_range(x)
    k = thin(ctx.keep, 8000)
    straight = ctx.line(x, k)
    # effective samples: residuals are coloured, so one in ten counts
    n = max(k.size / 10.0, 20.0)
    best = (np.inf, 2)
    for shape in (2, 3, 5, 0):
        cols = curve_basis(x, lo, hi, shape)
        if ctx.through is not None:
            cols = np.stack([ctx.to_output(c) for c in cols.T], axis=1)
        rss = least_squares(np.column_stack([straight, cols[k]]), target[k])[1]
        best = min(best, (n * np.log(max(rss, 1e-300)) + cols.shape[1] * np.log(n), shape))
    return best[0], best[1], lo, hi


def _curve_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    score, shape, lo, hi = _curve_choose(x, residual, ctx)
    if ctx.believed is not None and ctx.measured is not None:
        other = _curve_choose(ctx.believed, ctx.measured, ctx)
        if other[0] < score:
            _, shape, lo, hi = other
    # behind a dynamic twin the curve needs a slope of its own: the base gain sets where on the curve one is
    behind = ctx.believed is not None
    return {"range": (lo, hi), "shape": (float(shape),), "slope": (1.0 if behind else 0.0,)}


def _curve_parts(settings: Settings) -> Parts:
    shape = int(settings.get("shape", (3.0,))[0])
    n = max(shape - 1, 1) if shape > 0 else KNOTS
    names = [f"legendre{d}" for d in range(2, shape + 1)] if shape > 0 else [f"hinge{i + 1}" for i in range(n)]
    if settings.get("slope", (0.0,))[0]:
        names.append("slope")
    return Parts((), tuple(Parameter(m, "{out}") for m in names), 0.05 * np.eye(len(names)))


def _curve_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    lo, hi = settings.get("range", (-1.0, 1.0))
    cols = curve_basis(x, lo, hi, int(settings.get("shape", (3.0,))[0]))
    if settings.get("slope", (0.0,))[0]:
        cols = np.column_stack([cols, (x - 0.5 * (lo + hi)) / (0.5 * (hi - lo))])
    return cols


def _curve_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    lo, hi = settings["range"]
    x = np.linspace(lo, hi, 201)
    cols = curve_basis(x, lo, hi, int(settings["shape"][0]))
    bend = cols @ p[: cols.shape[1]]
    line = np.polynomial.Polynomial.fit(x, bend, 1)
    out = [Human("deviation_from_line", float(np.max(np.abs(bend - line(x)))), "{out}")]
    span = abs(scale) * (hi - lo)
    if span > 0:
        out.append(Human("nonlinearity_share_of_span", float(out[0].value / span), "1"))
    even = 0.5 * (bend + bend[::-1])
    power = float(np.sum((bend - line(x)) ** 2))
    out.append(Human("even_share", float(np.sum((even - even.mean()) ** 2) / power) if power > 0 else 0.0, "1"))
    return out


def _fold_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    return {"size": (float(np.max(np.abs(x[k]))) or 1.0,)}


def _fold_parts(settings: Settings) -> Parts:
    size = settings.get("size", (1.0,))[0]
    # the power is searched at a fixed size of the signal: a sum of powers leaves the scale of the signal free
    return Parts((Parameter("power", "1", 0.5, 3.0, scale=0.2), Parameter("zero", "{out}", scale=0.05 * size)))


def _fold_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    size = settings["size"][0]
    # an offset of the twin is one of what is folded
    return size * np.abs(x / size) ** q[0] + q[1]


_CURVE = Effect(
    name="static_nonlinearity",
    summary="memoryless curvature of one axis' own input-output line",
    kind="add",
    stages=("actuator", "sensor"),
    parts=_curve_parts,
    equation=r"y = x + \sum_{d \ge 2} c_d P_d(\tilde x) \quad\text{or}\quad x + \sum_i c_i |x - k_i|",
    source="IEEE Std 1293-2018, section on nonlinearity; M. Abramowitz, I. Stegun, ch. 22 (Legendre)",
    excitation="the whole range of the input, slowly or at several speeds",
    confusable_with=("saturation", "dead_zone", "hysteresis", "cubic_stiffness"),
    prepare=_curve_prepare,
    basis=_curve_basis,
    report=_curve_report,
    vanishes_with=(("deviation_from_line",),),
)
_FOLD = replace(
    _CURVE,
    summary="the sign is lost: a sensor reads the magnitude, or a power of it",
    kind="nonlinear",
    stages=("sensor",),
    parts=_fold_parts,
    equation=r"y = X |x / X|^p + y_0",
    source="T. Wigren, M. Schoukens, Coupled Electric Drives Data Set and Reference Models, Uppsala 2017-024",
    excitation="both signs of the signal",
    prepare=_fold_settings,
    guess=lambda x, residual, ctx, settings: tuple((power, 0.0) for power in (1.0, 1.5, 2.0)),
    basis=None,
    apply=_fold_apply,
    report=reports(("power", "1"), ("zero", "{out}")),
    sites=("output",),
    plain_without=(("power",),),
)
STATIC_NONLINEARITY = replace(_CURVE, variants=(_FOLD,))
