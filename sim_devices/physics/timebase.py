"""Timing: pure delays, clocks that run apart, samples lost or repeated. All are linear resamplings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature
from sim_devices.physics.statistics import robust_rms


@kernel
def resample(x, first, step):
    """x at positions ``first + step * k`` (in samples), k = 0..n-1, by cubic convolution; edges are held.

    R. Keys, IEEE Trans. ASSP 29 (1981) 1153, eq. 15 (a = -1/2).
    """
    n = x.size
    y = np.empty(n)
    for k in range(n):
        p = first + step * k
        if p <= 0.0:
            y[k] = x[0]
            continue
        if p >= n - 1:
            y[k] = x[n - 1]
            continue
        i = int(p)
        s = p - i
        a = x[i - 1] if i > 0 else 2 * x[0] - x[1]
        b = x[i]
        c = x[i + 1]
        d = x[i + 2] if i + 2 < n else 2 * x[n - 1] - x[n - 2]
        y[k] = b + 0.5 * s * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a)))
    return y


@kernel
def resample_straight(x, first, step):
    """The same on straight lines between samples, as a held or played-back signal runs; edges are held."""
    n = x.size
    y = np.empty(n)
    for k in range(n):
        p = first + step * k
        if p <= 0.0:
            y[k] = x[0]
        elif p >= n - 1:
            y[k] = x[n - 1]
        else:
            i = int(p)
            y[k] = x[i] + (p - i) * (x[i + 1] - x[i])
    return y


def delay_by_correlation(x: Array, y: Array, longest: int) -> float:
    """Samples by which y is late against x, from the peak of their differences' cross-correlation, refined."""
    n = x.size
    a, b = np.diff(x - x.mean()), np.diff(y - y.mean())
    size = 1 << int(np.ceil(np.log2(2 * n)))
    c = np.fft.irfft(np.fft.rfft(b, size) * np.conj(np.fft.rfft(a, size)), size)
    longest = min(longest, n // 2)
    c = np.concatenate([c[-longest:], c[: longest + 1]])
    k = int(np.argmax(np.abs(c)))
    fine = 0.0
    if 0 < k < c.size - 1:
        left, peak, right = abs(c[k - 1]), abs(c[k]), abs(c[k + 1])
        bend = left - 2 * peak + right
        fine = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return k - longest + fine


# -- delay ------------------------------------------------------------------------------------------


def _delay_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    return {"time": (ctx.dt, ctx.dt * ctx.t.size)}


def _delay_parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts((Parameter("delay_s", "s", -2 * dt, max(20 * dt, min(0.2 * span, 5.0)), scale=dt),))


def _delay_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return resample(x, -q[0] / ctx.dt, 1.0)


def _straight_delay_parts(settings: Settings) -> Parts:
    # a name of its own: twin files tell forms by their parameters
    return Parts((replace(_delay_parts(settings).nonlinear[0], name="late_s"),))


def _straight_delay_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return resample_straight(x, -q[0] / ctx.dt, 1.0)


def _delay_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    bounds = _delay_parts(settings).nonlinear[0]
    longest = int(bounds.hi / ctx.dt)
    model = ctx.to_output(x - x.mean())
    k = ctx.keep
    slope = np.gradient(model, ctx.dt)
    power = float(slope[k] @ slope[k])
    small = -float(slope[k] @ residual[k]) / power if power > 0 else ctx.dt
    found = [small]
    if ctx.measured is not None:
        found.append(delay_by_correlation(model, ctx.measured, longest) * ctx.dt)
    return tuple((float(np.clip(d, bounds.lo, bounds.hi)),) for d in dict.fromkeys(found))


def _delay_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("delay_s", float(p[0]), "s"),)


_DELAY_SOURCE = "A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing, 3rd ed., section 4.5; Keys 1981"

_STRAIGHT = r"y(t) = x(t - T),\; x \text{ straight between samples}"

_SMOOTH_DELAY = Effect(
    name="dead_time",
    summary="pure delay",
    kind="linear",
    stages=("acquisition", "amplifier", "actuator", "sensor"),
    parts=_delay_parts,
    equation=r"y(t) = x(t - T)",
    source=_DELAY_SOURCE,
    excitation="quick changes; several frequencies tell it from a lag",
    confusable_with=("first_order_lag", "channel_delay", "clock_skew"),
    prepare=_delay_prepare,
    guess=_delay_guess,
    apply=_delay_apply,
    report=_delay_report,
)

