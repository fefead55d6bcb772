"""Clock skew: one clock runs fast or slow against the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, reports, time_settings
from sim_devices.physics.resampling import delay_by_correlation, resample, resample_straight


def local_delays(model: Array, error: Array, keep: np.ndarray, windows: int) -> tuple[Array, Array, Array]:
    """Estimate (centre sample, delay in samples, its standard error) per window: regression of error on -d model/dk."""
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


def _skew_parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts((Parameter("skew_ppm", "ppm", -5e4, 5e4, scale=1e6 * dt / span),))


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
    prepare=time_settings,
    guess=_skew_guess,
    apply=lambda x, ctx, q, settings: resample(x, 0.0, 1.0 + 1e-6 * q[0], 0.0),
    report=reports(("skew_ppm", "ppm")),
    sites=("output",),
    vanishes_with=(("skew_ppm", "skew_change_ppm"),),
    essential=("skew_ppm",),
)


_STRAIGHT_SKEW = replace(
    _SMOOTH_SKEW,
    parts=lambda settings: Parts((replace(_skew_parts(settings).nonlinear[0], name="apart_ppm"),)),
    equation=r"y(t) = x\left((1 + \epsilon)\,t\right),\; x \text{ straight between samples}",
    apply=lambda x, ctx, q, settings: resample_straight(x, 0.0, 1.0 + 1e-6 * q[0], 0.0),
)


def _drifting_parts(settings: Settings) -> Parts:
    skew = _skew_parts(settings).nonlinear[0]
    return Parts((replace(skew, name="skew_at_begin_ppm"), replace(skew, name="skew_change_ppm")))


def _drifting_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    n = ctx.t.size
    found = [(q[0], 0.0) for q in _skew_guess(x, residual, ctx, settings)]
    c, d, sd = local_delays(ctx.to_output(x - x.mean()), residual, ctx.keep, 24)
    if c.size > 4:
        w = 1 / np.maximum(sd, 1e-9)
        columns = np.stack([c, 0.5 * c * c / n], axis=1)
        slopes = np.linalg.lstsq(columns * w[:, None], d * w, rcond=None)[0]
        found.append((-1e6 * float(slopes[0]), -1e6 * float(slopes[1])))
    return tuple((float(np.clip(a, -5e4, 5e4)), float(np.clip(b, -5e4, 5e4))) for a, b in found)


def _drifting_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    mean = float(p[0] + 0.5 * p[1])
    return (Human("skew_ppm", mean, "ppm"), Human("skew_change_ppm", float(p[1]), "ppm"))


_DRIFTING = replace(
    _SMOOTH_SKEW,
    parts=_drifting_parts,
    equation=r"y(t) = x\left(t + \epsilon t + \alpha t^2 / 2T\right)",
    source="D. W. Allan, IEEE Trans. UFFC 34 (1987) 647 (time error y t + D t^2/2); Keys 1981 for the resampling",
    guess=_drifting_guess,
    apply=lambda x, ctx, q, settings: resample(x, 0.0, 1.0 + 1e-6 * q[0], 0.5e-6 * q[1] / ctx.t.size),
    report=_drifting_report,
)
CLOCK_SKEW = replace(_SMOOTH_SKEW, variants=(_STRAIGHT_SKEW, _DRIFTING))
