"""Memoryless maps: dead zone, curvature, quantisation; and the slew limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature
from sim_devices.physics.statistics import least_squares, rank_starts, thin

# -- dead zone --------------------------------------------------------------------------------------


def _range(x: Array) -> tuple[float, float]:
    lo, hi = float(x.min()), float(x.max())
    return (lo, hi) if hi > lo else (lo - 0.5, hi + 0.5)


def _range_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    return {"range": _range(x)}


def _dead_parts(settings: Settings) -> Parts:
    lo, hi = settings.get("range", (-1.0, 1.0))
    span = hi - lo
    return Parts(
        (
            Parameter("half_width", "{in}", 1e-4 * span, 0.45 * span, log=True, scale=0.02 * span),
            Parameter("centre", "{in}", lo, hi, scale=0.02 * span),
        ),
        (Parameter("missing_slope", "{out}/{in}"),),
    )


def _dead_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return -np.clip(x - q[1], -q[0], q[0])[:, None]


def _dead_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    lo, hi = settings["range"]
    span = hi - lo
    k = thin(ctx.keep, 4000)
    r = residual[k]
    straight = np.stack([np.ones(k.size), ctx.to_output(x)[k]], axis=1)
    tried: list[tuple[float, float, float]] = []
    centres = [*np.linspace(lo + 0.1 * span, hi - 0.1 * span, 9), *([0.0] if lo < 0 < hi else [])]
    for h in span * np.geomspace(0.01, 0.3, 8):
        for c in centres:
            column = ctx.to_output(-np.clip(x - c, -h, h))[k]
            tried.append((least_squares(np.column_stack([straight, column]), r)[1], float(h), float(c)))
    tried.sort()
    return tuple((h, c) for _, h, c in tried[:3])


def _dead_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    share = p[2] / scale if scale else 0.0
    return (
        Human("half_width", float(p[0]), "{in}"),
        Human("centre", float(p[1]), "{in}"),
        Human("slope_lost_inside", float(share), "1"),
    )


DEAD_ZONE = Effect(
    name="dead_zone",
    summary="no response for small inputs",
    kind="add",
    stages=("actuator", "amplifier", "sensor"),
    parts=_dead_parts,
    equation=r"y = x - w\,\mathrm{clip}(x - c, -h, h)",
    source="H. K. Khalil, Nonlinear Systems, 3rd ed., section 1.2.7",
    excitation="inputs that pass through the zone and go well beyond it",
    confusable_with=("static_nonlinearity", "backlash", "coulomb_friction"),
    prepare=_range_settings,
    guess=_dead_guess,
    basis=_dead_basis,
    report=_dead_report,
)

# -- static nonlinearity ----------------------------------------------------------------------------

KNOTS = 9


def curve_basis(x: Array, lo: float, hi: float, shape: int) -> Array:
    """Columns of a curve without its straight part. ``shape`` 1: the sign is lost, |x| - x (a sensor of magnitude);
    2..5: Legendre polynomials up to that degree, continued
    by their tangents outside [lo, hi]; 0: hinges |x - knot| on a uniform grid and at zero (piecewise linear)."""
    half = 0.5 * (hi - lo)
    if shape == 1:
        return (np.abs(x) - x)[:, None]
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
    """(score, shape, lo, hi): the curve over x that meets the target best for its size."""
    lo, hi = _range(x)
    k = thin(ctx.keep, 8000)
    straight = np.stack([np.ones(k.size), ctx.to_output(x)[k]], axis=1)
    # effective samples: residuals are coloured, so one in ten counts
    n = max(k.size / 10.0, 20.0)
    best = (np.inf, 2)
    for shape in (1, 2, 3, 5, 0) if lo < 0.0 < hi else (2, 3, 5, 0):
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
    return {"range": (lo, hi), "shape": (float(shape),), "slope": (1.0 if behind and shape != 1 else 0.0,)}


def _curve_parts(settings: Settings) -> Parts:
    shape = int(settings.get("shape", (3.0,))[0])
    n = max(shape - 1, 1) if shape > 0 else KNOTS
    if shape == 1:
        return Parts((), (Parameter("sign_lost", "{out}/{in}"),))
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


STATIC_NONLINEARITY = Effect(
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
)

# -- slew limit -------------------------------------------------------------------------------------


@kernel
def slew(x, down, up, share, starts):
    """Move towards x by ``share`` of the distance per sample, at most ``up`` and ``down``; on x at each start."""
    y = np.empty_like(x)
    s = 0
    v = 0.0
    for i in range(x.size):
        if s < starts.size and i == starts[s]:
            s += 1
            v = x[i]
        else:
            v += min(max(share * (x[i] - v), -down), up)
        y[i] = v
    return y


def _slew_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    rate = np.abs(np.diff(x)) / ctx.dt
    top = float(rate.max()) or 1.0
    usual = float(np.quantile(rate[rate > 0], 0.9)) if np.any(rate > 0) else 1.0
    return {"rates": (usual, top), "time": (ctx.dt,)}


def _slew_parts(settings: Settings) -> Parts:
    usual, top = settings.get("rates", (1.0, 10.0))
    dt = settings.get("time", (1e-3,))[0]
    lo = 0.02 * usual
    return Parts(
        (
            Parameter("rate_up", "{in}/s", lo, 1.2 * top, log=True, scale=0.1 * usual),
            Parameter("rate_down", "{in}/s", lo, 1.2 * top, log=True, scale=0.1 * usual),
            Parameter("time_constant_s", "s", 0.05 * dt, 50 * dt, log=True, scale=dt),
        )
    )


def _slew_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return slew(x, q[1] * ctx.dt, q[0] * ctx.dt, -np.expm1(-ctx.dt / q[2]), np.array(ctx.starts))


def _slew_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    usual, top = settings["rates"]
    measured = ctx.measured if ctx.measured is not None else ctx.to_output(x) + residual
    grid: list[tuple[float, ...]] = [
        (float(r), float(r), f * ctx.dt) for r in np.geomspace(0.03 * usual, top, 20) for f in (0.1, 3.0, 12.0)
    ]
    return rank_starts(
        grid,
        lambda q: ctx.to_output(_slew_apply(x, ctx, np.array(q), settings)),
        measured,
        thin(ctx.keep, 8000),
    )[:3]


def _slew_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("rate_up", float(p[0]), "{in}/s"),
        Human("rate_down", float(p[1]), "{in}/s"),
        Human("time_constant_s", float(p[2]), "s"),
    )


_UNEVEN_SLEW = Effect(
    name="slew_limit",
    summary="rate of change limited",
    kind="nonlinear",
    stages=("amplifier", "actuator"),
    parts=_slew_parts,
    equation=r"\dot y = \mathrm{clip}\left((x - y)/\tau,\, -r_-,\, r_+\right)",
    source="W. Jung, Op Amp Applications Handbook, section 1-4",
    excitation="changes quicker and slower than the limit",
    confusable_with=("first_order_lag", "saturation"),
    prepare=_slew_prepare,
    guess=_slew_guess,
    apply=_slew_apply,
    report=_slew_report,
)


def _even_parts(settings: Settings) -> Parts:
    up, _, lag = _slew_parts(settings).nonlinear
    return Parts((replace(up, name="rate"), lag))


def _both_ways(q: Array) -> Array:
    return np.array([q[0], q[0], q[1]])


def _even_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return _slew_apply(x, ctx, _both_ways(q), settings)


def _even_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    return [(up, lag) for up, _, lag in _slew_guess(x, residual, ctx, settings)]


def _even_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return _slew_report(_both_ways(p), settings, scale)


# one rate both ways comes first: edges of one direction then speak for the other
SLEW_LIMIT = replace(
    _UNEVEN_SLEW,
    parts=_even_parts,
    equation=r"\dot y = \mathrm{clip}\left((x - y)/\tau,\, -r,\, r\right)",
    guess=_even_guess,
    apply=_even_apply,
    report=_even_report,
    variants=(_UNEVEN_SLEW,),
)

# -- quantisation -----------------------------------------------------------------------------------


GRID_TOLERANCE = 0.06  # of a step: a finer grid may lie over the coarse one


def find_step(y: Array) -> float:
    """The grid on which all values of y lie, 0 if there is none that is coarser than rounding in a text file."""
    values = np.unique(y)
    if values.size < 2:
        return 0.0
    span = float(values[-1] - values[0])
    # values that differ by print rounding are one
    values = values[np.concatenate([[True], np.diff(values) > 1e-7 * span])]
    if values.size < 2 or values.size > 0.5 * y.size:
        return 0.0
    d = np.sort(np.diff(values))
    # from the middle, where values are dense
    middle = values[values.size // 2]
    outward = values[np.argsort(np.abs(values - middle))] - middle
    for step in (float(np.median(d)), float(d[0])):
        # refined over more and more values: the step that makes every one a whole number of steps
        for count in (4, 8, 16, 32, 64, 128, 256, 512, values.size):
            whole = np.round(outward[:count] / step)
            step = float(outward[:count] @ whole / (whole @ whole)) if whole.any() else step
        places = outward / step
        if np.max(np.abs(places - np.round(places))) < GRID_TOLERANCE and span / step < 1e5:
            return step
    return 0.0


def _grid_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    y = ctx.measured if ctx.measured is not None else x
    step = find_step(y)
    origin = float(np.unique(y)[0]) if step > 0 else 0.0
    return {"step": (step,), "origin": (origin,)}


def _grid_parts(settings: Settings) -> Parts:
    step = settings.get("step", (0.0,))[0] or 1.0
    return Parts((Parameter("dither_rms", "{out}", 0.01 * step, 0.6 * step, log=True, scale=0.05 * step),))


def mean_of_steps(x: Array, step: float, origin: float, dither: float) -> Array:
    """Expected reading of a rounding quantiser when noise of rms ``dither`` precedes it.

    B. Widrow, I. Kollar, Quantization Noise (2008), eq. 16.14: x + step/pi sum (-1)^k/k sin(2 pi k x/step) e^(...).
    """
    z = (x - origin) / step
    s = dither / step
    out = z.copy()
    for k in range(1, 40):
        decay = np.exp(-2 * (np.pi * k * s) ** 2)
        if decay < 1e-9:
            break
        out += (-1.0) ** k * decay / (np.pi * k) * np.sin(2 * np.pi * k * z)
    return origin + step * out


def _grid_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    step = settings.get("step", (0.0,))[0]
    if step <= 0:
        return x
    if q[0] < 0.03 * step:
        return settings["origin"][0] + step * np.round((x - settings["origin"][0]) / step)
    return mean_of_steps(x, step, settings["origin"][0], q[0])


def _grid_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    step = settings["step"][0] or 1.0
    return ((0.3 * step,), (0.1 * step,), (0.02 * step,))


def _grid_test(x: Array, residual: Array, ctx: Context) -> Signature:
    if ctx.measured is None:
        return Signature(1.0, 0.0)
    step = find_step(ctx.measured)
    power = float(np.mean(residual[ctx.keep] ** 2))
    if step == 0.0 or power == 0.0:
        return Signature(1.0, 0.0, "no grid")
    share = min(1.0, step * step / 12 / power)
    # every distinct value but the two that fix the grid lies on it by chance of twice the tolerance
    values = min(max(round(float(np.ptp(ctx.measured)) / step) - 1, 0), 100)
    p = max(1e-300, (2 * GRID_TOLERANCE) ** values) if share > 0.02 else 1.0
    return Signature(p, share, f"all readings lie on a grid of {step:g}")


def _grid_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("step", float(settings["step"][0]), "{out}"), Human("dither_rms", float(p[0]), "{out}"))


QUANTIZATION = Effect(
    name="quantization",
    summary="steps coarser than declared",
    kind="nonlinear",
    stages=("acquisition", "sensor"),
    parts=_grid_parts,
    equation=r"y = \Delta\,\mathrm{round}(x/\Delta)",
    source="B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, chapters 4 and 16",
    excitation="slow parts, where the steps are visible one by one",
    confusable_with=(),
    prepare=_grid_prepare,
    guess=_grid_guess,
    apply=_grid_apply,
    test=_grid_test,
    report=_grid_report,
    sites=("output",),
)
