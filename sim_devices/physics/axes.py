"""Effects of the other axes on one axis: misalignment, quadratic bias, varying sensitivity, soft iron."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.rigid import centripetal_row, rates, tangential_row
from sim_devices.physics.statistics import least_squares, thin

_VECTORS = ("specific_force_", "field_")


def own_axis(output: str) -> str:
    """Return the axis letter of an output such as ``voltage_x`` or ``accel_3y``."""
    return output[-1]


def vector_of(signals: Mapping[str, Array]) -> dict[str, str]:
    """Return axis letter -> signal of the recorded input vector."""
    for prefix in _VECTORS:
        found = {a: prefix + a for a in "xyz" if prefix + a in signals}
        if found:
            return found
    return {}


def others(signals: Mapping[str, Array], output: str) -> list[str]:
    """Return the axis letters other than the output's own whose signals vary."""
    return [a for a, s in vector_of(signals).items() if a != own_axis(output) and float(np.ptp(signals[s])) > 0.0]


def _available(signals: Mapping[str, Array], output: str) -> str:
    return "" if others(signals, output) else "no other axis was recorded, or none changes"


def _turnable(signals: Mapping[str, Array], output: str) -> str:
    return _available(signals, output) if own_axis(output) in "xyz" else "the output is no axis of a vector"


def vector_at(ctx: Context) -> dict[str, Array]:
    """Return axis letter -> specific force (n,) at the sensor, which a rotation changes with the sensor's position r.

    f + alpha x r + omega x (omega x r), H. Goldstein, Classical Mechanics, 3rd ed., eq. 4.91; r is the nominal one.
    """
    here = {a: ctx.signals[s] for a, s in vector_of(ctx.signals).items()}
    r = np.array(ctx.facts.get("position_m", ()))
    if r.size != 3 or not r.any():
        return here
    w = rates(ctx)
    rows = {a: tangential_row(w, i, ctx.dt) + centripetal_row(w, i) for i, a in enumerate("xyz") if a in here}
    return {a: v + rows[a] @ r for a, v in here.items()}


def _columns_of(ctx: Context, axes: Sequence[str]) -> list[Array]:
    vector = vector_at(ctx)
    return [vector[a] for a in axes]


def _axes(settings: Settings) -> list[str]:
    return ["xyz"[int(i)] for i in settings.get("axes", (0.0, 1.0, 2.0))]


def _axis_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    return {"axes": tuple(float("xyz".index(a)) for a in others(ctx.signals, ctx.output))}


# -- misalignment -----------------------------------------------------------------------------------

_PAIRS = (("x", "y"), ("x", "z"), ("y", "z"))