# an edge within one sample is late by a straight line or by a curve, and that alone may look like a lag
_STRAIGHT_DELAY = replace(_SMOOTH_DELAY, parts=_straight_delay_parts, equation=_STRAIGHT, apply=_straight_delay_apply)
DEAD_TIME = replace(_SMOOTH_DELAY, variants=(_STRAIGHT_DELAY,))

_SMOOTH_CHANNEL = Effect(
    name="channel_delay",
    summary="one channel late against the others",
    kind="linear",
    stages=("acquisition",),
    parts=_delay_parts,
    equation=r"y_i(t) = x_i(t - T_i)",
    source=_DELAY_SOURCE,
    excitation="quick changes seen by several channels",
    confusable_with=("dead_time", "first_order_lag"),
    prepare=_delay_prepare,
    guess=_delay_guess,
    apply=_delay_apply,
    report=_delay_report,
    sites=("output",),
)

_STRAIGHT_CHANNEL = replace(
    _SMOOTH_CHANNEL, parts=_straight_delay_parts, equation=_STRAIGHT, apply=_straight_delay_apply
)
CHANNEL_DELAY = replace(_SMOOTH_CHANNEL, variants=(_STRAIGHT_CHANNEL,))


# -- clock skew -------------------------------------------------------------------------------------


def local_delays(model: Array, error: Array, keep: np.ndarray, windows: int) -> tuple[Array, Array, Array]:
    """(centre sample, delay in samples, its standard error) per window, by regression of the error on -d model/dk."""
    n = model.size
    slope = np.gradient(model)
    edges = np.linspace(0, n, windows + 1).astype(int)
    centre, delay, sd = [], [], []
    for a, b in pairwise(edges):
        k = np.flatnonzero(keep[a:b]) + a
        if k.size < 8:
            continue
        s = slope[k] - slope[k].mean()
        e = error[k] - error[k].mean()
        p = float(s @ s)
        if p <= 0:
            continue
        d = -float(s @ e) / p
        left = e + d * s
        centre.append(float(k.mean()))
        delay.append(d)
        sd.append(float(np.sqrt(left @ left / k.size / p)))
    return np.array(centre), np.array(delay), np.array(sd)


def _skew_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    return {"time": (ctx.dt, ctx.dt * ctx.t.size)}


def _skew_parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts((Parameter("skew_ppm", "ppm", -5e4, 5e4, scale=1e6 * dt / span),))


def _skew_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return resample(x, 0.0, 1.0 + 1e-6 * q[0])


