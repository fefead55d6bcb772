"""Permanent changes of level: their instants are read off the data and their heights are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import kstwobign

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature
from sim_devices.physics.statistics import after_jumps, least_squares, long_run_rms, robust_rms, whiten

MOST_STEPS = 6


@kernel
def best_split(total, count):
    """Find the split at which two levels fit best: (index, gain in sum of squares) for block sums and counts."""
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
    """Find (samples where the level jumps, largest standardised CUSUM, share explained) by binary segmentation.

    The price of a step is in units of the long-run variance, which is larger for coloured noise.
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
    """Return the steps that stay significant when all are fitted with the level and the gain of ``signal`` (n,).

    A step biases the base parameters. The bias shows as a swing over the whole record, which segmentation would take
    for small steps.
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
    """Return the sample near ``at`` that separates two means best."""
    reach = max(4 * size, 40)
    a, b = max(0, at - reach), min(residual.size, at + reach)
    k = keep[a:b]
    split, gain = best_split(np.where(k, residual[a:b], 0.0), k.astype(np.float64))
    return a + int(split) if gain > 0 else at


def _step_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    cuts, _, _ = find_steps(residual, ctx.keep)
    cuts = paying_steps(residual, ctx.keep, cuts, ctx.to_output(x))
    if ctx.everywhere is not None:
        # the masked samples show that there is a step; its instant within a gap is read from the gap itself
        cuts = [_in_gap(ctx.everywhere, ctx.keep, c) for c in cuts]
    # several cuts of a slow change may meet in one gap
    return {"times_s": tuple(float(ctx.t[c]) for c in sorted(set(cuts))), "time": (ctx.dt, ctx.dt * ctx.t.size)}


def _in_gap(everywhere: Array, keep: np.ndarray, at: int) -> int:
    """Return the cut, moved to its best place inside the gap that it touches, if it touches one."""
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
    """Test the largest CUSUM against the Brownian bridge (Kolmogorov's distribution)."""
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


_LEVELS = Effect(
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
    vanishes_with=(("step[0-9]*",),),
)

# -- steps seen by their edges ----------------------------------------------------------------------

SHARP = 8.0  # robust rms of the innovations that an edge must reach
STAYS = 12  # samples for which the new level must last
CHANCE = 0.4  # that an outlier of noise with a memory of ten samples stays so long (simulated, tails as below)
TAIL = 4.0  # power by which the tail of the null falls: Student's t with 4 degrees of freedom
_EDGE = "edge_s"


def edges(residual: Array, ctx: Context) -> tuple[list[int], float]:
    """Find (samples at which the residual jumps and stays, least innovation there over the largest elsewhere).

    The list is empty when there are many jumps, because a change of level is rare. Levels alone also respond to slow
    changes, which wrong base parameters cause; at an edge the level changes by as much as the residual jumps.
    """
    whole = ctx.everywhere if ctx.everywhere is not None else residual
    keep = np.ones(whole.size, np.bool_) if ctx.everywhere is not None else ctx.keep
    w = whiten(whole, keep, 4)
    scale = robust_rms(w[keep])
    if scale == 0.0 or whole.size < 20 * STAYS:
        return [], 0.0
    lively = after_jumps(ctx.signals.values(), whole.size, 0.1)
    found: list[tuple[float, int]] = []
    for k in np.flatnonzero((np.abs(w) > SHARP * scale) & keep & ~lively):
        if k < STAYS or k + STAYS > whole.size or (found and k - found[-1][1] < STAYS):
            continue
        jump = whole[k] - whole[k - 1]
        stays = np.median(whole[k + 4 : k + STAYS]) - np.median(whole[k - STAYS + 4 : k])
        if 0.5 * abs(jump) < np.sign(jump) * stays < 2.0 * abs(jump):
            found.append((abs(float(w[k])) / scale, int(k)))
    if not 0 < len(found) <= 2 * MOST_STEPS:
        return [], 0.0
    top = sorted(found, reverse=True)[:MOST_STEPS]
    rest = np.abs(w) / scale
    for _, k in top:
        rest[max(0, k - 2) : k + STAYS] = 0.0
    return sorted(k for _, k in top), top[-1][0] / max(float(np.max(rest[keep & ~lively])), 1e-12)


def _edge_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    cuts, _ = edges(residual, ctx)
    return {"times_s": tuple(float(ctx.t[c]) for c in cuts), "time": (ctx.dt, ctx.dt * ctx.t.size)}


def _edge_parts(settings: Settings) -> Parts:
    # the name is unique, because twin files distinguish forms by their parameters
    parts = _step_parts(settings)
    rise = parts.nonlinear[0]
    return Parts(
        (replace(rise, name=_EDGE, hi=min(rise.hi, 2.0 * settings.get("time", (1e-3, 1.0))[0])),), parts.weights
    )


def _edge_test(x: Array, residual: Array, ctx: Context) -> Signature:
    """Test edges against heavy-tailed noise.

    The p value estimates the chance that noise has as many outliers that exceed all others and that all persist."""
    cuts, above = edges(residual, ctx)
    if not cuts:
        return Signature(1.0, 0.0, "no edge")
    e = residual[ctx.keep] - residual[ctx.keep].mean()
    rows = np.flatnonzero(ctx.keep)
    columns = np.column_stack([np.ones(rows.size), ctx.to_output(x)[rows], *((rows >= c).astype(float) for c in cuts)])
    power = float(e @ e)
    share = 1 - least_squares(columns, e)[1] / power if power > 0 else 0.0
    p = min(1.0, (CHANCE * above**-TAIL) ** len(cuts))
    return Signature(p, max(share, 0.0), f"{len(cuts)} edges")


_EDGES = replace(
    _LEVELS,
    parts=_edge_parts,
    equation=r"y = x + \sum_i h_i\,\theta(t - t_i),\; t_i \text{ at sharp edges}",
    prepare=_edge_prepare,
    guess=lambda x, residual, ctx, settings: ((0.5 * ctx.dt,),),
    test=_edge_test,
)
STEP_SHIFT = replace(_LEVELS, variants=(_EDGES,))
