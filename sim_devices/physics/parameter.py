"""Parameters of differential equations that are no constants: they follow a signal, a state, or a direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.flows import PAIRS


def _settings(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    spread = float(np.std(x[k])) or 1.0
    return {"centre": (float(np.mean(x[k])),), "spread": (spread,), PAIRS: ctx.facts.get(PAIRS, (0.0, 0.0))}


def _parts(settings: Settings) -> Parts:
    spread = settings.get("spread", (1.0,))[0]
    return Parts((), (Parameter("per_unit", "1/{out}", scale=0.1 / spread),))


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("relative_change", float(p[0]), "1/{out}"),
        Human("change_over_spread", float(p[0]) * 2 * settings["spread"][0], "1"),
    )


def _fill(q: Array, w: Array, settings: Settings) -> Mapping[str, Array]:
    return {"sway": np.array([*settings[PAIRS], w[0], settings["centre"][0], 0.0, 0.0])}


BY_LOG = 3.0
"""Marks a law for the logarithm of a parameter."""


def _state_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    return {**_settings(x, residual, ctx), "range": (float(np.min(x[k])), float(np.max(x[k])))}


def _state_parts(settings: Settings) -> Parts:
    spread = settings.get("spread", (1.0,))[0]
    square = Parameter("per_square", "1/{out}^2", scale=0.1 / spread**2)
    return Parts((), (*_parts(settings).weights, square))


def _state_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    ends = [v - settings["centre"][0] for v in settings["range"]]
    low, high = (float(np.expm1(p[0] * d + p[1] * d**2)) for d in ends)
    return (
        Human("relative_change", float(p[0]), "1/{out}"),
        Human("relative_curvature", float(p[1]), "1/{out}^2"),
        Human("change_at_lowest", low, "1"),
        Human("change_at_highest", high, "1"),
    )


BY_STATE = Effect(
    name="parameter_variation",
    summary="a parameter of the equations follows a state (an inductance its current)",
    kind="feedback",
    stages=("mechanics", "actuator", "environment"),
    parts=_state_parts,
    equation=r"p = p_0 \exp(a (x - \bar x) + b (x - \bar x)^2)",
    source="second order of Taylor's series of ln p, which is the same law for 1/p; to first order of a temperature the"
    " Frank-Kamenetskii form of Arrhenius' law (1955, ch. VI)",
    excitation="high and low levels of the state while the input keeps moving",
    confusable_with=("quadratic_drag", "cubic_stiffness", "nonlinear_heat_loss", "linear_loss"),
    prepare=_state_settings,
    basis=lambda x, ctx, q, settings: (x - settings["centre"][0])[:, None] ** np.array([1.0, 2.0]),
    fill=lambda q, w, settings: {"sway": np.array([*settings[PAIRS], w[0], settings["centre"][0], BY_LOG, w[1]])},
    report=_state_report,
    acts_on=("state",),
)

PARAMETER_VARIATION = Effect(
    name="parameter_variation",
    summary="a parameter of the equations follows a recorded signal or a state (a resistance its temperature)",
    kind="feedback",
    stages=("mechanics", "actuator", "environment"),
    parts=_parts,
    equation=r"p = p_0 (1 + a (s - \bar s))",
    source="IEC 60751:2022, section 5.2, to first order (platinum resistance); the same form for any other parameter",
    excitation="a signal or state that changes while the input keeps moving",
    confusable_with=("thermal_drift", "temperature_sensitivity"),
    prepare=_settings,
    basis=lambda x, ctx, q, settings: (x - settings["centre"][0])[:, None],
    fill=_fill,
    report=_report,
    acts_on=("parameter",),
    variants=(BY_STATE,),
)


def _turned_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    a = float(np.clip(p[0], -MOST_TURNED, MOST_TURNED))
    return (Human("relative_change", float(p[0]), "1"), Human("rising_to_falling", (1 + a) / (1 - a), "1"))


def _directions(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return np.sign(x if settings[PAIRS][2] == OWN_SIGN else np.gradient(x, ctx.dt))[:, None]


def _turned(q: Array, w: Array, settings: Settings) -> Mapping[str, Array]:
    parameter, state, way = settings[PAIRS]
    return {"sway": np.array([parameter, state, w[0], 0.0, way, 0.0])}


RATE_SIGN, OWN_SIGN = 1.0, 2.0
"""The direction of a state is the sign of its rate, or of a velocity its own sign."""

MOST_TURNED = 0.95
"""Largest relative change by direction; at 1 the parameter would vanish one way."""

DIRECTION_DEPENDENCE = Effect(
    name="direction_dependence",
    summary="a parameter of the equations differs with the direction of motion (a valve fills faster than it vents)",
    kind="feedback",
    stages=("mechanics", "actuator", "environment"),
    parts=lambda settings: Parts((), (Parameter("relative_change", "1", scale=0.03),)),
    equation=r"p = p_0 (1 + a\,\mathrm{sgn}\,\dot x)",
    source="J. C. Dixon, The Shock Absorber Handbook, 2nd ed. 2007, ch. 6 (asymmetry); the same form for any parameter",
    excitation="slow and fast moves both ways, with rest between them",
    confusable_with=("static_nonlinearity", "hysteresis"),
    prepare=lambda x, residual, ctx: {PAIRS: ctx.facts.get(PAIRS, (0.0, 0.0, RATE_SIGN))},
    basis=_directions,
    fill=_turned,
    report=_turned_report,
    limits={"relative_change": (-MOST_TURNED, MOST_TURNED)},
    vanishes_with=(("relative_change",),),
    acts_on=("direction",),
)
