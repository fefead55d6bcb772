"""Dry friction inside an equation of motion: Coulomb, and Stribeck's fall as motion starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.forces import FRICTION, OFFSET, base_moves, loop_along, packed
from sim_devices.physics.memory import dahl
from sim_devices.physics.statistics import Start, best_starts, smooth, thin


def velocity_of(x: Array, ctx: Context) -> Array:
    """Return the recorded velocity (n,), or the smoothed derivative of the position x (n,) where none was recorded."""
    v = ctx.signals.get("velocity")
    if v is not None:
        return v
    return smooth(np.gradient(smooth(x, 5), ctx.dt), 9)


def _still(v: Array) -> float:
    """Return the speed below which a measured velocity counts as noise: a small part of the usual speed."""
    return 0.02 * float(np.sqrt(np.mean(v * v))) or 1e-9


def soft_sign(v: Array) -> Array:
    """Return the sign of a measured velocity, smoothed around zero, where noise decides it."""
    return np.tanh(v / _still(v))


def _no_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    v = velocity_of(x, ctx)
    offset = {OFFSET: (1.0,)} if OFFSET in ctx.facts else {}
    return {"speed": (float(np.sqrt(np.mean(v[ctx.keep] ** 2))) or 1.0,), **offset}


_UNIT = "{out}/s^2"


def _sided(settings: Settings) -> list[int]:
    """Return which of level, asymmetry and viscous asymmetry are parameters.

    A level that differs with the direction is one that does not beside a constant force, in motion and at rest. Where
    the twin has such a force, the data show only their sum.
    """
    return [0, 2] if OFFSET in settings else [0, 1, 2]


def _levels(w: Array, settings: Settings) -> Array:
    """Return level, asymmetry and viscous asymmetry (3,) from the first of the weights ``w``."""
    out = np.zeros(3)
    at = _sided(settings)
    out[at] = w[: len(at)]
    return out


_ROUGH = (0.0, 0.05, 0.05)  # penalties of level, asymmetry and viscous asymmetry


def _coulomb_parts(settings: Settings) -> Parts:
    every = Parameter("level", _UNIT, 0.0), Parameter("asymmetry", _UNIT), Parameter("viscous_asymmetry", "1/s")
    at = _sided(settings)
    return Parts((), tuple(every[i] for i in at), np.diag([_ROUGH[i] for i in at]))


def _coulomb_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    s = soft_sign(v)
    return -np.stack([s, s * s, np.abs(v)], axis=1)[:, _sided(settings)]


def _coulomb_fill(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    return packed("friction", FRICTION, dict(zip((0, 1, 4), _levels(w, settings), strict=True)))


def _coulomb_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    level, asymmetry, viscous = _levels(p, settings).tolist()
    return (
        Human("coulomb_forward", (level + asymmetry) / g, "{in}"),
        Human("coulomb_backward", (level - asymmetry) / g, "{in}"),
        Human("viscous_difference", 2 * viscous / g, "{in} s/{out}"),
    )


def _bristle_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    travel = float(np.ptp(smooth(x, 5)[ctx.keep])) or 1.0
    return {**_no_settings(x, residual, ctx), "travel": (travel,)}


def _bristle_distance(settings: Settings) -> Parameter:
    travel = settings.get("travel", (1.0,))[0]
    # what yields over more than that is a spring with memory: hysteresis
    return Parameter("presliding", "{out}", 2e-5 * travel, 0.02 * travel, log=True, scale=1e-3 * travel)


def _bent(x: Array, ctx: Context, distance: float) -> Array:
    """Return the bristle deflection (n,), -1..1, along the recorded travel."""
    at = np.array(ctx.starts, np.int64)
    u = smooth(x, 5)
    return dahl(u, np.array([distance]), np.zeros(1), float(u[0]), at)[:, 0] / distance


def _lugre_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return -_bent(x, ctx, q[0])[:, None]


def _lugre_fill(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    return packed("friction", FRICTION, {0: w[0], 5: max(w[0], 0.0) / q[0]})


def _lugre_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    grid = settings["travel"][0] * np.geomspace(5e-4, 0.015, 5)
    return tuple((r,) for r in _best_bristles(x, residual, ctx, grid)[:2])


def _best_bristles(x: Array, residual: Array, ctx: Context, grid: Array) -> list[float]:
    """Rank the presliding distances of ``grid`` by how well their force fits the residual, best first."""
    return [r for (r,) in _best(lambda q: -_bent(x, ctx, q[0]), [(r,) for r in grid.tolist()], residual, ctx)]


def _best(
    force: Callable[[Start], Array], grid: Sequence[Start], residual: Array, ctx: Context, beside: Sequence[Array] = ()
) -> list[Start]:
    """Rank the starts of ``grid`` by how well their force and the changes ``beside`` fit the residual, best first."""
    k = thin(ctx.keep, 8000)
    line = np.column_stack([np.ones(k.size), *(c[k] for c in beside)])
    return best_starts(grid, lambda q: ctx.to_output(np.ascontiguousarray(force(q)))[k], line, residual[k])


def _lugre_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return (
        Human("coulomb_forward", float(p[1]) / g, "{in}"),
        Human("coulomb_backward", float(p[1]) / g, "{in}"),
        Human("presliding_distance", float(p[0]), "{out}"),
    )


_FRICTION_SOURCE = "B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994) 1083, eqs. 1-3"


def _spring_parts(settings: Settings) -> Parts:
    travel = settings.get("travel", (1.0,))[0]
    yielding = Parameter("yield_distance", "{out}", 0.02 * travel, 1.5 * travel, log=True, scale=0.05 * travel)
    return Parts((yielding,), (Parameter("level", _UNIT, 0.0),))


def _spring_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    grid = settings["travel"][0] * np.geomspace(0.03, 0.8, 6)
    return tuple((r,) for r in _best_bristles(x, residual, ctx, grid)[:2])


def _spring_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return (
        Human("force_loop_half_height", float(p[1]) / g, "{in}"),
        Human("presliding_stiffness", float(p[1] / p[0]) / g, "{in}/{out}"),
    )


SMOOTH_SPRING = Effect(
    name="hysteresis",
    summary="one smooth elastic-plastic element on the position (Bouc-Wen)",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_spring_parts,
    equation=r"m\ddot x + c\dot x + k x = F - a z,\; \dot z = \dot x / r - |\dot x| z / r",
    source="Y. K. Wen, J. Eng. Mech. 102 (1976) 249, eq. 3 with n = 1 and gamma = 0; P. R. Dahl 1976",
    excitation="reversals of motion at several amplitudes",
    prepare=_bristle_settings,
    guess=_spring_guess,
    basis=_lugre_basis,
    fill=_lugre_fill,
    report=_spring_report,
    vanishes_with=(("force_loop_half_height",),),
)

LEANS = (-1.3, -0.6, 0.5)
"""Start values for the search of the lean. At zero the element is the smooth spring."""


def _loop_parts(settings: Settings) -> Parts:
    plain = _spring_parts(settings)
    return Parts((*plain.nonlinear, Parameter("lean", "1", -2.0, 1.0, scale=0.1)), plain.weights)


def _loop_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    bent = loop_along(np.ascontiguousarray(smooth(x, 5)), float(q[0]), float(q[1]), np.array(ctx.starts, np.int64))
    return (-bent / q[0])[:, None]


def _loop_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    grid = [(r, lean) for r in (settings["travel"][0] * np.geomspace(0.05, 0.8, 4)).tolist() for lean in LEANS]
    force = lambda q: _loop_basis(x, ctx, np.array(q), settings)[:, 0]  # noqa: E731
    return _best(force, grid, residual, ctx, base_moves(x, ctx)[1:3])[:2]


def _loop_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return (
        Human("presliding_stiffness", float(p[2] / p[0]) / g, "{in}/{out}"),
        Human("yield_distance", float(p[0]), "{out}"),
        Human("yield_share_of_travel", float(p[0]) / settings.get("travel", (1.0,))[0], "1"),
        Human("lean", float(p[1]), "1"),
    )


BOUC_WEN = replace(
    SMOOTH_SPRING,
    summary="one smooth hysteretic element on the position, whose loop may lean (Bouc-Wen)",
    parts=_loop_parts,
    equation=r"m\ddot x + c\dot x + k x = F - a z,\; \dot z = \dot x - (|\dot x| z + \lambda \dot x |z|) / r",
    source="Y. K. Wen, J. Eng. Mech. 102 (1976) 249, eq. 3 with n = 1 (beta = 1/r, gamma = lambda/r)",
    guess=_loop_guess,
    basis=_loop_basis,
    # zero is the mark of a row without a lean
    fill=lambda q, w, settings: packed(
        "friction", FRICTION, {0: w[0], 5: max(w[0], 0.0) / q[0], 6: float(q[1]) if q[1] != 0.0 else 1e-12}
    ),
    report=_loop_report,
    vanishes_with=(("presliding_stiffness",),),
    # what does not yield within the recorded motion is a spring
    plain_in={"yield_share_of_travel": (1.0, np.inf)},
)

_LUGRE_SOURCE = "C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, IEEE Trans. AC 40 (1995) 419, eqs. 3-4"

_COULOMB = Effect(
    name="coulomb_friction",
    summary="constant force against the motion",
    kind="feedback",
    stages=("mechanics",),
    parts=_coulomb_parts,
    equation=r"m\ddot x = F - F_c\,\mathrm{sgn}\,\dot x - \Delta F - \Delta c\,|\dot x|",
    source=_FRICTION_SOURCE,
    excitation="reversals of motion, at speeds that differ",
    prepare=_no_settings,
    basis=_coulomb_basis,
    fill=_coulomb_fill,
    report=_coulomb_report,
    # against one direction alone it is another force
    plain_without=(("coulomb_forward",), ("coulomb_backward",)),
)
_BRISTLES = replace(
    _COULOMB,
    summary="constant force against the motion, behind bristles that give way over a small distance",
    parts=lambda settings: Parts((_bristle_distance(settings),), (Parameter("level", _UNIT, 0.0),)),
    equation=r"m\ddot x = F - \sigma z,\; \dot z = \dot x - \sigma |\dot x| z / F_c",
    source=_LUGRE_SOURCE + "; P. R. Dahl, AIAA J. 14 (1976) 1675",
    prepare=_bristle_settings,
    guess=_lugre_guess,
    basis=_lugre_basis,
    fill=_lugre_fill,
    report=_lugre_report,
)


def _gentle_parts(settings: Settings) -> Parts:
    speed = settings.get("speed", (1.0,))[0]
    return Parts(
        (Parameter("full_speed", "{out}/s", 2e-3 * speed, 0.5 * speed, log=True, scale=0.05 * speed),),
        (Parameter("level", _UNIT, 0.0),),
    )


def _gentle_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    return (-soft_sign(v) * (1.0 - np.exp(-((v / q[0]) ** 2))))[:, None]


def _gentle_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    grid = [(full,) for full in (settings["speed"][0] * np.geomspace(0.01, 0.4, 6)).tolist()]
    return _best(lambda q: _gentle_basis(x, ctx, np.array(q), settings)[:, 0], grid, residual, ctx)[:2]


def _gentle_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return (
        Human("coulomb_forward", float(p[1]) / g, "{in}"),
        Human("coulomb_backward", float(p[1]) / g, "{in}"),
        Human("full_speed", float(p[0]), "{out}/s"),
    )


_GENTLE = replace(
    _COULOMB,
    summary="constant force against the motion, which sets in smoothly around rest",
    parts=_gentle_parts,
    equation=r"m\ddot x = F - F_c (1 - e^{-(\dot x/v_0)^2})\,\mathrm{sgn}\,\dot x",
    source=_FRICTION_SOURCE + "; smooth around rest as every simulator has it (tanh, arctan and the like)",
    prepare=_no_settings,
    guess=_gentle_guess,
    basis=_gentle_basis,
    fill=lambda q, w, settings: packed("friction", FRICTION, {0: w[0], 2: -w[0], 3: q[0]}),
    report=_gentle_report,
)

COULOMB_FRICTION = replace(
    _COULOMB,
    confusable_with=("stribeck_friction", "backlash", "hysteresis", "dead_zone"),
    variants=(_BRISTLES, _GENTLE),
)


def _stribeck_parts(settings: Settings) -> Parts:
    speed = settings.get("speed", (1.0,))[0]
    return Parts(
        (Parameter("stribeck_speed", "{out}/s", 1e-3 * speed, 2 * speed, log=True, scale=0.05 * speed),),
        (*_coulomb_parts(settings).weights, Parameter("extra", _UNIT, 0.0)),
        np.diag([*(_ROUGH[i] for i in _sided(settings)), 0.0]),
    )


def _stribeck_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    extra = -soft_sign(v) * np.exp(-((v / q[0]) ** 2))
    return np.column_stack([_coulomb_basis(x, ctx, q, settings), extra])


def _renamed_parts(settings: Settings, name: str) -> Parts:
    parts = _stribeck_parts(settings)
    return replace(parts, nonlinear=(replace(parts.nonlinear[0], name=name),))


def _tustin_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    return np.column_stack([_coulomb_basis(x, ctx, q, settings), -soft_sign(v) * np.exp(-np.abs(v) / q[0])])


def _slow_fall_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    return np.column_stack([_coulomb_basis(x, ctx, q, settings), -soft_sign(v) / (1.0 + (v / q[0]) ** 2)])


def _stribeck_fill(q: Array, w: Array, settings: Settings, law: float = 0.0) -> dict[str, Array]:
    level, asymmetry, viscous = _levels(w, settings).tolist()
    return packed("friction", FRICTION, {0: level, 1: asymmetry, 4: viscous, 2: w[-1], 3: q[0], 7: law})


def _stribeck_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    coulomb = [ctx.to_output(c) for c in _coulomb_basis(x, ctx, np.zeros(1), settings).T]
    grid = [(vs,) for vs in (settings["speed"][0] * np.geomspace(0.01, 1.0, 8)).tolist()]
    extra = lambda q: _stribeck_basis(x, ctx, np.array(q), settings)[:, -1]  # noqa: E731
    return _best(extra, grid, residual, ctx, coulomb)[:2]


def _stribeck_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    level, asymmetry, viscous = _levels(p[1:], settings).tolist()
    return (
        Human("coulomb_forward", (level + asymmetry) / g, "{in}"),
        Human("coulomb_backward", (level - asymmetry) / g, "{in}"),
        Human("static_friction", (level + float(p[-1])) / g, "{in}"),
        Human("rise_at_rest", float(p[-1]) / g, "{in}"),
        Human("stribeck_speed", float(p[0]), "{out}/s"),
        Human("viscous_difference", 2 * viscous / g, "{in} s/{out}"),
    )


def _stribeck_bristle_parts(settings: Settings, name: str = "stribeck_speed") -> Parts:
    speed = _renamed_parts(settings, name).nonlinear[0]
    return Parts((speed, _bristle_distance(settings)), (Parameter("level", _UNIT, 0.0), Parameter("extra", _UNIT, 0.0)))


def _stribeck_bristle_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    bent = _bent(x, ctx, q[1])
    v = velocity_of(x, ctx)
    return -np.stack([bent, bent * np.exp(-((v / q[0]) ** 2))], axis=1)


def _slow_fall_bristle_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    bent = _bent(x, ctx, q[1])
    return -np.stack([bent, bent / (1.0 + (velocity_of(x, ctx) / q[0]) ** 2)], axis=1)


def _stribeck_bristle_fill(q: Array, w: Array, settings: Settings, law: float = 0.0) -> dict[str, Array]:
    return packed("friction", FRICTION, {0: w[0], 2: w[1], 3: q[0], 5: max(w[0], 0.0) / q[1], 7: law})


def _stribeck_bristle_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    travel = settings["travel"][0]
    near = _best_bristles(x, residual, ctx, travel * np.geomspace(5e-4, 0.015, 5))[0]
    return tuple((vs[0], near) for vs in _stribeck_guess(x, residual, ctx, settings))


def _stribeck_bristle_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return (
        Human("coulomb_forward", float(p[2]) / g, "{in}"),
        Human("coulomb_backward", float(p[2]) / g, "{in}"),
        Human("static_friction", float(p[2] + p[3]) / g, "{in}"),
        Human("rise_at_rest", float(p[3]) / g, "{in}"),
        Human("stribeck_speed", float(p[0]), "{out}/s"),
        Human("presliding_distance", float(p[1]), "{out}"),
    )


_SQUARED = Effect(
    name="stribeck_friction",
    summary="friction that falls as motion starts",
    kind="feedback",
    stages=("mechanics",),
    parts=_stribeck_parts,
    equation=r"m\ddot x = F - \left(F_c + F_s e^{-(\dot x/v_s)^2}\right)\mathrm{sgn}\,\dot x - \Delta c\,|\dot x|",
    source=_FRICTION_SOURCE,
    excitation="slow motion and reversals, beside fast motion",
    prepare=_no_settings,
    guess=_stribeck_guess,
    basis=_stribeck_basis,
    fill=_stribeck_fill,
    report=_stribeck_report,
    # without a rise it is Coulomb's
    plain_without=(("rise_at_rest",),),
    plain="coulomb_friction",
    # a fall that is wider than all speeds that occur is viscous, and one that is narrower is not seen
    essential=("stribeck_speed",),
)

_TUSTIN = replace(
    _SQUARED,
    summary="friction that falls as motion starts, at first quickly and then slowly",
    parts=partial(_renamed_parts, name="decay_speed"),
    equation=r"m\ddot x = F - \left(F_c + F_s e^{-|\dot x|/v_s}\right)\mathrm{sgn}\,\dot x - \Delta c\,|\dot x|",
    source="A. Tustin, J. IEE 94 IIA (1947) 143; " + _FRICTION_SOURCE,
    basis=_tustin_basis,
    fill=partial(_stribeck_fill, law=1.0),
)

_SLOW_FALL = replace(
    _SQUARED,
    summary="friction that falls as motion starts, with a long tail at speed",
    parts=partial(_renamed_parts, name="half_speed"),
    equation=r"m\ddot x = F - \left(F_c + F_s / (1 + (\dot x/v_s)^2)\right)\mathrm{sgn}\,\dot x - \Delta c\,|\dot x|",
    source="D. P. Hess, A. Soom, J. Tribology 112 (1990) 147; " + _FRICTION_SOURCE,
    basis=_slow_fall_basis,
    fill=partial(_stribeck_fill, law=2.0),
)

_STRIBECK_BRISTLES = replace(
    _SQUARED,
    summary="friction that falls as motion starts, behind bristles that give way over a small distance",
    parts=_stribeck_bristle_parts,
    equation=r"m\ddot x = F - \sigma z,\; \dot z = \dot x - \sigma |\dot x| z /"
    r" (F_c + F_s e^{-(\dot x/v_s)^2})",
    source=_LUGRE_SOURCE,
    prepare=_bristle_settings,
    guess=_stribeck_bristle_guess,
    basis=_stribeck_bristle_basis,
    fill=_stribeck_bristle_fill,
    report=_stribeck_bristle_report,
)

_SLOW_FALL_BRISTLES = replace(
    _STRIBECK_BRISTLES,
    summary=_SLOW_FALL.summary + ", behind bristles that give way over a small distance",
    parts=partial(_stribeck_bristle_parts, name="half_speed"),
    equation=r"m\ddot x = F - \sigma z,\; \dot z = \dot x - \sigma |\dot x| z /"
    r" (F_c + F_s / (1 + (\dot x/v_s)^2))",
    source=_LUGRE_SOURCE + "; " + _SLOW_FALL.source,
    basis=_slow_fall_bristle_basis,
    fill=partial(_stribeck_bristle_fill, law=2.0),
)

STRIBECK_FRICTION = replace(
    _SQUARED,
    confusable_with=("coulomb_friction",),
    other_laws=(_SLOW_FALL,),
    variants=(
        replace(_TUSTIN, other_laws=(_SLOW_FALL,)),
        replace(_STRIBECK_BRISTLES, other_laws=(_SLOW_FALL_BRISTLES,)),
    ),
)
