"""Changes of level that no recorded signal explains: steps and random walk."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import kstwobign, norm

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature
from sim_devices.physics.statistics import long_run_rms, runs

# -- level steps ------------------------------------------------------------------------------------

MOST_STEPS = 6


@kernel
def best_split(total, count):
    """Where two levels fit best: (index, gain in sum of squares) for block sums and counts."""
    n = total.size
    s = 0.0
    c = 0.0
    ss = total.sum()
    cc = count.sum()
    best = 0
    gain = 0.0
    for i in range(n - 1):
        s += total[i]
        c += count[i]
        if c <= 0.0 or cc - c <= 0.0:
            continue
        d = s / c - (ss - s) / (cc - c)
        g = d * d * c * (cc - c) / cc
        if g > gain:
            gain = g
            best = i + 1
    return best, gain


def find_steps(residual: Array, keep: np.ndarray) -> tuple[list[int], float, float]:
    """(samples where the level jumps, largest standardised CUSUM, share explained), by binary segmentation.

    The price of a step is in units of the long-run variance, which coloured noise has more of.
    """
    e = np.where(keep, residual, 0.0)
    n = e.size
    # a residual that mostly stands still has no long-run variance: then its whole rms, however little, is the scale
    sigma = long_run_rms(residual[keep]) or float(np.std(residual[keep])) or 1.0
    size = max(1, n // 4000)
    m = n // size
    total = e[: m * size].reshape(m, size).sum(axis=1)
    count = keep[: m * size].reshape(m, size).sum(axis=1).astype(np.float64)
    cuts: list[int] = []
    pieces = [(0, m)]
    top = 0.0
    price = 2.0 * np.log(max(m, 10)) + 6.0
    explained = 0.0
    while pieces and len(cuts) < MOST_STEPS:
        scored = [(best_split(total[a:b], count[a:b]), a, b) for a, b in pieces if b - a >= 8]
        if not scored:
            break
        (at, gain), a, b = max(scored, key=lambda s: s[0][1])
        z = gain / sigma**2
        top = max(top, float(np.sqrt(z)))
        if z < price:
            break
        cuts.append(a + at)
        explained += gain
        pieces.remove((a, b))
        pieces += [(a, a + at), (a + at, b)]
    power = float(np.sum((residual[keep] - residual[keep].mean()) ** 2))
    refined = sorted(_refine(residual, keep, c * size, size) for c in cuts)
    return refined, top, min(1.0, explained / power) if power > 0 else 0.0


LEAST_HEIGHT = 5.0  # standard errors of a step in the joint fit of all


def paying_steps(residual: Array, keep: np.ndarray, cuts: Sequence[int], signal: Array) -> list[int]:
    """Steps that stand when all are fitted together with the level and the gain of ``signal`` (n,).

    Base parameters that a step has bent leave a swing all over the record, which segmentation takes for small steps.
    """
    cuts = list(cuts)
    e = residual[keep]
    while len(cuts) > 1:
        rows = np.flatnonzero(keep)
        columns = np.column_stack([np.ones(rows.size), signal[keep], *((rows >= c).astype(float) for c in cuts)])
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        columns = columns / size
        gram = np.linalg.pinv(columns.T @ columns, rcond=1e-10)
        height = gram @ (columns.T @ e)
        left = e - columns @ height
        error = max(long_run_rms(left), 1e-300) * np.sqrt(np.maximum(np.diag(gram), 1e-300))
        weight = np.abs(height[2:]) / error[2:]
        weakest = int(np.argmin(weight))
        if weight[weakest] > LEAST_HEIGHT:
            break
        del cuts[weakest]
    return cuts


def _refine(residual: Array, keep: np.ndarray, at: int, size: int) -> int:
    """The sample where two means around ``at`` part best."""
    reach = max(4 * size, 40)
    a, b = max(0, at - reach), min(residual.size, at + reach)
    k = keep[a:b]
    split, gain = best_split(np.where(k, residual[a:b], 0.0), k.astype(np.float64))
    return a + int(split) if gain > 0 else at


def _step_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    cuts, _, _ = find_steps(residual, ctx.keep)
    cuts = paying_steps(residual, ctx.keep, cuts, ctx.to_output(x))
    if ctx.everywhere is not None:
        # that there is a step is known from the mask; where in a gap of it, only the gap can say
        cuts = [_in_gap(ctx.everywhere, ctx.keep, c) for c in cuts]
    return {"times_s": tuple(float(ctx.t[c]) for c in cuts), "time": (ctx.dt, ctx.dt * ctx.t.size)}


def _in_gap(everywhere: Array, keep: np.ndarray, at: int) -> int:
    """The cut moved to where it fits best inside the gap that it touches, if it touches one."""
    reach = 40
    near = np.flatnonzero(~keep[max(0, at - reach) : at + reach])
    if near.size == 0:
        return at
    i = max(0, at - reach) + int(near[np.argmin(np.abs(near - reach))])
    a, b = i, i
    while a > 0 and not keep[a - 1]:
        a -= 1
    while b < keep.size and not keep[b]:
        b += 1
    margin = max(20, (b - a) // 4)
    lo, hi = max(0, a - margin), min(keep.size, b + margin)
    split, gain = best_split(everywhere[lo:hi].copy(), np.ones(hi - lo))
    return lo + int(split) if gain > 0 else at


def _step_parts(settings: Settings) -> Parts:
    n = len(settings.get("times_s", ()))
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts(
        (Parameter("rise_s", "s", 0.1 * dt, max(2 * dt, 0.02 * span), log=True, scale=dt),),
        tuple(Parameter(f"step{i + 1}", "{out}") for i in range(n)),
    )


def _step_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    times = settings.get("times_s", ())
    if not times:
        return np.zeros((ctx.t.size, 0))
    return np.stack([np.clip((ctx.t - s) / q[0] + 0.5, 0.0, 1.0) for s in times], axis=1)


def _step_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    p = _step_parts(settings).nonlinear[0]
    return ((0.5 * ctx.dt,), (float(np.sqrt(ctx.dt * p.hi)),))


def _step_test(x: Array, residual: Array, ctx: Context) -> Signature:
    """Largest CUSUM against the Brownian bridge (Kolmogorov's distribution)."""
    e = residual[ctx.keep]
    if e.size < 50:
        return Signature(1.0, 0.0)
    e = e - e.mean()
    sigma = max(long_run_rms(e), 1e-300)
    peak = float(np.max(np.abs(np.cumsum(e)))) / (sigma * np.sqrt(e.size))
    cuts, _, share = find_steps(residual, ctx.keep)
    return Signature(float(kstwobign.sf(peak)) if cuts else 1.0, share, f"{len(cuts)} level changes")


def _step_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    times = settings.get("times_s", ())
    out = [Human("steps", float(len(times)), "1")]
    for i, (s, h) in enumerate(zip(times, p[1:], strict=True)):
        out += [Human(f"time{i + 1}_s", s, "s"), Human(f"step{i + 1}", float(h), "{out}")]
    return out


STEP_SHIFT = Effect(
    name="step_shift",
    summary="the level jumps once or a few times and stays",
    kind="add",
    stages=("mounting", "sensor", "acquisition"),
    parts=_step_parts,
    equation=r"y = x + \sum_i h_i\,\theta(t - t_i)",
    source="E. S. Page, Biometrika 41 (1954) 100 (CUSUM); A. J. Scott, M. Knott, Biometrics 30 (1974) 507",
    excitation="time before and after the jump",
    confusable_with=("random_walk", "thermal_drift", "spikes"),
    prepare=_step_prepare,
    guess=_step_guess,
    basis=_step_basis,
    test=_step_test,
    report=_step_report,
    driven=False,
    sites=("output",),
)

# -- random walk ------------------------------------------------------------------------------------

KNOTS = 48
MOST_VALUES = 60_000_000  # columns times samples: half a gigabyte


def hats(t: Array, knots: Array) -> Array:
    """Linear interpolation between knots, one column each, (n, knots); held outside."""
    out = np.zeros((t.size, knots.size))
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
    f = np.clip((t - knots[i]) / (knots[i + 1] - knots[i]), 0.0, 1.0)
    rows = np.arange(t.size)
    out[rows, i] = 1 - f
    out[rows, i + 1] += f
    return out


def knots_over(t: Array, keep: np.ndarray, count: int) -> tuple[float, ...]:
    """Knots evenly spread over the kept samples, so that every hat sees data; a gap has one at each edge."""
    kept = t[keep]
    at = np.unique(np.round(np.linspace(0, kept.size - 1, count)).astype(int))
    return tuple(float(v) for v in kept[at])


def increments(residual: Array, keep: np.ndarray, dt: float) -> tuple[float, float, float, int]:
    """(white rms per sample, walk in unit/sqrt(s), z of the walk, block length) from block-mean differences.

    Var of the difference of neighbouring means of m samples: 2 s^2/m + q m dt (2/3). Two block lengths that differ
    by 16 separate the two (Allan variance slopes -1/2 and +1/2, IEEE Std 952-2020, annex C).
    """
    found: list[tuple[int, float, int]] = []
    stretches = runs(keep)
    n = int(keep.sum())
    for m in np.unique(np.geomspace(max(1, n // 4000), max(2, n // 24), 10).astype(int)):
        d: list[Array] = []
        for a, b in stretches:
            c = (b - a) // m
            if c > 1:
                d.append(np.diff(residual[a : a + c * m].reshape(c, m).mean(axis=1)))
        if d:
            every = np.concatenate(d)
            if every.size > 6:
                found.append((int(m), float(np.mean(every**2)), every.size))
    if len(found) < 4:
        return float(np.std(residual[keep])), 0.0, 0.0, 1
    m = np.array([f[0] for f in found], np.float64)
    v = np.array([f[1] for f in found])
    w = np.sqrt([f[2] for f in found]) / v
    cols = np.stack([2 / m, 2 / 3 * m * dt], axis=1) * w[:, None]
    gram = np.linalg.pinv(cols.T @ cols)
    s2, q = gram @ cols.T @ (v * w)
    z = q / max(float(np.sqrt(gram[1, 1] * 2)), 1e-300)
    return float(np.sqrt(max(s2, 0.0))), float(np.sqrt(max(q, 0.0))), float(z), int(m[-1])


def _walk_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    white, walk, _, _ = increments(residual, ctx.keep, ctx.dt)
    n = int(np.clip(min(KNOTS, MOST_VALUES // ctx.t.size), 4, max(4, ctx.t.size // 20)))
    return {"walk": (walk,), "white": (white,), "knots_s": knots_over(ctx.t, ctx.keep, n)}


def _walk_parts(settings: Settings) -> Parts:
    knots = settings.get("knots_s", (0.0, 1.0))
    n = len(knots)
    return Parts((), tuple(Parameter(f"level{i + 1}", "{out}") for i in range(n)), 8.0 * np.diff(np.eye(n), axis=0))


def _walk_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return hats(ctx.t, np.array(settings.get("knots_s", (0.0, 1.0))))


def growth(residual: Array, keep: np.ndarray, short: int = 64, long: int = 16) -> float:
    """How the mean square difference of neighbouring block means grows from blocks of n / ``short`` to n / ``long``: by
    the ratio of the lengths (4) for a walk, its inverse for noise that forgets within a block, its square for what is
    smooth, near 1 for noise that forgets within n/60. 0 where nothing can be said.
    """
    n = residual.size
    total = np.concatenate([[0.0], np.cumsum(np.where(keep, residual, 0.0))])
    count = np.concatenate([[0.0], np.cumsum(keep)])

    def level(m: int) -> float:
        at = np.arange(0, n - 2 * m + 1, max(1, m // 4))
        c0, c1 = count[at + m] - count[at], count[at + 2 * m] - count[at + m]
        seen = (c0 > 0.4 * m) & (c1 > 0.4 * m)
        if seen.sum() < 4:
            return np.nan
        at, c0, c1 = at[seen], c0[seen], c1[seen]
        d = (total[at + 2 * m] - total[at + m]) / c1 - (total[at + m] - total[at]) / c0
        return float(np.mean(d * d))

    near, far = level(max(2, n // short)), level(max(4, n // long))
    return far / near if near > 0 and np.isfinite(far) else 0.0


LEAST_GROWTH = 1.7
CLEAR_GROWTH = 5.5  # from n/512 to n/64: a walk has 8,
MOST_GROWTH = 24.0  # what is smooth 64


def _walk_test(x: Array, residual: Array, ctx: Context) -> Signature:
    white, walk, z, _ = increments(residual, ctx.keep, ctx.dt)
    # many short blocks say more than few long ones, from which base parameters have taken their part
    short = growth(residual, ctx.keep, 512, 64) if residual.size >= 2048 else 0.0
    if short > MOST_GROWTH:
        return Signature(1.0, 0.0, "smooth: a walk is rough at every scale")
    if short < CLEAR_GROWTH and 0.0 < growth(residual, ctx.keep) < LEAST_GROWTH:
        return Signature(1.0, 0.0, "stationary: it forgets within a fraction of the record")
    e = residual[ctx.keep]
    power = float(np.var(e))
    share = min(1.0, max(0.0, 1 - white**2 / power)) if power > 0 else 0.0
    return Signature(float(norm.sf(z)) if walk > 0 else 1.0, share, f"walk {walk:.3g} per sqrt(s)")


def _walk_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("walk_per_sqrt_s", float(settings["walk"][0]), "{out}/s^0.5"),
        Human("range", float(np.ptp(p)) if p.size else 0.0, "{out}"),
    )


RANDOM_WALK = Effect(
    name="random_walk",
    summary="integrated noise: drift without a shape",
    kind="add",
    stages=("sensor", "environment"),
    parts=_walk_parts,
    equation=r"y = x + \sum_i \ell_i h_i(t),\quad \ell_{i+1} - \ell_i \sim N(0, q^2 \Delta)",
    source="IEEE Std 952-2020, annex C (rate random walk); B. D. O. Anderson, J. B. Moore, Optimal Filtering, ch. 7",
    excitation="a long record",
    confusable_with=("thermal_drift", "step_shift", "temperature_sensitivity"),
    prepare=_walk_prepare,
    basis=_walk_basis,
    test=_walk_test,
    report=_walk_report,
    driven=False,
    sites=("output",),
    stochastic=True,
)
