"""First-order low-pass and high-pass in the signal path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings


@njit(cache=True)
def low_pass(x, dt, tau, starts):
    """y' = (x - y) / tau with x linear between samples, exactly; settled at each start.

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


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    return {"time": (ctx.dt, ctx.dt * ctx.t.size)}


def _apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return low_pass(x, ctx.dt, q[0], np.array(ctx.starts))


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    dx = np.gradient(x, ctx.dt)
    k = ctx.keep
    den = float(dx[k] @ dx[k])
    r = residual[k] - residual[k].mean()
    tau = abs(float(dx[k] @ r) / den) if den > 0 else ctx.dt
    span = ctx.dt * ctx.t.size
    tau = float(np.clip(tau, 0.1 * ctx.dt, 0.1 * span))
    return ((tau,), (min(8 * tau, 0.2 * span),), (0.25 * tau,))


def _probe(x: Array, ctx: Context, settings: Settings) -> Array:
    taus = (2 * ctx.dt, 10 * ctx.dt, 50 * ctx.dt)
    return np.stack([low_pass(x, ctx.dt, t, np.array(ctx.starts)) - x for t in taus], axis=1)


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
    prepare=_prepare,
    guess=_guess,
    apply=_apply,
    probe=_probe,
    report=_report,
)
