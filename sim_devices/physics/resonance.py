"""A second-order mode in the signal path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from scipy.linalg import expm
from scipy.signal import csd, welch

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings


def discrete_mode(frequency_hz: float, damping: float, dt: float) -> tuple[Array, Array, Array]:
    """(ad, g0, g1) of z'' + 2 D w z' + w^2 z = w^2 x for x linear between samples, exactly (Van Loan 1978).

    States are z and z'/w.
    """
    w = 2 * np.pi * frequency_hz
    m = np.zeros((4, 4))
    m[0, 1] = w * dt
    m[1, 0] = -w * dt
    m[1, 1] = -2 * damping * w * dt
    m[1, 2] = w * dt
    m[2, 3] = 1.0
    e = expm(m)
    return np.ascontiguousarray(e[:2, :2]), e[:2, 2] - e[:2, 3], np.ascontiguousarray(e[:2, 3])


@njit(cache=True)
def mode(x, ad, g0, g1, starts):
    """Response z (n,) settled on x at each start."""
    y = np.empty_like(x)
    s = 0
    a = 0.0
    b = 0.0
    for i in range(x.size):
        if s < starts.size and i == starts[s]:
            s += 1
            a = x[i]
            b = 0.0
        else:
            c = ad[0, 0] * a + ad[0, 1] * b + g0[0] * x[i - 1] + g1[0] * x[i]
            b = ad[1, 0] * a + ad[1, 1] * b + g0[1] * x[i - 1] + g1[1] * x[i]
            a = c
        y[i] = a
    return y


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    return {"time": (ctx.dt, ctx.dt * ctx.t.size)}


def _parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts(
        (
            Parameter("frequency_Hz", "Hz", 3 / span, 0.8 / dt, log=True, scale=1 / span),
            Parameter("damping_ratio", "1", 1e-4, 2.0, log=True, scale=0.01),
            Parameter("share", "1", -1.0, 2.0, scale=0.05),
        )
    )


def _apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    ad, g0, g1 = discrete_mode(q[0], q[1], ctx.dt)
    z = mode(x, ad, g0, g1, np.array(ctx.starts))
    return x + q[2] * (z - x)


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    bounds = _parts(settings).nonlinear[0]
    model = ctx.to_output(x - x.mean())
    n = x.size
    length = int(min(n, max(256, n // 16)))
    f, cross = csd(model, residual, 1 / ctx.dt, nperseg=length)
    _, power = welch(model, 1 / ctx.dt, nperseg=length)
    explained = np.abs(cross) ** 2 / np.maximum(power, 1e-12 * power.max())
    explained[:2] = 0.0
    found: list[tuple[float, float, float]] = []
    order = np.argsort(explained)[::-1]
    peaks: list[float] = []
    for i in order:
        if all(abs(f[i] - g) > 3 * f[1] for g in peaks):
            peaks.append(float(f[i]))
        if len(peaks) == 2:
            break
    strong = f[power > 1e-4 * power.max()]
    top = float(strong.max()) if strong.size else float(f[-1])
    # a resonance above the excitation shows as a gain that grows with frequency
    for g in dict.fromkeys((*peaks, 1.5 * top, 4 * top)):
        g = float(np.clip(g, 1.01 * bounds.lo, 0.99 * bounds.hi))
        for d in (0.03, 0.3):
            found.append((g, d, 1.0))
    return tuple(found)


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("frequency_Hz", float(p[0]), "Hz"),
        Human("damping_ratio", float(p[1]), "1"),
        Human("share", float(p[2]), "1"),
    )


RESONANCE = Effect(
    name="resonance",
    summary="second-order mode",
    kind="linear",
    stages=("mechanics", "mounting", "sensor"),
    parts=_parts,
    equation=r"y = x + s\,(z - x),\quad \ddot z + 2 D \omega \dot z + \omega^2 z = \omega^2 x",
    source="D. J. Ewins, Modal Testing, 2nd ed., eq. 2.9",
    excitation="frequencies around the mode; below it, its static part looks like a lag or a lead",
    confusable_with=("first_order_lag", "dead_time", "vibration"),
    prepare=_prepare,
    guess=_guess,
    apply=_apply,
    report=_report,
)
