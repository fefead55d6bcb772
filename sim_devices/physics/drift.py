"""Integrated noise: a drift that no recorded signal explains and no shape describes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature
from sim_devices.physics.statistics import robust_rms, runs

Law = Callable[[float], tuple[Array, Array]]

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
    """Estimate (white rms per sample, walk in unit/sqrt(s), z of the walk, block length) from block-mean differences.

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


def growth(residual: Array, keep: np.ndarray, short: int = 64, long: int = 16) -> float:
    """Return the growth of the mean square difference of adjacent block means from short blocks to long ones.

    The blocks have n / ``short`` and n / ``long`` samples. The growth is the ratio of the lengths (4) for a random
    walk, its inverse for noise whose correlation time is below a block, its square for a smooth signal, and near 1 for
    noise that decorrelates within n/60. It is 0 where it cannot be computed.
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


@kernel
def local_level(residual, gap_s, believed, ratio, forgets_1_s):
    """Return the one-step prediction errors and their deviations, both (n,), of a walk under white noise of unit rms.

    The variance of the walk grows by ``ratio`` a second, and the walk returns to zero at the rate ``forgets_1_s``
    (0: never). A. C. Harvey, Forecasting, Structural Time Series Models (1989), eq. 4.1.2. The first valid sample sets
    the level, and its own error is zero.
    """
    n = residual.size
    error = np.zeros(n)
    deviation = np.ones(n)
    level = 0.0
    spread = -1.0
    for i in range(n):
        if spread < 0.0:
            if believed[i]:
                level = residual[i]
                spread = 1.0
            continue
        if forgets_1_s > 0.0:
            kept = np.exp(-forgets_1_s * gap_s[i])
            level *= kept
            spread = kept * kept * spread + ratio * (1.0 - kept * kept) / (2.0 * forgets_1_s)
        else:
            spread += ratio * gap_s[i]
        variance = spread + 1.0
        error[i] = residual[i] - level
        deviation[i] = np.sqrt(variance)
        if believed[i]:
            gain = spread / variance
            level += gain * error[i]
            spread = gain
    return error, deviation


@kernel
def local_slope(residual, gap_s, believed, ratio):
    """Return one-step errors and deviations, as ``local_level`` does, of an integrated walk.

    The slope walks; its variance grows by ``ratio`` a second (Harvey 1989, eq. 2.3.27).
    """
    n = residual.size
    error = np.zeros(n)
    deviation = np.ones(n)
    level = slope = 0.0
    # covariance of level and slope; a slope is not known before the second sample
    p11 = p12 = p22 = 0.0
    seen = 0
    for i in range(n):
        if seen == 0:
            if believed[i]:
                level, p11, p12, p22 = residual[i], 1.0, 0.0, 1e6 * ratio + 1e-12
                seen = 1
            continue
        g = gap_s[i]
        level += g * slope
        p11 += 2.0 * g * p12 + g * g * p22 + ratio * g * g * g / 3.0
        p12 += g * p22 + 0.5 * ratio * g * g
        p22 += ratio * g
        variance = p11 + 1.0
        error[i] = residual[i] - level
        deviation[i] = np.sqrt(variance)
        if believed[i]:
            k1, k2 = p11 / variance, p12 / variance
            level += k1 * error[i]
            slope += k2 * error[i]
            p22 -= k2 * p12
            p12 -= k2 * p11
            p11 = k1
    return error, deviation


RATIOS = (-6.0, 6.0)
"""Search range, in decades, of the growth of a walk's variance within one sample over that of the white noise."""
OUTLIER = 6.0
"""Size, in robust rms, beyond which an error counts as an outlier."""
FORGETS = (0.001, 0.01, 0.1)
"""Correlation times of the stationary rivals of a walk, in lengths of the record."""


def likeliest(law: Law, least: float, learned: NDArray[np.bool_], decades: Sequence[float]) -> tuple[float, float]:
    """Return (ratio, minus the mean log density on ``learned`` samples) of the most likely ratio.

    The scale is at least ``least``.
    """

    def badness(v: float) -> float:
        error, deviation = law(10.0**v)
        d = deviation[learned]
        e = error[learned] / d
        limit = OUTLIER * robust_rms(e)
        found = float(np.sqrt(np.mean(np.clip(e, -limit, limit) ** 2)))
        scale = max(found, least, 1e-300)
        value = float(np.log(scale) + np.mean(np.log(d)) + 0.5 * (found / scale) ** 2)
        return value if np.isfinite(value) else np.inf

    best = decades[int(np.argmin([badness(v) for v in decades]))]
    wide = 0.5 * (decades[1] - decades[0])
    options = {"xatol": 0.02}
    found: Any = minimize_scalar(badness, bounds=(best - wide, best + wide), method="bounded", options=options)
    return 10.0 ** float(found.x), float(found.fun)


def predict_walk(
    residual: Array, gap_s: Array, believed: NDArray[np.bool_], learned: NDArray[np.bool_], least: float
) -> tuple[Array, Array]:
    """Implement ``Effect.predict`` for a walk.

    It predicts nothing where an integrated walk (which is smooth) or a stationary one is more likely by more than the
    price of a parameter (Schwarz 1978): then the drift is no random walk.
    """
    gaps = gap_s[1:]
    step_s = float(np.median(gaps)) if gaps.size else 1.0
    length_s = float(np.sum(gaps))
    here = np.log10(1.0 / step_s)
    walks = np.linspace(RATIOS[0] + here, RATIOS[1] + here, 25)
    ratio, own = likeliest(lambda v: local_level(residual, gap_s, believed, v, 0.0), least, learned, walks)
    slopes = np.linspace(2 * RATIOS[0] + 3 * here, RATIOS[1] + 3 * here, 37)
    _, smooth = likeliest(lambda v: local_slope(residual, gap_s, believed, v), least, learned, slopes)
    rivals = [smooth]
    for share in FORGETS:
        rate_1_s = 1.0 / (share * length_s)
        _, forgetful = likeliest(
            lambda v, r=rate_1_s: local_level(residual, gap_s, believed, v, r), least, learned, walks
        )
        rivals.append(forgetful)
    count = max(int(np.count_nonzero(learned)), 2)
    if min(rivals) < own - 0.5 * np.log(count) / count:
        return residual, np.ones(residual.size)
    return local_level(residual, gap_s, believed, ratio, 0.0)


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
    basis=lambda x, ctx, q, settings: hats(ctx.t, np.array(settings.get("knots_s", (0.0, 1.0)))),
    test=_walk_test,
    report=_walk_report,
    driven=False,
    sites=("output",),
    stochastic=True,
    predict=predict_walk,
)
