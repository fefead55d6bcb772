"""Slew limit: the rate of change is limited, the same both ways or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.statistics import best_starts, thin

RATES = (1.0, 10.0)  # usual and fastest of the input, where a file does not say
SUBSTEPS = 8  # where a limited course meets its input again lies between samples, and all that follows hangs on it


@kernel
def slew(x, most, share, starts, parts, rounded):
    """Follow x at a limited rate; x runs straight between samples and each sample is divided into ``parts`` steps.

    A step moves by ``share`` of the distance, by at most ``most`` (down, up); ``rounded`` smooths the limit by a
    hyperbolic tangent. The output equals x at each start.
    """
    down, up = most
    y = np.empty_like(x)
    s = 0
    v = 0.0
    for i in range(x.size):
        if s < starts.size and i == starts[s]:
            s += 1
            v = x[i]
        else:
            for k in range(1, parts + 1):
                d = share * (x[i - 1] + (x[i] - x[i - 1]) * k / parts - v)
                if rounded:
                    limit = up if d > 0.0 else down
                    v += limit * np.tanh(d / limit)
                else:
                    v += min(max(d, -down), up)
        y[i] = v
    return y


def _slew_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    rate = np.abs(np.diff(x)) / ctx.dt
    top = float(rate.max()) or 1.0
    usual = float(np.quantile(rate[rate > 0], 0.9)) if np.any(rate > 0) else 1.0
    return {"rates": (usual, top), "time": (ctx.dt,)}


def _slew_parts(settings: Settings) -> Parts:
    usual, top = settings.get("rates", RATES)
    dt = settings.get("time", (1e-3,))[0]
    lo = 0.02 * usual
    return Parts(
        (
            Parameter("rate_up", "{in}/s", lo, 1.2 * top, log=True, scale=0.1 * usual),
            Parameter("rate_down", "{in}/s", lo, 1.2 * top, log=True, scale=0.1 * usual),
            Parameter("time_constant_s", "s", 0.01 * dt, 50 * dt, log=True, scale=dt),
        )
    )


def _slew_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    h = ctx.dt / SUBSTEPS
    return slew(x, (q[1] * h, q[0] * h), -np.expm1(-h / q[2]), np.array(ctx.starts), SUBSTEPS, False)


def _slew_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    usual, top = settings["rates"]
    k = thin(ctx.keep, 8000)
    rates = np.geomspace(0.03 * usual, top, 24).tolist()
    grid = [(rate, rate, lag * ctx.dt) for rate in rates for lag in (0.1, 0.6, 3.0, 12.0)]
    # against the residual: how a plant that integrates came to where it is, no change of its input says
    change = lambda q: ctx.to_output(_slew_apply(x, ctx, np.array(q), settings) - x)[k]  # noqa: E731
    return best_starts(grid, change, ctx.line(x, k), residual[k])[:3]


def _slew_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("rate_up", float(p[0]), "{in}/s"),
        Human("rate_down", float(p[1]), "{in}/s"),
        Human("time_constant_s", float(p[2]), "s"),
        Human("share_of_fastest_input", float(max(p[0], p[1])) / settings.get("rates", RATES)[1], "1"),
    )


_UNEVEN_SLEW = Effect(
    name="slew_limit",
    summary="rate of change limited",
    kind="nonlinear",
    stages=("amplifier", "actuator", "sensor"),
    parts=_slew_parts,
    equation=r"\dot y = \mathrm{clip}\left((x - y)/\tau,\, -r_-,\, r_+\right)",
    source="W. Jung, Op Amp Applications Handbook, section 1-4",
    excitation="changes quicker and slower than the limit",
    confusable_with=("first_order_lag", "saturation"),
    # a limit that is not met leaves the lag alone
    limits={"share_of_fastest_input": (0.0, 1.0)},
    plain_in={"share_of_fastest_input": (1.0, np.inf)},
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


def _even_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    return [(up, lag) for up, _, lag in _slew_guess(x, residual, ctx, settings)]


def _even_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return _slew_report(_both_ways(p), settings, scale)


def _rounded_parts(settings: Settings) -> Parts:
    rate, lag = _even_parts(settings).nonlinear
    # names of their own: twin files tell forms by their parameters
    return Parts((replace(rate, name="asymptotic_rate"), replace(lag, name="small_signal_s")))


def _rounded_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    h = ctx.dt / SUBSTEPS
    return slew(x, (q[0] * h, q[0] * h), -np.expm1(-h / q[1]), np.array(ctx.starts), SUBSTEPS, True)


_ROUNDED_SLEW = replace(
    _UNEVEN_SLEW,
    parts=_rounded_parts,
    equation=r"\dot y = r \tanh\left((x - y)/(r \tau)\right)",
    source="J. E. Solomon, IEEE J. Solid-State Circuits 9 (1974) 314 (input stage of an operational amplifier)",
    guess=_even_guess,
    apply=_rounded_apply,
    report=_even_report,
)

# one rate both ways comes first: edges of one direction then speak for the other
SLEW_LIMIT = replace(
    _UNEVEN_SLEW,
    parts=_even_parts,
    equation=r"\dot y = \mathrm{clip}\left((x - y)/\tau,\, -r,\, r\right)",
    guess=_even_guess,
    apply=lambda x, ctx, q, settings: _slew_apply(x, ctx, _both_ways(q), settings),
    report=_even_report,
    variants=(_UNEVEN_SLEW, _ROUNDED_SLEW),
)
