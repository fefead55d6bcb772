"""Position-dependent forces: a spring that hardens or softens, cogging, gravity on a lever, and a joint with play."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sim_devices.physics.effect import Array, Basis, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.forces import COGGING, SPRING, UNCENTRED, base_moves, packed
from sim_devices.physics.friction import velocity_of
from sim_devices.physics.statistics import best_starts, least_squares, thin

MOST_PERIOD = 0.8  # of the travel: what was not seen to come again is a spring


def _travel(x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    return {"size": (float(np.max(np.abs(x[k]))) or 1.0,), "travel": (float(np.ptp(x[k])) or 1.0,)}


def _spring_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    return {**_travel(x, residual, ctx), **({UNCENTRED: (1.0,)} if UNCENTRED in ctx.facts else {})}


def _spring_parts(settings: Settings) -> Parts:
    terms = [Parameter("cubic", "1/({out}^2 s^2)"), Parameter("quadratic", "1/({out} s^2)")]
    if UNCENTRED in settings:
        # of a spring that is not at rest where the record begins, with no other spring to take its slope there
        terms.append(Parameter("linear", "1/s^2"))
    return Parts((), tuple(terms), np.diag([0.0, 0.02, 0.0][: len(terms)]))


def _spring_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    terms = [x * x * x, x * x, *((x,) if UNCENTRED in settings else ())]
    return -np.stack(terms, axis=1)


def _spring_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    out = [
        Human("cubic_stiffness", float(p[0]) / g, "{in}/{out}^3"),
        Human("quadratic_stiffness", float(p[1]) / g, "{in}/{out}^2"),
    ]
    if UNCENTRED in settings:
        out.append(Human("stiffness_at_start", float(p[2]) / g, "{in}/{out}"))
    return out


_CUBIC = Effect(
    name="cubic_stiffness",
    summary="spring that hardens or softens",
    kind="feedback",
    by_position=True,
    stages=("mechanics",),
    parts=_spring_parts,
    equation=r"m\ddot x + c\dot x + k x + k_2 x^2 + k_3 x^3 = F",
    source="I. Kovacic, M. J. Brennan, The Duffing Equation, Wiley 2011, eq. 1.1",
    excitation="small and large amplitudes",
    confusable_with=("static_nonlinearity", "saturation"),
    prepare=_spring_settings,
    basis=_spring_basis,
    fill=lambda q, w, settings: packed("spring", SPRING, dict(enumerate(w))),
    report=_spring_report,
    vanishes_with=(("cubic_stiffness", "quadratic_stiffness", "quintic_stiffness"),),
    acts_on=("motion", "joint"),
)


def _and(term: Parameter, settings: Settings) -> Parts:
    """Return the parts of a spring with one term more."""
    terms = (*_spring_parts(settings).weights, term)
    return Parts((), terms, np.diag([0.0, 0.02, *[0.0] * (len(terms) - 2)]))


def _and_fill(place: int, q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    return packed("spring", SPRING, {**dict(enumerate(w[:-1])), place: w[-1]})


def _quintic_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    quintic = Human("quintic_stiffness", float(p[-1]) / (scale or 1.0), "{in}/{out}^5")
    return (*_spring_report(p[:-1], settings, scale), quintic)


_QUINTIC = replace(
    _CUBIC,
    parts=partial(_and, Parameter("quintic", "1/({out}^4 s^2)")),
    equation=r"m\ddot x + c\dot x + k x + k_2 x^2 + k_3 x^3 + k_5 x^5 = F",
    basis=lambda x, ctx, q, settings: np.column_stack([_spring_basis(x, ctx, q, settings), -(x**5)]),
    fill=partial(_and_fill, 3),
    report=_quintic_report,
)


def _lossy_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    time = Human("loss_time", float(p[-1] / (2.0 * p[0])) if p[0] else 0.0, "s")
    return (*_spring_report(p[:-1], settings, scale), time)


_LOSSY = replace(
    _CUBIC,
    summary="spring that hardens, of a material whose stress follows the rate of its strain, too",
    parts=partial(_and, Parameter("loss", "1/({out}^2 s)", 0.0)),
    equation=r"m\ddot x + c\dot x + k x + k_2 x^2 + k_3 (x^3 + 2\tau x^2\dot x) = F",
    source="S. Zaitsev, O. Shtempluck, E. Buks, O. Gottlieb, Nonlinear Dynamics 67 (2012) 859 (Kelvin-Voigt under"
    " the strain x^2 of large deflections)",
    basis=lambda x, ctx, q, settings: np.column_stack(
        [_spring_basis(x, ctx, q, settings), -x * x * velocity_of(x, ctx)]
    ),
    fill=partial(_and_fill, 5),
    report=_lossy_report,
)
CUBIC_STIFFNESS = replace(_CUBIC, variants=(_QUINTIC, _LOSSY))


def _cog_parts(settings: Settings) -> Parts:
    travel = settings.get("travel", (1.0,))[0]
    lo, hi = settings.get("near", (2e-3 * travel, MOST_PERIOD * travel))
    unit = "{out}/s^2"
    return Parts(
        (Parameter("period", "{out}", lo, hi, log=True, scale=1e-3 * lo),),
        tuple(Parameter(m, unit) for m in ("sin1", "cos1", "sin2", "cos2")),
        np.diag([0.0, 0.0, 0.05, 0.05]),
    )


def _cog_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    a = 2 * np.pi * x / q[0]
    return np.stack([np.sin(a), np.cos(a), np.sin(2 * a), np.cos(2 * a)]).T


def _cog_scan(x: Array, residual: Array, ctx: Context, travel: float) -> list[tuple[float, float]]:
    """Return (misfit, period), best first, on a grid with phase steps of a quarter turn over the travel, then finer."""
    k = thin(ctx.keep, 4000)
    line = np.stack([np.ones(k.size), *(c[k] for c in base_moves(x, ctx))], axis=1)

    def tried(turns: Array) -> list[tuple[float, float]]:
        out: list[tuple[float, float]] = []
        for period in travel / turns:
            a = 2 * np.pi * x / period
            cols = np.stack([ctx.to_output(np.sin(a)), ctx.to_output(np.cos(a))], axis=1)[k]
            out.append((least_squares(np.column_stack([line, cols]), residual[k])[1], float(period)))
        return sorted(out)

    coarse = tried(np.concatenate([np.arange(1 / MOST_PERIOD, 60, 0.3), np.geomspace(60, 300, 80)]))
    near = travel / coarse[0][1]
    fine = tried(near + np.linspace(-0.3, 0.3, 13) * max(1.0, near / 15))
    return sorted([*fine[:2], *coarse[:2]])


def _cog_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    settings = dict(_travel(x, residual, ctx))
    best = _cog_scan(x, residual, ctx, settings["travel"][0])[:3]
    settings["periods"] = tuple(p for _, p in best)
    return settings


def _cog_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    return tuple((p,) for p in settings.get("periods", (settings["travel"][0] / 4,)))


def _cog_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return (
        Human("period", float(p[0]), "{out}"),
        Human("amplitude_1", float(np.hypot(p[1], p[2])) / g, "{in}"),
        Human("amplitude_2", float(np.hypot(p[3], p[4])) / g, "{in}"),
    )


COGGING_FORCE = Effect(
    name="cogging",
    summary="force periodic in position",
    kind="feedback",
    by_position=True,
    not_units=("V", "A", "C", "degC", "K", "Pa"),  # magnets and teeth are at places
    stages=("mechanics", "actuator"),
    parts=_cog_parts,
    equation=r"m\ddot x = F + \sum_h a_h \sin(2\pi h x/\lambda) + b_h \cos(2\pi h x/\lambda)",
    source="J. R. Hendershot, T. J. E. Miller, Design of Brushless Permanent-Magnet Machines, section 5.4",
    excitation="slow travel over several periods",
    confusable_with=("static_nonlinearity", "coulomb_friction"),
    prepare=_cog_prepare,
    guess=_cog_guess,
    basis=_cog_basis,
    fill=lambda q, w, settings: packed("cogging", COGGING, dict(enumerate((q[0], *w)))),
    report=_cog_report,
    vanishes_with=(("amplitude_*",),),
    essential=("period",),
)


LEAST_TURNED = 0.5
"""Least number of turns over which a load must be seen: over fewer, its sine looks like a softening spring."""


def _lever_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("largest_load", float(np.hypot(p[0], p[1])) / (scale or 1.0), "{in}"),
        Human("angle_at_rest", float(np.arctan2(p[1], -p[0])), "rad"),
        Human("turns_seen", settings["travel"][0] / (2.0 * np.pi), "1"),
    )


GRAVITY_LOAD = Effect(
    name="gravity_load",
    summary="weight on a lever that turns: a load that follows the sine of the angle",
    kind="feedback",
    by_position=True,
    stages=("mechanics",),
    parts=lambda settings: Parts((), (Parameter("sine", "{out}/s^2"), Parameter("cosine", "{out}/s^2"))),
    equation=r"J\ddot\varphi = M - m g r \sin(\varphi - \varphi_0)",
    source="M. W. Spong, S. Hutchinson, M. Vidyasagar, Robot Modeling and Control, Wiley 2006, chapter 7 (single link)",
    excitation="at least half a turn, slowly",
    confusable_with=("cogging", "cubic_stiffness"),
    prepare=_travel,
    basis=lambda x, ctx, q, settings: np.stack([np.sin(x), np.cos(x)], axis=1),
    fill=lambda q, w, settings: packed("cogging", COGGING, {5: w[0], 6: w[1]}),
    report=_lever_report,
    position_units=("rad",),
    limits={"turns_seen": (LEAST_TURNED, np.inf)},
    vanishes_with=(("largest_load",),),
)


def _gap_parts(settings: Settings) -> Parts:
    size, travel = settings.get("size", (1.0,))[0], settings.get("travel", (1.0,))[0]
    gap = Parameter("half_gap", "{out}", 1e-3 * travel, 0.5 * travel, log=True, scale=0.02 * travel)
    centre = Parameter("centre", "{out}", -size, size, scale=0.02 * travel)
    return Parts((gap, centre), (Parameter("stiffness", "1/s^2", 0.0),))


def _gap_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    d = x - q[1]
    return -(d - np.clip(d, -q[0], q[0]))[:, None]


def _lost_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return np.clip(x - q[1], -q[0], q[0])[:, None]


def _gap_guess(
    x: Array, residual: Array, ctx: Context, settings: Settings, basis: Basis = _gap_basis
) -> Sequence[Sequence[float]]:
    k = thin(ctx.keep, 8000)
    line = np.stack([np.ones(k.size), *(c[k] for c in base_moves(x, ctx))], axis=1)
    travel, middle = settings["travel"][0], 0.5 * float(np.max(x[ctx.keep]) + np.min(x[ctx.keep]))
    grid = [(travel * gap, centre) for centre in dict.fromkeys((0.0, middle)) for gap in (0.03, 0.1, 0.2, 0.3, 0.4)]
    column = lambda q: ctx.to_output(np.ascontiguousarray(basis(x, ctx, np.array(q), settings)[:, 0]))[k]  # noqa: E731
    size = settings["size"][0]
    best = best_starts(grid, column, line, residual[k])[:2]
    return tuple((gap, float(np.clip(centre, -size, size))) for gap, centre in best)


def _gap_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("gap", 2 * float(p[0]), "{out}"),
        Human("centre", float(p[1]), "{out}"),
        Human("contact_stiffness", float(p[2]) / (scale or 1.0), "{in}/{out}"),
    )


_GAP = Effect(
    name="clearance",
    summary="play at a joint: a spring that takes hold beyond a gap",
    kind="feedback",
    by_position=True,
    stages=("mechanics", "mounting"),
    parts=_gap_parts,
    equation=r"m\ddot x + c\dot x + k x = F - k_c\,(d - \max(-g, \min(g, d))),\; d = x - x_0",
    source="M. Nordin, P.-O. Gutman, Automatica 38 (2002) 1633, eq. 4 (dead-zone model of a gap in a shaft)",
    excitation="amplitudes within the gap and beyond it",
    confusable_with=("cubic_stiffness", "backlash", "saturation"),
    prepare=_travel,
    guess=_gap_guess,
    basis=_gap_basis,
    fill=lambda q, w, settings: packed("spring", SPRING, {6: w[0], 7: q[0], 8: q[1]}),
    report=_gap_report,
)

_LOST = replace(
    _GAP,
    equation=r"F = k\,(d - \max(-g, \min(g, d))),\; d = x_1 - b x_2 - x_0",
    guess=partial(_gap_guess, basis=_lost_basis),
    basis=_lost_basis,
    fill=lambda q, w, settings: packed("spring", SPRING, {2: -w[0], 6: w[0], 7: q[0], 8: q[1], 9: -w[0] * q[1]}),
    acts_on=("joint",),
)
CLEARANCE = replace(_GAP, variants=(_LOST,))