def _rotation_columns(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    """Return the columns of a small rotation of the whole vector: output i gets -(phi x f)_i."""
    vector = vector_at(ctx)
    i = "xyz".index(own_axis(ctx.output))
    out = np.zeros((ctx.t.size, 3))
    j, k = (i + 1) % 3, (i + 2) % 3
    # (phi x f)_i = phi_j f_k - phi_k f_j
    if "xyz"[k] in vector:
        out[:, j] = -vector["xyz"[k]]
    if "xyz"[j] in vector:
        out[:, k] = vector["xyz"[j]]
    return out


def _mis_parts(settings: Settings) -> Parts:
    return Parts((), tuple(Parameter(f"from_{a}", "{out}/{in}", scale=0.01) for a in _axes(settings)))


def _mis_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    axes = _axes(settings)
    if not vector_of(ctx.signals):
        return np.zeros((ctx.t.size, len(axes)))
    return np.stack(_columns_of(ctx, axes), axis=1)


def _in_mrad(name: str, axes: Iterable[str], p: Array, scale: float) -> Sequence[Human]:
    return [Human(name + a, 1e3 * float(v) / (scale or 1.0), "mrad") for a, v in zip(axes, p, strict=True)]


_MIS_SOURCE = "IEEE Std 1293-2018, model equation (cross-axis sensitivities); D. Titterton, J. Weston, ch. 8"

_ROTATION = Effect(
    name="misalignment",
    summary="the whole sensor is turned by a small angle",
    kind="add",
    stages=("mounting",),
    parts=lambda settings: Parts((), tuple(Parameter(f"rotation_{a}", "{out}/{in}", scale=0.01) for a in "xyz")),
    equation=r"y = x - s\,(\varphi \times f)_i",
    source=_MIS_SOURCE,
    excitation="every axis moved on its own",
    basis=_rotation_columns,
    report=lambda p, settings, scale: _in_mrad("rotation_", "xyz", p, scale),
    driven=False,
    sites=("output",),
    available=_turnable,
    shared=True,
    vanishes_with=(("rotation_*",),),
)

MISALIGNMENT = Effect(
    name="misalignment",
    summary="linear sensitivity to the other axes",
    kind="add",
    stages=("mounting", "sensor"),
    parts=_mis_parts,
    equation=r"y_i = x_i + \sum_{j \ne i} m_{ij} f_j",
    source=_MIS_SOURCE,
    excitation="every axis moved on its own, or tumbles",
    confusable_with=("soft_iron", "sensor_position_error"),
    prepare=_axis_settings,
    basis=_mis_basis,
    report=lambda p, settings, scale: _in_mrad("angle_to_", _axes(settings), p, scale),
    driven=False,
    sites=("output",),
    available=_available,
    variants=(_ROTATION,),
    vanishes_with=(("angle_to_*",),),
)

# -- soft iron --------------------------------------------------------------------------------------


def _iron_parts(settings: Settings) -> Parts:
    return Parts((), tuple(Parameter(i + j, "{out}/{in}", scale=0.01) for i, j in _PAIRS), 0.02 * np.eye(3))


def _iron_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    vector, own = vector_of(ctx.signals), own_axis(ctx.output)
    out = np.zeros((ctx.t.size, 3))
    for c, pair in enumerate(_PAIRS):
        if own in pair and (other := pair[pair[0] == own]) in vector:
            out[:, c] = ctx.signals[vector[other]]
    return out


def _iron_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    return [Human(i + j, float(v) / g, "1") for (i, j), v in zip(_PAIRS, p, strict=True)]


SOFT_IRON = Effect(
    name="soft_iron",
    summary="field of magnetised iron nearby, symmetric in the axes",
    kind="add",
    stages=("environment",),
    parts=_iron_parts,
    equation=r"B' = (I + S)\,B, \quad S = S^T",
    source="M. J. Caruso, Applications of Magnetic Sensors for Low Cost Compass Systems, IEEE PLANS 2000;"
    " V. Renaudin et al., J. Sensors 2010, eq. 6; symmetric as the polarizability is (L. D. Landau, E. M. Lifshitz,"
    " Electrodynamics of Continuous Media, sec. 2)",
    excitation="the instrument turned through all directions",
    confusable_with=("misalignment",),
    basis=_iron_basis,
    report=_iron_report,
    driven=False,
    sites=("output",),
    shared=True,
    twins=("magnetometer",),
    available=_available,
    vanishes_with=(("x?", "y?"),),
)

# -- bias by powers of another axis -----------------------------------------------------------------


def _cross_terms(settings: Settings) -> list[str]:
    """Return the terms by the axes that they multiply: ``yy``, ``zz``, ``yz``, and powers of one, ``yyy``."""
    axes = _axes(settings)[:2]
    terms = [a + a for a in axes] + (["".join(axes)] if len(axes) == 2 else [])
    return terms + [a * d for d in range(3, int(settings.get("degree", (2.0,))[0]) + 1) for a in axes]


def _quad_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    """Choose the degree, 2 as in IEEE 1293 or 4, by Schwarz's criterion (Ann. Stat. 6, 1978)."""
    k = thin(ctx.keep, 8000)
    n = max(k.size / 10.0, 20.0)  # effective samples: what is left is coloured, so one in ten counts
    best: tuple[float, Settings] | None = None
    for degree in (2.0, 4.0):
        settings = {**_axis_settings(x, residual, ctx), "degree": (degree,)}
        cols = _quad_basis(x, ctx, np.empty(0), settings)
        rss = least_squares(np.column_stack([ctx.line(x, k), cols[k]]), residual[k])[1]
        score = n * np.log(max(rss, 1e-300)) + cols.shape[1] * np.log(n)
        if best is None or score < best[0]:
            best = score, settings
    assert best is not None
    return best[1]


def _unit(term: str) -> str:
    return f"{{out}}/{{in}}^{len(term)}"


def _quad_parts(settings: Settings) -> Parts:
    terms = _cross_terms(settings)
    return Parts((), tuple(Parameter(f"k_{m}", _unit(m), scale=0.01) for m in terms), 0.02 * np.eye(len(terms)))


def _quad_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    vector = vector_of(ctx.signals)
    terms = _cross_terms(settings)
    if not vector:
        return np.zeros((ctx.t.size, len(terms)))
    return np.stack([np.prod([ctx.signals[vector[a]] for a in m], axis=0) for m in terms], axis=1)


def _quad_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    terms = _cross_terms(settings)
    return [Human(f"k_{m}", float(v), _unit(m)) for m, v in zip(terms, p, strict=True)]


CROSS_AXIS_NONLINEARITY = Effect(
    name="cross_axis_nonlinearity",
    summary="bias that depends on powers of another axis, the square first",
    kind="add",
    stages=("sensor",),
    parts=_quad_parts,
    equation=r"y_i = x_i + \sum_{j, k \ne i} k_{jk} f_j f_k + \sum_{j \ne i} (k_{jjj} f_j^3 + k_{jjjj} f_j^4)",
    source="IEEE Std 1293-2018, model equation, terms K_pp, K_oo, K_po; higher powers where the data ask for them",
    excitation="large values of the other axes while the own axis is small",
    confusable_with=("misalignment", "scale_factor_variation", "centripetal_acceleration"),
    prepare=_quad_settings,
    basis=_quad_basis,
    report=_quad_report,
    driven=False,
    sites=("output",),
    available=_available,
    vanishes_with=(("k_*",),),
)

# -- scale factor that follows another axis ---------------------------------------------------------


def _sfv_parts(settings: Settings) -> Parts:
    names = [f"k_{a}{d}" for a in _axes(settings) for d in (1, 2)]
    return Parts((), tuple(Parameter(m, "{out}/{in}^2", scale=0.01) for m in names), 0.05 * np.eye(len(names)))


def _sfv_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    axes = _axes(settings)
    vector = vector_of(ctx.signals)
    if not vector or own_axis(ctx.output) not in vector:
        return np.zeros((ctx.t.size, 2 * len(axes)))
    own = ctx.signals[vector[own_axis(ctx.output)]]
    cols: list[Array] = []
    for f in _columns_of(ctx, axes):
        cols += [own * f, own * f * f]
    return np.stack(cols, axis=1)


def _sfv_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    out: list[Human] = []
    for i, a in enumerate(_axes(settings)):
        out.append(Human(f"scale_change_per_{a}", float(p[2 * i]) / g, "1/{in}"))
        out.append(Human(f"scale_change_per_{a}^2", float(p[2 * i + 1]) / g, "1/{in}^2"))
    return out


SCALE_FACTOR_VARIATION = Effect(
    name="scale_factor_variation",
    summary="an axis' sensitivity depends on another axis",
    kind="add",
    stages=("sensor",),
    parts=_sfv_parts,
    equation=r"y_i = x_i + x_i \sum_{j \ne i} (a_j f_j + b_j f_j^2)",
    source="IEEE Std 1293-2018, model equation, cross-coupling terms K_ip, K_io",
    excitation="own and other axis large at the same time, in several combinations",
    confusable_with=("cross_axis_nonlinearity", "static_nonlinearity"),
    prepare=_axis_settings,
    basis=_sfv_basis,
    report=_sfv_report,
    driven=False,
    sites=("output",),
    available=_available,
    vanishes_with=(("scale_change_per_*",),),
)
