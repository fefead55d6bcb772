"""Memory whose loop changes with speed: plays with speed-dependent weights, and plays behind a lag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.hysteresis import (
    CYCLE,
    MASING,
    choose,
    loop_width,
    test_cycle,
    way_before,
)  # fmt: skip
from sim_devices.physics.lag import low_pass
from sim_devices.physics.memory import dahl, stops, thresholds
from sim_devices.physics.statistics import smooth

N_PLAYS = 6
N_DAHL = 5


def speed(x: Array, dt: float, usual: float) -> Array:
    """Return the compressed slope of x relative to its usual size: log(1 + |x'|/usual)."""
    slope = smooth(np.gradient(x, dt), 3)
    return np.log1p(np.abs(slope) / usual)


def _columns(x: Array, dt: float, tau: float, settings: Settings, starts: tuple[int, ...]) -> Array:
    lo, hi = settings.get("range", (-1.0, 1.0))
    half = 0.5 * (hi - lo)
    usual = settings.get("usual_slope", (1.0,))[0]
    at = np.array(starts, np.int64)
    rest = settings.get("rest", (0.0,))[0]
    wide = half * np.geomspace(0.1, 3.0, N_DAHL)
    before = way_before(settings)
    # as in hysteresis.columns: the way before the record, and what it left in the elements
    way, begins = (x, at) if before is None else (np.concatenate([[rest, before], x]), np.zeros(1, np.int64))
    e = np.concatenate(
        [
            stops(way, np.array(thresholds(half, N_PLAYS)), rest, begins),
            dahl(way, wide, np.zeros(N_DAHL), rest, begins),
        ],
        axis=1,
    )[way.size - x.size :]
    fast = e.T[::2]
    late = np.stack([low_pass(c, dt, tau, at) - c for c in np.ascontiguousarray(fast)])
    lag = low_pass(x, dt, tau, at) - x
    return np.concatenate([e.T, fast * speed(x, dt, usual), late, lag[None]]).T


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    slope = np.abs(smooth(np.gradient(x, ctx.dt), 3))
    lo, hi = float(x.min()), float(x.max())
    before = choose(x, residual, ctx, lo, hi, MASING).before if hi > lo else None
    settings = {
        "usual_slope": (float(np.sqrt(np.mean(slope[k] ** 2))) or 1.0,),
        "rest": (float(x[0]),),
        "range": (lo, hi),
        "time": (ctx.dt, ctx.dt * ctx.t.size),
    }
    return settings if before is None else settings | {"before": (before,)}


def _parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    n = N_PLAYS + N_DAHL
    m = (n + 1) // 2
    names = [f"w{i + 1}" for i in range(n)] + [f"v{i + 1}" for i in range(m)] + [f"l{i + 1}" for i in range(m)]
    names.append("lag")
    return Parts(
        (Parameter("time_constant_s", "s", 0.2 * dt, 0.1 * span, log=True, scale=dt),),
        tuple(Parameter(a, "{out}/{in}", scale=0.1) for a in names),
        0.05 * np.eye(len(names)),
    )


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    dt, span = settings["time"]
    usual = settings["usual_slope"][0]
    lo, hi = settings["range"]
    period = (hi - lo) / usual  # of the order of a quarter cycle
    grid = (0.02 * period, 0.1 * period, 0.5 * period)
    return tuple((float(np.clip(v, 0.3 * dt, 0.09 * span)),) for v in grid)


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    lo, hi = settings["range"]
    usual = settings["usual_slope"][0]
    x = test_cycle(lo, hi)
    out: list[Human] = []
    # at rest speeds are zero, and what lags has caught up: the first columns alone are left
    for name, factor, columns in (("slow", 0.05, N_PLAYS + N_DAHL), ("fast", 2.0, None)):
        # a triangle of slope factor * usual
        dt = (hi - lo) / (0.5 * CYCLE) / (factor * usual)
        y = scale * x + _columns(x, dt, p[0], settings, (0,))[:, :columns] @ p[1:][:columns]
        out.append(Human(f"loop_width_share_{name}", loop_width(y, 3), "1"))
    widths = [h.value for h in out]
    change = abs(widths[1] - widths[0]) / max(*widths, 1e-12)
    return (*out, Human("change_with_speed", float(change), "1"), Human("time_constant_s", float(p[0]), "s"))


RATE_DEPENDENT_HYSTERESIS = Effect(
    name="rate_dependent_hysteresis",
    summary="memory whose loop changes with speed",
    kind="add",
    stages=("actuator",),
    parts=_parts,
    equation=r"y = x + \sum_i \left(w_i + v_i \ln(1 + |\dot x|/s)\right) E_i + \ell_i (L_\tau E_i - E_i)"
    r" + \ell (L_\tau x - x),\; E_i \text{ as for hysteresis}",
    source="W. T. Ang, P. K. Khosla, C. N. Riviere, IEEE/ASME Trans. Mechatronics 12 (2007) 134, eqs. 12-15;"
    " M. Al Janaideh et al., IEEE Trans. Control Syst. Technol. 17 (2009)",
    excitation="reversals at several amplitudes and at speeds that differ by five or more",
    confusable_with=("hysteresis", "first_order_lag", "creep", "resonance"),
    prepare=_prepare,
    guess=_guess,
    basis=lambda x, ctx, q, settings: _columns(x, ctx.dt, q[0], settings, ctx.starts),
    report=_report,
    # a loop that is as wide at rest as at speed is rate-independent memory; that of a lag closes at rest
    limits={"change_with_speed": (0.08, 0.95)},
    vanishes_with=(("loop_width_share_slow",),),
    plain_without=(("change_with_speed",),),
    plain="hysteresis",
    laws=2,  # a loop and a lag
)
