"""Forces and flows in proportion to a velocity, a position or a level, which a simulation may lack altogether."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, reports
from sim_devices.physics.forces import SPRING, UNCENTRED, packed
from sim_devices.physics.friction import velocity_of

VISCOUS_FRICTION = Effect(
    name="viscous_friction",
    summary="resistance in proportion to the speed",
    kind="feedback",
    stages=("mechanics",),
    parts=lambda settings: Parts((), (Parameter("viscous", "1/s"),)),
    equation=r"m\ddot x + k x = F - c\,\dot x",
    source="B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994) 1083, section 2",
    excitation="slow and fast motion",
    confusable_with=("coulomb_friction", "quadratic_drag"),
    basis=lambda x, ctx, q, settings: -velocity_of(x, ctx)[:, None],
    fill=lambda q, w, settings: packed("spring", SPRING, {10: w[0]}),
    report=reports(("damping", "{in} s/{out}"), by_gain=True),
    acts_on=("motion", "joint"),
    proportional=True,
    shifts_line=True,
)


def _at_rest(x: Array, residual: Array, ctx: Context) -> Settings:
    return {UNCENTRED: (1.0,)} if UNCENTRED in ctx.facts else {}


def _spring_parts(settings: Settings) -> Parts:
    # a position that counts from where the record begins is not zero where the spring is at rest
    rest = (Parameter("preload", "{out}/s^2"),) if UNCENTRED in settings else ()
    return Parts((), (Parameter("linear", "1/s^2"), *rest))


def _spring_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    names = (("stiffness", "{in}/{out}"), ("preload", "{in}"))
    return tuple(Human(name, float(v) / (scale or 1.0), unit) for (name, unit), v in zip(names, p, strict=False))


LINEAR_STIFFNESS = Effect(
    name="linear_stiffness",
    summary="a spring: a force in proportion to the position",
    kind="feedback",
    stages=("mechanics", "mounting"),
    parts=_spring_parts,
    equation=r"m\ddot x + c\dot x = F - k x",
    source="J. P. Den Hartog, Mechanical Vibrations, 4th ed., McGraw-Hill 1956, section 2.1",
    excitation="slow motion over the whole travel",
    confusable_with=("cubic_stiffness", "cogging"),
    prepare=_at_rest,
    basis=lambda x, ctx, q, settings: np.stack([-x, np.ones(x.size)][: len(_spring_parts(settings).weights)], axis=1),
    fill=lambda q, w, settings: packed("spring", SPRING, dict(zip((2, 9), w, strict=False))),
    report=_spring_report,
    vanishes_with=(("stiffness",),),
    weights_beside=lambda settings: int(UNCENTRED in settings),
    by_position=True,
    proportional=True,
    shifts_line=True,
)


def _range(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    return {
        "size": (float(np.ptp(x[k])) or 1.0,),
        "rate": (float(np.sqrt(np.mean(np.gradient(x, ctx.dt)[k] ** 2))) or 1.0,),
    }


def _loss_parts(settings: Settings) -> Parts:
    (size,), (rate,) = settings.get("size", (1.0,)), settings.get("rate", (1.0,))
    return Parts((), (Parameter("loss", "1/s", scale=rate / size), Parameter("constant", "{out}/s", scale=rate)))


def _loss_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return Human("loss_rate", float(p[0]), "1/s"), Human("level_without_loss", float(p[1] / (p[0] or np.inf)), "{out}")


LINEAR_LOSS = Effect(
    name="linear_loss",
    summary="a level, temperature or current loses in proportion to itself: leakage, cooling, resistance",
    kind="feedback",
    stages=("mechanics", "actuator", "sensor"),
    parts=_loss_parts,
    equation=r"\dot x = \dots - a\,(x - x_0)",
    source="F. P. Incropera, D. P. DeWitt, T. L. Bergman, A. S. Lavine, Fundamentals of Heat and Mass Transfer, 6th"
    " ed. (2007), eq. 1.3a (Newton's law of cooling)",
    excitation="high and low levels, each held",
    confusable_with=("ac_coupling", "nonlinear_heat_loss", "overflow", "square_root_outflow"),
    prepare=_range,
    basis=lambda x, ctx, q, settings: np.stack([-x, np.ones(x.size)], axis=1),
    fill=lambda q, w, settings: packed("spring", SPRING, {2: w[0], 9: w[1]}),
    report=_loss_report,
    vanishes_with=(("loss_rate",),),
    weights_beside=lambda settings: 1,
    acts_on=("storage",),
    proportional=True,
    shifts_line=True,
)
