"""Low-pass of first order, and high-pass of first and second, in the signal path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, time_settings
from sim_devices.physics.resonance import discrete_mode, mode
from sim_devices.physics.statistics import rank_starts, thin


@kernel
def low_pass(x, dt, tau, starts):
    """Return the exact y of y' = (x - y) / tau with x linear between samples; settled at each start.

    y[k+1] = e y[k] + (1 - e) x[k] + (1 - (1 - e) tau/dt) (x[k+1] - x[k]),  e = exp(-dt/tau).
    """
    y = np.empty_like(x)
    e = np.exp(-dt / tau)
    b = -np.expm1(-dt / tau)
    c = 1.0 - b * tau / dt
    s = 0
    state = 0.0
    for i in range(x.size):
        if s < starts.size and i == starts[s]:
            s += 1
            state = x[i]
        else:
            state = e * state + b * x[i - 1] + c * (x[i] - x[i - 1])
        y[i] = state
    return y


def _parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts((Parameter("time_constant_s", "s", 0.02 * dt, 0.5 * span, log=True, scale=dt),))


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    dt, span = settings["time"]
    model, at = ctx.to_output(x), np.zeros(1, np.int64)
    grid: list[tuple[float, ...]] = [(float(t),) for t in np.geomspace(0.1 * dt, 0.1 * span, 20)]
    ranked = rank_starts(grid, lambda q: low_pass(model, dt, q[0], at), ctx.wanted(x, residual), thin(ctx.keep, 8000))
    return ranked[:3]


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("time_constant_s", float(p[0]), "s"), Human("corner_hz", float(1 / (2 * np.pi * p[0])), "Hz"))


FIRST_ORDER_LAG = Effect(
    name="first_order_lag",
    summary="RC or amplifier low-pass",
    kind="linear",
    stages=("amplifier", "actuator", "sensor", "acquisition"),
    parts=_parts,
    equation=r"\tau \dot y + y = x",
    source="A. V. Oppenheim, A. S. Willsky, Signals and Systems, 2nd ed., section 6.5.1",
    excitation="frequencies around 1/(2 pi tau); two of them tell it from a pure delay",
    confusable_with=("dead_time", "resonance", "creep", "slew_limit"),
    prepare=time_settings,
    guess=_guess,
    apply=lambda x, ctx, q, settings: low_pass(x, ctx.dt, q[0], np.array(ctx.starts)),
    report=_report,
    vanishes_with=(("time_constant_s",),),
    essential=("time_constant_s",),
)


# -- AC coupling ------------------------------------------------------------------------------------


def _ac_parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts(
        (
            Parameter("time_constant_s", "s", 2 * dt, 30 * span, log=True, scale=dt),
            Parameter("settled_share", "1", 0.0, 1.0, scale=0.1),
        ),
        (Parameter("zero", "{out}"),),
    )


def _ac_zero(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    """Return the column (n, 1) of the reading of no signal: a zero in front of the high-pass is lost with the mean."""
    return np.ones((ctx.t.size, 1))


def _ac_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    at = np.array(ctx.starts)
    k = np.arange(x.size)
    since = k - at[np.searchsorted(at, k, side="right") - 1]
    slow = low_pass(x, ctx.dt, q[0], at) - (1 - q[1]) * x[k - since] * np.exp(-since * ctx.dt / q[0])
    return x - slow


def _ac_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    dt, span = settings["time"]
    grid: list[tuple[float, ...]] = [(float(t), s) for t in np.geomspace(5 * dt, 20 * span, 24) for s in (1.0, 0.0)]
    return _best(lambda q: _ac_apply(x, ctx, np.array(q), settings), grid, x, residual, ctx)


def _best(
    output: Callable[[tuple[float, ...]], Array], grid: list[tuple[float, ...]], x: Array, residual: Array, ctx: Context
) -> Sequence[Sequence[float]]:
    """Return the three starts of ``grid`` whose output explains the residual best."""
    wanted, k = ctx.wanted(x, residual), thin(ctx.keep, 8000)
    return rank_starts(grid, lambda q: ctx.to_output(output(q)), wanted, k)[:3]


def _twice_parts(settings: Settings) -> Parts:
    once = _ac_parts(settings)
    time_constant, settled = once.nonlinear
    # the names are unique, because twin files distinguish forms by their parameters
    return Parts(
        (
            replace(time_constant, name="period_by_2pi_s"),
            Parameter("damping_ratio", "1", 0.3, 3.0, log=True, scale=0.1),
            settled,
        ),
        once.weights,
    )


def _twice_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    tau, damping, settled = q
    at = np.array(ctx.starts)
    k = np.arange(x.size)
    since = k - at[np.searchsorted(at, k, side="right") - 1]
    ad, g0, g1 = discrete_mode(1 / (2 * np.pi * tau), damping, ctx.dt)
    z = mode(x, ad, np.ascontiguousarray(g0), g1, at)
    # the free response after a start away from rest has two poles; its formula needs them to differ
    apart = damping if abs(damping - 1.0) > 1e-8 else 1.0 + 1e-8
    root = np.sqrt(complex(apart * apart - 1.0))
    r, s = -apart - root, -apart + root
    age = since * ctx.dt / tau
    fall, rise = np.exp(r * age), np.exp(s * age)
    free = np.real((s * fall - r * rise) / (s - r))
    speed = np.real(r * s * (fall - rise) / (s - r))
    unsettled = (1 - settled) * x[k - since]
    return x - (z[0] - unsettled * free) - 2 * damping * (z[1] - unsettled * speed)


def _twice_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    dt, span = settings["time"]
    grid: list[tuple[float, ...]] = [
        (float(t), d, s) for t in np.geomspace(5 * dt, 20 * span, 20) for d in (0.6, 1.1) for s in (1.0, 0.0)
    ]
    return _best(lambda q: _twice_apply(x, ctx, np.array(q), settings), grid, x, residual, ctx)


def _twice_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("corner_hz", float(1 / (2 * np.pi * p[0])), "Hz"), Human("damping_ratio", float(p[1]), "1"))


_ONCE = Effect(
    name="ac_coupling",
    summary="high-pass: the mean is lost",
    kind="linear",
    stages=("amplifier", "acquisition", "sensor"),
    parts=_ac_parts,
    equation=r"\tau \dot y + y = \tau \dot x",
    source="A. V. Oppenheim, A. S. Willsky, Signals and Systems, 2nd ed., section 6.5.1",
    excitation="changes of the mean that last longer than the time constant",
    confusable_with=("creep", "thermal_drift"),
    prepare=time_settings,
    guess=_ac_guess,
    apply=_ac_apply,
    basis=_ac_zero,
    report=_report,
    loses_mean=True,
)
_TWICE = replace(
    _ONCE,
    parts=_twice_parts,
    equation=r"\tau^2 \ddot y + 2 D \tau \dot y + y = \tau^2 \ddot x",
    guess=_twice_guess,
    apply=_twice_apply,
    report=_twice_report,
)
AC_COUPLING = replace(_ONCE, variants=(_TWICE,))
