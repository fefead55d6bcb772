"""Short isolated bursts of any shape: found one by one, taken out of the comparison, counted and described."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from sim_devices.physics.effect import Array, Context, Effect, Human, Parts, Settings, Signature
from sim_devices.physics.periods import locked_p_value, period_of
from sim_devices.physics.statistics import after_jumps, robust_rms, smooth, whiten

MOST_SHARE = 0.05  # of all samples; more is not "short and isolated"
THRESHOLD = 6.0
LEAST_OF_TOP = 0.25  # of the third largest burst
LEAST_LOCKED = 4  # bursts from which their phase says anything
LOCKED = 1e-3  # p-value of Rayleigh's test below which bursts belong to the phase of an input


def find_bursts(residual: Array, keep: NDArray[np.bool_]) -> list[tuple[int, int, float]]:
    """Return [start, stop) and peak of each burst.

    A burst is a run of innovations beyond six robust rms, extended until the level is usual again.
    """
    n = residual.size
    w = whiten(residual, keep, 8)
    scale = robust_rms(w[keep])
    if scale == 0.0:
        return []
    level = smooth(np.where(keep, residual, 0.0), max(101, n // 500) | 1)
    usual = max(robust_rms((residual - level)[keep]), 1e-300)
    index = np.flatnonzero((np.abs(w) > THRESHOLD * scale) & keep)
    if index.size > 10 * MOST_SHARE * keep.sum():
        return []
    # a high burst rings on in the innovations for as long as their filter is
    near = residual[np.clip(index[:, None] + np.arange(-15, 16), 0, n - 1)]
    index = index[np.abs(residual[index] - np.median(near, axis=1)) > 2.5 * usual]
    if not index.size or index.size > MOST_SHARE * keep.sum():
        return []
    # close gaps of a few samples, so that one burst is one event
    join = max(3, n // 20_000)
    breaks = np.flatnonzero(np.diff(index) > join) + 1
    longest = max(60, n // 100)
    out: list[tuple[int, int, float]] = []
    for group in np.split(index, breaks):
        a, b = int(group[0]), int(group[-1]) + 1
        around = np.concatenate([residual[max(0, a - 60) : max(1, a - 5)], residual[b + 5 : b + 60]])
        local = float(np.median(around)) if around.size else 0.0
        # the extension is bounded by the length of a short burst: the level may have changed there
        first, last = max(0, a - longest), min(n, b + longest)
        while a > first and abs(residual[a - 1] - local) > 2.5 * usual:
            a -= 1
        while b < last and abs(residual[b] - local) > 2.5 * usual:
            b += 1
        a, b = max(0, a - 1), min(n, b + 1)
        if out and a <= out[-1][1]:
            a = out.pop()[0]
        piece = residual[a:b] - local
        out.append((a, b, float(piece[np.argmax(np.abs(piece))])))
    # a heavy tail's outliers beside real bursts are noise, and stay in the comparison
    tops = np.sort([abs(b[2]) for b in out])[::-1]
    return [b for b in out if abs(b[2]) > LEAST_OF_TOP * tops[min(2, tops.size - 1)]]


def _where(ctx: Context, residual: Array) -> tuple[Array, NDArray[np.bool_]]:
    if ctx.everywhere is not None:
        return ctx.everywhere, np.ones(residual.size, np.bool_)
    return residual, ctx.keep


def not_driven(bursts: list[tuple[int, int, float]], ctx: Context) -> list[tuple[int, int, float]]:
    """Return the bursts that no input causes.

    Bursts that begin at a jump of a signal are responses and are removed when more of them do so than chance allows.
    The result is empty where the bursts keep to the phase of a periodic input: the misfit of a loop recurs in every
    period.
    """
    lively = after_jumps(ctx.signals.values(), ctx.t.size, 0.1)
    at = np.array([lively[min(a + 2, lively.size - 1)] for a, _, _ in bursts], np.bool_)
    if at.sum() > max(1.0, 3.0 * float(lively.mean()) * len(bursts)):
        bursts = [b for b, driven in zip(bursts, at, strict=True) if not driven]
    middle = np.array([0.5 * (a + b) for a, b, _ in bursts])
    if middle.size >= LEAST_LOCKED:
        for x in ctx.signals.values():
            period = period_of(x)
            if period is not None and locked_p_value(middle, period.samples) < LOCKED:
                return []
    return bursts


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    bursts = not_driven(find_bursts(*_where(ctx, residual)), ctx)
    return {
        "starts": tuple(float(b[0]) for b in bursts),
        "stops": tuple(float(b[1]) for b in bursts),
        "peaks": tuple(b[2] for b in bursts),
        "time": (ctx.dt, ctx.dt * ctx.t.size),
    }


def claims(settings: Settings, n: int) -> NDArray[np.bool_]:
    """Return the mask (n,) of the samples inside bursts."""
    out = np.zeros(n, np.bool_)
    for a, b in zip(settings.get("starts", ()), settings.get("stops", ()), strict=True):
        out[int(a) : int(b)] = True
    return out


def _test(x: Array, residual: Array, ctx: Context) -> Signature:
    """Test bursts against heavy-tailed noise: Student's t with 4 degrees of freedom is the null distribution.

    The test uses the whole record, because it fits no parameter and a few bursts may all lie in the held-out set.
    """
    residual, keep = _where(ctx, residual)
    bursts = not_driven(find_bursts(residual, keep), ctx)
    if not bursts:
        return Signature(1.0, 0.0, "no burst")
    in_burst = np.zeros(residual.size, np.bool_)
    for a, b, _ in bursts:
        in_burst[a:b] = True
    e = residual[keep] - np.median(residual[keep])
    power = float(e @ e)
    inside = in_burst[keep]
    share = float(e[inside] @ e[inside]) / power if power > 0 else 0.0
    w = whiten(residual, keep, 8)
    scale = robust_rms(w[keep]) or 1.0
    far_out = sorted((np.sort(np.abs(w[a:b]))[::-1] / scale for a, b, _ in bursts), key=lambda v: -v[0])
    # a typical burst, not the largest: heavy-tailed noise has one outlier, spikes have several alike
    typical = far_out[min(len(far_out) - 1, 2)]
    p = min(1.0, keep.sum() * 2 * float(student.sf(typical[0] * 0.74, 4)))
    width = np.mean([b - a for a, b, _ in bursts])
    if width > 2.5:
        # in independent noise, neighbours are not outliers together
        p = p * p if p < 1 else 1e-3
        if len(bursts) > 2:
            # nor does that repeat (once is a start or a lost sample); smaller neighbours may be the filter's ringing
            beside = typical[: int(np.sum(typical > max(4.0, 0.2 * typical[0])))][:4]
            p = min(p, 2 * keep.sum() * float(np.prod(2 * student.sf(beside * 0.74, 4))))
    return Signature(float(p), share, f"{len(bursts)} bursts, {width:.1f} samples wide")


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    starts, stops = np.array(settings.get("starts", ())), np.array(settings.get("stops", ()))
    peaks = np.array(settings.get("peaks", ()))
    dt, span = settings.get("time", (1.0, 1.0))
    if not starts.size:
        return (Human("events", 0.0, "1"),)
    return (
        Human("events", float(starts.size), "1"),
        Human("events_per_minute", float(60 * starts.size / span), "1/min"),
        Human("typical_peak", float(np.median(np.abs(peaks))), "{out}"),
        Human("typical_duration_s", float(np.median(stops - starts) * dt), "s"),
    )


SPIKES = Effect(
    name="spikes",
    summary="short isolated bursts (button press, electrical)",
    kind="add",
    stages=("acquisition", "mounting", "environment"),
    parts=lambda settings: Parts(),
    equation=r"y = x + \sum_i b_i(t - t_i),\; b_i \text{ short, of any shape}",
    source="R. K. Pearson, Mining Imperfect Data, SIAM 2005, section 3.2 (robust detection of outliers)",
    excitation="none; the longer the record, the more events",
    confusable_with=("dropped_samples", "quantization", "step_shift"),
    prepare=_prepare,
    basis=lambda x, ctx, q, settings: np.zeros((ctx.t.size, 0)),
    test=_test,
    report=_report,
    driven=False,
    sites=("output",),
    claims=claims,
    stochastic=True,
)
