"""Dropped samples: some are lost or repeated, the rest of the record shifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context, Effect, Human, Parts, Settings, Signature
from sim_devices.physics.statistics import robust_rms


@kernel
def shift_by(x, at, total):
    """Return y[k] = x[k + s(k)], where s jumps to ``total[i]`` at sample ``at[i]``; edges are held."""
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
def best_shifts(costs, price, zero):
    """Return the cheapest path of shifts over windows: ``costs`` (windows, shifts), ``price`` per change (Viterbi).

    Before the record the shift is none, column ``zero``: another one from the first window on is a change, too.
    """
    w, m = costs.shape
    total = costs[0] + price
    total[zero] -= price
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
    """Return the sum of squares (windows, shifts) of y less the shifted x in each window of ``window`` samples.

    ``local`` removes the window's own mean first.
    """
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
    """Find the samples at which a record lost or repeats samples, by the cheapest path of shifts over windows.

    Returns (samples, total shift from there on, share of the error explained, sum of squares left). The first search
    leaves the mean of every window to slower effects. A signal that hardly bends within a window has nothing left
    then, so a second search removes the level of the whole record only; its result is used if it explains far more
    with a few events.
    """
    found = _path_of_shifts(model, measured, True)
    slow = _path_of_shifts(model, measured, False)
    if not 0 < len(slow[0]) <= MOST_SLOW:
        return found
    left, left_slow = (_squares_left(model, measured, f[0], f[1]) for f in (found, slow))
    return slow if left_slow < 0.5 * left else found


def _squares_left(model: Array, measured: Array, at: Sequence[int], total: Sequence[int]) -> float:
    """Return the residual sum of squares of a shifted model whose gain and level are fitted."""
    moved = shift_by(model, np.array(at, np.int64), np.array(total, np.int64))
    a, b = moved - moved.mean(), measured - measured.mean()
    return float(b @ b) - float(a @ b) ** 2 / max(float(a @ a), 1e-300)


def _path_of_shifts(model: Array, measured: Array, local: bool) -> tuple[list[int], list[int], float, float]:
    """Find drops as ``find_drops`` does, without the mean of every window (``local``) or only that of the record."""
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
    path, best = best_shifts(costs, price, zero)
    if not local:
        # neighbouring samples of coloured noise agree on a shift: the price is that of their long-run variance
        k = np.arange(count * window)
        left = (y[k] - x[np.clip(k + np.repeat(shifts[path], window), 0, n - 1)]).reshape(count, window).mean(axis=1)
        long_run = 0.5 * window * robust_rms(np.diff(left)) ** 2
        if long_run > floor * floor:
            path, best = best_shifts(costs, price * long_run / (floor * floor), zero)
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
    parts=lambda settings: Parts(),
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
