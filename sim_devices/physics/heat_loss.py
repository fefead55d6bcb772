"""Heat loss that grows faster than the difference of temperatures: radiation and natural convection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Parameter, Parts, Settings, reports
from sim_devices.physics.flows import PAIRS
from sim_devices.physics.forces import CONVECTION, FLOW, RADIATION_C, RADIATION_K, ZERO_C

KELVIN = "kelvin"
"""Name of a fact of a place: 1 if its state is in K, 0 if it is in degC."""
TEMPERATURES = ("degC", "K")
"""Units of the states that lose heat."""
POWER = 1.25
"""Exponent of laminar natural convection: the Nusselt number goes with the Rayleigh number to the power 1/4."""


def _settings(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    low, high = float(np.min(x[k])), float(np.max(x[k]))
    rate = float(np.sqrt(np.mean(np.gradient(x, ctx.dt)[k] ** 2)))
    return {
        "range": (low, high if high > low else low + 1.0),
        "rate": (rate or 1.0,),
        KELVIN: ctx.facts.get(KELVIN, (1.0,)),
        PAIRS: ctx.facts.get(PAIRS, (0.0, 0.0)),
    }


def _surroundings(settings: Settings) -> tuple[float, float, float]:
    """Return bounds and scale of a temperature of the surroundings: what cools towards them is never far below."""
    low, high = settings.get("range", (0.0, 1.0))
    return low - 0.5 * (high - low), low + 0.05 * (high - low), 0.1 * (high - low)


def _scale(loss: Callable[[Array, float, Settings], Array], settings: Settings) -> float:
    low, high = settings.get("range", (0.0, 1.0))
    (rate,) = settings.get("rate", (1.0,))
    return 0.1 * rate / float(loss(np.array([high]), low, settings)[0])


def zero_of(settings: Settings) -> float:
    """Return 0 K in the unit of the state."""
    return 0.0 if settings.get(KELVIN, (1.0,))[0] else ZERO_C


def _radiated(x: Array, around: float, settings: Settings) -> Array:
    zero = zero_of(settings)
    return np.maximum(x - zero, 0.0) ** 4 - max(around - zero, 0.0) ** 4


def _convected(x: Array, around: float, settings: Settings) -> Array:
    over = x - around
    return np.sign(over) * np.abs(over) ** POWER


def _flow(law: int, strength: float, level: float, settings: Settings) -> dict[str, Array]:
    at = settings.get(PAIRS, (0.0, 0.0))[0]
    row = np.zeros(FLOW)
    row[:] = law, at, at, -strength, level
    return {"flows": row}


def _radiation(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    law = RADIATION_K if settings.get(KELVIN, (1.0,))[0] else RADIATION_C
    return _flow(law, float(w[0]), settings["range"][0], settings)


_COMMON = Effect(
    name="nonlinear_heat_loss",
    summary="heat loss grows faster than the difference of temperatures: radiation, natural convection",
    kind="feedback",
    stages=("mechanics", "sensor", "actuator"),
    parts=lambda s: Parts((), (Parameter("loss", "{out}^-3/s", 0.0, scale=_scale(_radiated, s)),)),
    equation=r"\dot T = \dots - a\,(T^4 - T_0^4)",
    source="F. P. Incropera, D. P. DeWitt, T. L. Bergman, A. S. Lavine, Fundamentals of Heat and Mass Transfer, 6th"
    " ed. (2007), eqs. 1.7 (Stefan-Boltzmann) and 9.24 with n = 1/4",
    excitation="temperatures near the surroundings' and far above them, each held",
    confusable_with=("static_nonlinearity", "temperature_sensitivity"),
    prepare=_settings,
    basis=lambda x, ctx, q, settings: -_radiated(x, settings["range"][0], settings)[:, None],
    fill=_radiation,
    report=reports(("loss", "{out}^-3/s")),
    acts_on=("storage",),
    position_units=TEMPERATURES,
)

CONVECTED = replace(
    _COMMON,
    parts=lambda s: Parts(
        (Parameter("surroundings", "{out}", *_surroundings(s)[:2], scale=_surroundings(s)[2]),),
        (Parameter("loss", "{out}^-0.25/s", 0.0, scale=_scale(_convected, s)),),
    ),
    equation=r"\dot T = \dots - a\,|T - T_s|^{1/4} (T - T_s)",
    guess=lambda x, residual, ctx, s: ((s["range"][0],), (1.2 * s["range"][0] - 0.2 * s["range"][1],)),
    basis=lambda x, ctx, q, settings: -_convected(x, float(q[0]), settings)[:, None],
    fill=lambda q, w, settings: _flow(CONVECTION, float(w[0]), float(q[0]), settings),
    report=reports(("surroundings", "{out}"), ("loss", "{out}^-0.25/s")),
)
"""Natural convection. The constant part of radiation is that of a zero, so the lowest temperature stands for the
surroundings' there."""

NONLINEAR_HEAT_LOSS = replace(_COMMON, variants=(CONVECTED,))
