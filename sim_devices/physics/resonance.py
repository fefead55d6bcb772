"""A second-order mode in the signal path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Parameter, Parts, Settings, reports, time_settings
from sim_devices.physics.exponential import exponential
from sim_devices.physics.statistics import least_squares, thin


def discrete_mode(frequency_hz: float, damping: float, dt: float) -> tuple[Array, Array, Array]:
    """Return exact (ad, g0, g1) of z'' + 2 D w z' + w^2 z = w^2 x for x linear between samples (Van Loan 1978).

    States are z and z'/w.
    """
    w = 2 * np.pi * frequency_hz
    m = np.zeros((4, 4))
    m[0, 1] = w * dt
    m[1, 0] = -w * dt
    m[1, 1] = -2 * damping * w * dt
    m[1, 2] = w * dt
    m[2, 3] = 1.0
    e = exponential(m)
    return np.ascontiguousarray(e[:2, :2]), e[:2, 2] - e[:2, 3], np.ascontiguousarray(e[:2, 3])


@kernel
def mode(x, ad, g0, g1, starts):
    """Response z and z'/w, (2, n), settled on x at each start."""
    y = np.empty((2, x.size))
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
        y[0, i] = a
        y[1, i] = b
    return y


def _parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts(
        (
            Parameter("frequency_Hz", "Hz", 3 / span, 0.8 / dt, log=True, scale=1 / span),
            Parameter("damping_ratio", "1", 1e-4, 0.71, log=True, scale=0.01),
            Parameter("share", "1", -20.0, 20.0, scale=0.05),
            Parameter("rate_share", "1", -20.0, 20.0, scale=0.05),
        )
    )


def _mode_of(x: Array, ctx: Context, frequency: float, damping: float) -> Array:
    ad, g0, g1 = discrete_mode(frequency, damping, ctx.dt)
    return mode(x, ad, np.ascontiguousarray(g0), g1, np.array(ctx.starts))


def _apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    z = _mode_of(x, ctx, q[0], q[1])
    return x + q[2] * (z[0] - x) + q[3] * z[1]


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    bounds = _parts(settings).nonlinear
    model = ctx.to_output(x)
    k = thin(ctx.keep, 6000)
    wanted = ctx.wanted(x, residual)[k]
    one = np.ones(k.size)

    def tried(frequencies: Array, dampings: Sequence[float]) -> list[tuple[float, tuple[float, ...]]]:
        out: list[tuple[float, tuple[float, ...]]] = []
        for f in frequencies:
            f = float(np.clip(f, 1.01 * bounds[0].lo, 0.99 * bounds[0].hi))
            for d in dampings:
                z = _mode_of(model, ctx, f, d)[:, k]
                w, left = least_squares(np.stack([one, model[k], z[0] - model[k], z[1]], axis=1), wanted)
                g = w[1] or 1.0
                shares = np.clip([w[2] / g, w[3] / g], -19.0, 19.0)
                out.append((left, (f, d, float(shares[0]), float(shares[1]))))
        return sorted(out)

    first = tried(np.geomspace(4 / (ctx.dt * ctx.t.size), 0.7 / ctx.dt, 26), (0.02, 0.15))
    near = first[0][1][0]
    second = tried(near * np.geomspace(0.8, 1.25, 13), (0.005, 0.03, 0.2))
    every = sorted([*second[:2], *first[:3]])
    return [q for _, q in every[:4]]


RESONANCE = Effect(
    name="resonance",
    summary="second-order mode",
    kind="linear",
    stages=("mechanics", "mounting", "sensor"),
    parts=_parts,
    equation=r"y = x + s\,(z - x) + b\,\dot z/\omega,\quad \ddot z + 2 D \omega \dot z + \omega^2 z = \omega^2 x",
    source="D. J. Ewins, Modal Testing, 2nd ed., eq. 2.9",
    excitation="frequencies around the mode; below it, its static part looks like a lag or a lead",
    confusable_with=("first_order_lag", "dead_time", "vibration"),
    prepare=time_settings,
    guess=_guess,
    apply=_apply,
    report=reports(("frequency_Hz", "Hz"), ("damping_ratio", "1"), ("share", "1"), ("rate_share", "1")),
    # more damping makes a lag
    limits={"damping_ratio": (0.0, 0.5)},
    vanishes_with=(("share", "rate_share"),),
    essential=("frequency_Hz",),
)