def _skew_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    n = ctx.t.size
    out = ctx.measured
    model = ctx.to_output(x - x.mean())
    found = [0.0]
    c, d, sd = local_delays(model, residual, ctx.keep, 24)
    if c.size > 3:
        w = 1 / np.maximum(sd, 1e-9)
        slope = float(np.sum(w * c * d) / np.sum(w * c * c))
        found.append(-1e6 * slope)
    if out is not None:
        # windows against each other where the shift exceeds what a regression can follow
        edges = np.linspace(0, n, 9).astype(int)
        shifts = []
        for a, b in pairwise(edges):
            if b - a > 64 and np.ptp(model[a:b]) > 0:
                shifts.append((0.5 * (a + b), delay_by_correlation(model[a:b], out[a:b], (b - a) // 4)))
        if len(shifts) > 3:
            s = np.array(shifts)
            found.append(-1e6 * float(s[:, 0] @ s[:, 1] / (s[:, 0] @ s[:, 0])))
            slopes = np.diff(s[:, 1]) / np.diff(s[:, 0])
            found.append(-1e6 * float(np.median(slopes)))
    return tuple((float(np.clip(v, -5e4, 5e4)),) for v in dict.fromkeys(found))


def _skew_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("skew_ppm", float(p[0]), "ppm"),)


_SMOOTH_SKEW = Effect(
    name="clock_skew",
    summary="one clock runs fast or slow against the other",
    kind="linear",
    stages=("acquisition",),
    parts=_skew_parts,
    equation=r"y(t) = x\left((1 + \epsilon)\,t\right)",
    source="IEEE Std 1588-2019, clause 3 (frequency offset); Keys 1981 for the resampling",
    excitation="quick changes from beginning to end",
    confusable_with=("dropped_samples", "dead_time"),
    prepare=_skew_prepare,
    guess=_skew_guess,
    apply=_skew_apply,
    report=_skew_report,
    sites=("output",),
)


def _straight_skew_parts(settings: Settings) -> Parts:
    return Parts((replace(_skew_parts(settings).nonlinear[0], name="apart_ppm"),))


def _straight_skew_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return resample_straight(x, 0.0, 1.0 + 1e-6 * q[0])


_STRAIGHT_SKEW = replace(
    _SMOOTH_SKEW,
    parts=_straight_skew_parts,
    equation=r"y(t) = x\left((1 + \epsilon)\,t\right),\; x \text{ straight between samples}",
    apply=_straight_skew_apply,
)
CLOCK_SKEW = replace(_SMOOTH_SKEW, variants=(_STRAIGHT_SKEW,))


# -- dropped samples --------------------------------------------------------------------------------


@kernel
def shift_by(x, at, total):
    """y[k] = x[k + s(k)] where s jumps to ``total[i]`` at sample ``at[i]``; edges are held."""
    n = x.size
    y = np.empty(n)
    s = 0
    e = 0
    for k in range(n):
        while e < at.size and k >= at[e]:
            s = total[e]
            e += 1
        y[k] = x[min(max(k + s, 0), n - 1)]
    return y


@kernel
def best_shifts(costs, price):
    """Cheapest path of shifts over windows: ``costs`` (windows, shifts), ``price`` for each change (Viterbi)."""
    w, m = costs.shape
    total = costs[0].copy()
    back = np.zeros((w, m), np.int64)
    for i in range(1, w):
        cheapest = 0
        for j in range(m):
            if total[j] < total[cheapest]:
                cheapest = j
        new = np.empty(m)
        for j in range(m):
            jump = total[cheapest] + price
            if total[j] <= jump:
                new[j] = total[j] + costs[i, j]
                back[i, j] = j
            else:
                new[j] = jump + costs[i, j]
                back[i, j] = cheapest
        total = new
    path = np.empty(w, np.int64)
    path[w - 1] = np.argmin(total)
    for i in range(w - 1, 0, -1):
        path[i - 1] = back[i, path[i]]
    return path, total.min()


@kernel
def shift_costs(x, y, window, shifts, local):
    """Sum of squares (windows, shifts) of y less the shifted x in each window of ``window`` samples, about the
    window's own mean where ``local``."""
    n = x.size
    count = n // window
    out = np.empty((count, shifts.size))
    for i in range(count):
        first = i * window
        for j in range(shifts.size):
            total = 0.0
            square = 0.0
            for k in range(first, first + window):
                d = y[k] - x[min(max(k + shifts[j], 0), n - 1)]
                total += d
                square += d * d
            out[i, j] = max(square - total * total / window, 0.0) if local else square
    return out


MOST_SHIFT = 60
MOST_DROPS = 40
MOST_SLOW = 12  # events that a signal without bends within a window can vouch for


def find_drops(model: Array, measured: Array) -> tuple[list[int], list[int], float, float]:
    """Where a record lost or repeats samples, by the cheapest path of shifts over windows.

    (samples, total shift from there on, share of the error explained, sum of squares left). First with the mean of
    every window left to slower effects; of a signal that hardly bends within a window nothing is left then, so once
    more with the level of the whole record alone, which is taken when it explains far more with a few events.
    """
    found = _path_of_shifts(model, measured, True)
    slow = _path_of_shifts(model, measured, False)
    if not 0 < len(slow[0]) <= MOST_SLOW:
        return found
    left, left_slow = (_squares_left(model, measured, f[0], f[1]) for f in (found, slow))
    return slow if left_slow < 0.5 * left else found


def _squares_left(model: Array, measured: Array, at: Sequence[int], total: Sequence[int]) -> float:
    """Sum of squares that a shifted model leaves when its gain and level are free."""
    moved = shift_by(model, np.array(at, np.int64), np.array(total, np.int64))
    a, b = moved - moved.mean(), measured - measured.mean()
    return float(b @ b) - float(a @ b) ** 2 / max(float(a @ a), 1e-300)


def _path_of_shifts(model: Array, measured: Array, local: bool) -> tuple[list[int], list[int], float, float]:
    """``find_drops`` with the mean of every window left out (``local``) or only that of the record."""
    n = model.size
    y = measured - measured.mean()
    x = model - model.mean()
    power = float(x @ x)
    if power > 0:
        x = x * float(np.sqrt((y @ y) / power))
    window = int(np.clip(n // 400, 16, 400))
    count = n // window
    if count < 4:
        return [], [], 0.0, np.inf
    shifts = np.arange(-MOST_SHIFT, MOST_SHIFT + 1)
    shifts = shifts[np.abs(shifts) < n // 8]
    costs = shift_costs(x, y, window, shifts, local)
    zero = int(np.flatnonzero(shifts == 0)[0])
    floor = robust_rms(np.sqrt(costs.min(axis=1) / window)) + float(np.median(np.sqrt(costs.min(axis=1) / window)))
    price = 30.0 * floor * floor + 0.3 * float(np.median(costs.min(axis=1)))
    path, best = best_shifts(costs, price)
    if not local:
        # neighbouring samples of coloured noise agree on a shift: the price is that of their long-run variance
        k = np.arange(count * window)
        left = (y[k] - x[np.clip(k + np.repeat(shifts[path], window), 0, n - 1)]).reshape(count, window).mean(axis=1)
        long_run = 0.5 * window * robust_rms(np.diff(left)) ** 2
        if long_run > floor * floor:
            path, best = best_shifts(costs, price * long_run / (floor * floor))
    before = float(costs[:, zero].sum())
    change = np.flatnonzero(np.diff(path)) + 1
    if not change.size or change.size > MOST_DROPS or before <= 0:
        return [], [], 0.0, before
    at: list[int] = []
    total: list[int] = []
    # a window that straddles a jump may settle between: changes next to each other are one jump
    for group in np.split(change, np.flatnonzero(np.diff(change) > 2) + 1):
        first, last = int(group[0]), int(group[-1])
        k = np.arange(max(0, (first - 1) * window), min(n, (last + 1) * window))
        e0 = (y[k] - x[np.clip(k + shifts[path[first - 1]], 0, n - 1)]) ** 2
        e1 = (y[k] - x[np.clip(k + shifts[path[last]], 0, n - 1)]) ** 2
        split = np.concatenate([[0.0], np.cumsum(e0)]) + (e1.sum() - np.concatenate([[0.0], np.cumsum(e1)]))
        at.append(int(k[0] + np.argmin(split)))
        total.append(int(shifts[path[last]]))
    if shifts[path[0]] != 0:
        at.insert(0, 0)
        total.insert(0, int(shifts[path[0]]))
    keep = [i for i in range(len(at)) if i + 1 == len(at) or at[i + 1] > at[i]]
    return [at[i] for i in keep], [total[i] for i in keep], max(0.0, 1 - best / before), float(best)


def _drops(x: Array, residual: Array, ctx: Context) -> tuple[list[int], list[int], float]:
    if ctx.measured is None:
        return [], [], 0.0
    found = find_drops(ctx.to_output(x), ctx.measured)
    if ctx.believed is not None:
        other = find_drops(ctx.believed, ctx.measured)
        if other[3] < 0.9 * found[3]:
            found = other
    return found[:3]


def _drop_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    at, total, _ = _drops(x, residual, ctx)
    return {"at": tuple(map(float, at)), "shift": tuple(map(float, total))}


def _drop_parts(settings: Settings) -> Parts:
    return Parts()


def _drop_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    at = np.array(settings.get("at", ()), np.int64)
    return shift_by(x, at, np.array(settings.get("shift", ()), np.int64))


def _drop_test(x: Array, residual: Array, ctx: Context) -> Signature:
    at, _, share = _drops(x, residual, ctx)
    if not at:
        return Signature(1.0, 0.0, "no jump of the delay found")
    return Signature(10.0 ** (-3.0 - 4.0 * share * len(at)), share, f"{len(at)} jumps of the delay")


def _drop_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    shift = np.array(settings.get("shift", ()))
    steps = np.diff(np.concatenate([[0.0], shift]))
    return (
        Human("events", float(steps.size), "1"),
        Human("samples_lost", float(steps[steps > 0].sum()), "1"),
        Human("samples_repeated", float(-steps[steps < 0].sum()), "1"),
    )


DROPPED_SAMPLES = Effect(
    name="dropped_samples",
    summary="samples lost or repeated, the rest of the record shifts",
    kind="linear",
    stages=("acquisition",),
    parts=_drop_parts,
    equation=r"y_k = x_{k + s(k)},\; s \text{ jumps where samples are lost or repeated}",
    source="A. J. Viterbi, IEEE Trans. Information Theory 13 (1967) 260, for the path of shifts",
    excitation="quick changes all along the record",
    confusable_with=("clock_skew", "dead_time"),
    prepare=_drop_prepare,
    apply=_drop_apply,
    test=_drop_test,
    report=_drop_report,
    sites=("output",),
)
