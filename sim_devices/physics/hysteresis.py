"""Rate-independent memory: a superposition of play operators (Prandtl-Ishlinskii)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings

N_PLAYS = 10


@njit(cache=True)
def stops(x, thresholds, rest, starts):
    """Stop operators E_r[x] = x - P_r[x] of the play operator P_r, (n, k); |E_r| <= r.

    P_r(t) = max(x - r, min(x + r, P_r(t-)))  (Kuhnen 2003, eq. 2); memory starts at ``rest`` at each start.
    """
    n, k = x.size, thresholds.size
    out = np.empty((n, k))
    p = np.empty(k)
    s = 0
    for i in range(n):
        if s < starts.size and i == starts[s]:
            s += 1
            for j in range(k):
                p[j] = rest
        v = x[i]
        for j in range(k):
            r = thresholds[j]
            if p[j] < v - r:
                p[j] = v - r
            elif p[j] > v + r:
                p[j] = v + r
            out[i, j] = v - p[j]
    return out


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    lo, hi = float(x[k].min()), float(x[k].max())
    half = 0.5 * (hi - lo) or 1.0
    r = half * (np.arange(1, N_PLAYS + 1) / (N_PLAYS + 0.5))
    return {"thresholds": tuple(float(v) for v in r), "range": (lo, hi), "rest": (float(x[0]),)}


def _parts(settings: Settings) -> Parts:
    r = settings.get("thresholds", (1.0,))
    weights = tuple(Parameter(f"w{i + 1}", "{out}/{in}", scale=0.1) for i in range(len(r)))
    return Parts((), weights, 0.05 * np.eye(len(r)))


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return stops(x, np.array(settings.get("thresholds", (1.0,))), settings.get("rest", (0.0,))[0], np.array(ctx.starts))


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    lo, hi = settings["range"]
    t = np.linspace(0.0, 2.0, 801)
    cycle = 0.5 * (lo + hi) - 0.5 * (hi - lo) * np.cos(2 * np.pi * t)
    y = scale * cycle + stops(cycle, np.array(settings["thresholds"]), lo, np.zeros(1, np.int64)) @ p
    up, down = y[400:601], y[600:801][::-1]
    span = float(np.ptp(y)) or 1.0
    return (Human("loop_width_share", float(np.max(np.abs(down - up[: down.size])) / span), "1"),)


HYSTERESIS = Effect(
    name="hysteresis",
    summary="rate-independent memory: the loop does not change with speed",
    kind="add",
    stages=("actuator", "sensor"),
    parts=_parts,
    equation=r"y = x + \sum_i w_i\,(x - P_{r_i}[x])",
    source="K. Kuhnen, Eur. J. Control 9 (2003) 407, eqs. 2-5; M. Brokate, J. Sprekels, Hysteresis and Phase Transitions",
    excitation="reversals at several amplitudes; speeds that differ tell it from rate-dependent memory",
    confusable_with=("backlash", "rate_dependent_hysteresis", "creep", "first_order_lag", "dead_time"),
    prepare=_prepare,
    basis=_basis,
    report=_report,
)
