"""Rate-independent memory: play operators (Prandtl-Ishlinskii), with loops that may depend on position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.statistics import least_squares, thin

N_PLAYS = 10
N_BENT = 5  # elements whose weight may vary along the range


@njit(cache=True)
def stops(x, thresholds, rest, starts):
    """Stop operators E_r[x] = x - P_r[x] of the play operator P_r, (n, k); |E_r| <= r.

    P_r(t) = max(x - r, min(x + r, P_r(t-)))  (Kuhnen 2003, eq. 2); memory starts at ``rest`` at each start.
    """
    n, k = x.size, thresholds.size
    out = np.empty((k, n))
    for j in range(k):
        r = thresholds[j]
        s = 0
        p = rest
        for i in range(n):
            if s < starts.size and i == starts[s]:
                s += 1
                p = rest
            v = x[i]
            p = max(v - r, min(v + r, p))
            out[j, i] = v - p
    return out.T


def thresholds(half: float, count: int) -> tuple[float, ...]:
    """Denser at small radii, where loops turn: half times ((i)/(n + 1/2))^1.5."""
    return tuple(float(half * (i / (count + 0.5)) ** 1.5) for i in range(1, count + 1))


def columns(x: Array, radii: Array, rest: float, lo: float, hi: float, bent: int, starts: tuple[int, ...]) -> Array:
    """Stops (n, k), then every second one times the normalised input and its square (``bent`` 1 or 2)."""
    e = stops(x, radii, rest, np.array(starts, np.int64))
    if bent == 0:
        return e
    z = np.clip((x - 0.5 * (lo + hi)) / (0.5 * (hi - lo)), -1.2, 1.2)[:, None]
    some = e[:, 1::2][:, :N_BENT]
    parts = [e, some * z]
    if bent > 1:
        parts.append(some * z * z)
    return np.concatenate(parts, axis=1)


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    lo, hi = float(x[k].min()), float(x[k].max())
    half = 0.5 * (hi - lo) or 1.0
    radii = np.array(thresholds(half, N_PLAYS))
    index = thin(k, 8000)
    r = residual[index]
    straight = np.stack([np.ones(index.size), ctx.to_output(x)[index]], axis=1)
    full = columns(x, radii, float(x[0]), lo, hi, 2, ctx.starts)
    if ctx.through is not None:
        full = np.stack([ctx.to_output(c) for c in full.T], axis=1)
    full = full[index]
    best: tuple[float, int] | None = None
    n = max(index.size / 10.0, 40.0)  # coloured residuals: one sample in ten counts
    for bent in (0, 1, 2):
        count = N_PLAYS + bent * N_BENT
        rss = least_squares(np.column_stack([straight, full[:, :count]]), r)[1]
        score = n * np.log(max(rss, 1e-300)) + count * np.log(n)
        if best is None or score < best[0] - 6.0:
            best = (score, bent)
    assert best is not None
    return {
        "thresholds": tuple(float(v) for v in radii),
        "range": (lo, hi),
        "rest": (float(x[0]),),
        "bent": (float(best[1]),),
    }


def _parts(settings: Settings) -> Parts:
    count = len(settings.get("thresholds", (1.0,)))
    bent = int(settings.get("bent", (0.0,))[0])
    names = [f"w{i + 1}" for i in range(count)]
    for b in range(1, bent + 1):
        names += [f"w{2 * i + 2}z{b}" for i in range(len(range(1, count, 2)[:N_BENT]))]
    weights = tuple(Parameter(m, "{out}/{in}", scale=0.1) for m in names)
    return Parts((), weights, 0.05 * np.eye(len(names)))


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    lo, hi = settings.get("range", (-1.0, 1.0))
    return columns(
        x,
        np.array(settings.get("thresholds", (1.0,))),
        settings.get("rest", (0.0,))[0],
        lo,
        hi,
        int(settings.get("bent", (0.0,))[0]),
        ctx.starts,
    )


def loop_width(y_of: Array, turns: int) -> float:
    """Largest distance of the two branches over the last of ``turns`` equal cycles, relative to the span."""
    n = y_of.size // turns
    last = y_of[-n:]
    up, down = last[: n // 2 + 1], last[n // 2 :]
    m = min(up.size, down.size)
    span = float(np.ptp(last)) or 1.0
    return float(np.max(np.abs(up[:m] - down[::-1][:m])) / span)


def test_cycle(lo: float, hi: float) -> Array:
    """Three slow triangles over the range, 201 samples a cycle."""
    t = np.arange(603) / 201.0
    return lo + (hi - lo) * (1 - np.abs(2 * (t % 1.0) - 1))


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    lo, hi = settings["range"]
    x = test_cycle(lo, hi)
    radii = np.array(settings["thresholds"])
    y = scale * x + columns(x, radii, lo, lo, hi, int(settings.get("bent", (0.0,))[0]), (0,)) @ p
    return (Human("loop_width_share", loop_width(y, 3), "1"),)


def _force_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    half = 0.5 * float(np.ptp(x[k])) or 1.0
    return {"thresholds": tuple(float(half * f) for f in (0.01, 0.03, 0.1, 0.3, 0.6))}


def _force_parts(settings: Settings) -> Parts:
    n = len(settings.get("thresholds", (1.0,)))
    return Parts((), tuple(Parameter(f"k{i + 1}", "{out}/s^2/{out}") for i in range(n)), 0.05 * np.eye(n))


def _force_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return -stops(x, np.array(settings.get("thresholds", (1.0,))), float(x[0]), np.array(ctx.starts, np.int64))


def _force_fill(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    return {"thresholds": np.array(settings["thresholds"]), "memory": np.asarray(w)}


def _force_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    level = float(p @ np.array(settings["thresholds"])) / g
    return (
        Human("force_loop_half_height", level, "{in}"),
        Human("presliding_stiffness", float(p.sum()) / g, "{in}/{out}"),
    )


_FORCE = Effect(
    name="hysteresis",
    summary="elastic-plastic elements on the position (Maxwell-slip)",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_force_parts,
    equation=r"m\ddot x + c\dot x + k x = F - \sum_i k_i\,(x - P_{r_i}[x])",
    source="W. D. Iwan, J. Applied Mechanics 33 (1966) 893, eq. 3; F. Al-Bender et al., IEEE Trans. AC 50 (2005) 1883",
    excitation="reversals of motion at several amplitudes",
    prepare=_force_prepare,
    basis=_force_basis,
    fill=_force_fill,
    report=_force_report,
)

HYSTERESIS = Effect(
    name="hysteresis",
    summary="rate-independent memory: the loop does not change with speed",
    kind="add",
    stages=("actuator", "sensor"),
    parts=_parts,
    equation=r"y = x + \sum_i w_i(\tilde x)\,(x - P_{r_i}[x])",
    source="K. Kuhnen, Eur. J. Control 9 (2003) 407, eqs. 2-5; M. Al Janaideh et al., Smart Mater. Struct. 18 (2009) 045001",
    excitation="reversals at several amplitudes; speeds that differ tell it from rate-dependent memory",
    confusable_with=("backlash", "rate_dependent_hysteresis", "creep", "first_order_lag", "dead_time"),
    prepare=_prepare,
    basis=_basis,
    report=_report,
    variants=(_FORCE,),
)
