"""Pure delays: dead time of the chain, one channel late against the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Parameter, Parts, Settings, reports, time_settings
from sim_devices.physics.resampling import delay_by_correlation, resample, resample_straight


def _delay_parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts((Parameter("delay_s", "s", -2 * dt, max(20 * dt, min(0.2 * span, 5.0)), scale=dt),))


def _straight_delay_parts(settings: Settings) -> Parts:
    # a name of its own: twin files tell forms by their parameters
    return Parts((replace(_delay_parts(settings).nonlinear[0], name="late_s"),))


def _straight_delay_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return resample_straight(x, -q[0] / ctx.dt, 1.0, 0.0)


def _delay_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    bounds = _delay_parts(settings).nonlinear[0]
    longest = int(bounds.hi / ctx.dt)
    model = ctx.to_output(x - x.mean())
    k = ctx.keep
    slope = np.gradient(model, ctx.dt)
    power = float(slope[k] @ slope[k])
    small = -float(slope[k] @ residual[k]) / power if power > 0 else ctx.dt
    found = [small, delay_by_correlation(model, model + residual, longest) * ctx.dt]
    return tuple((float(np.clip(d, bounds.lo, bounds.hi)),) for d in dict.fromkeys(found))


_STRAIGHT = r"y(t) = x(t - T),\; x \text{ straight between samples}"

_SMOOTH_DELAY = Effect(
    name="dead_time",
    summary="pure delay",
    kind="linear",
    stages=("acquisition", "amplifier", "actuator", "sensor"),
    parts=_delay_parts,
    equation=r"y(t) = x(t - T)",
    source="A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing, 3rd ed., section 4.5; Keys 1981",
    excitation="quick changes; several frequencies tell it from a lag",
    confusable_with=("first_order_lag", "channel_delay", "clock_skew"),
    prepare=time_settings,
    guess=_delay_guess,
    apply=lambda x, ctx, q, settings: resample(x, -q[0] / ctx.dt, 1.0, 0.0),
    report=reports(("delay_s", "s")),
    vanishes_with=(("delay_s",),),
    essential=("delay_s",),
)

# an edge within one sample is late by a straight line or by a curve, and that alone may look like a lag
_STRAIGHT_DELAY = replace(_SMOOTH_DELAY, parts=_straight_delay_parts, equation=_STRAIGHT, apply=_straight_delay_apply)
DEAD_TIME = replace(_SMOOTH_DELAY, variants=(_STRAIGHT_DELAY,))

_SMOOTH_CHANNEL = replace(
    _SMOOTH_DELAY,
    name="channel_delay",
    summary="one channel late against the others",
    stages=("acquisition",),
    equation=r"y_i(t) = x_i(t - T_i)",
    excitation="quick changes seen by several channels",
    confusable_with=("dead_time", "first_order_lag"),
    sites=("output",),
)

_STRAIGHT_CHANNEL = replace(
    _SMOOTH_CHANNEL, parts=_straight_delay_parts, equation=_STRAIGHT, apply=_straight_delay_apply
)
CHANNEL_DELAY = replace(_SMOOTH_CHANNEL, variants=(_STRAIGHT_CHANNEL,))
