"""Rigid-body terms of sensors at several places: centripetal acceleration, and sensors that sit elsewhere."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Parameter, Parts, Settings, reports
from sim_devices.physics.statistics import least_squares, thin


def rates(ctx: Context) -> Array:
    """Angular rate (n, 3), zero where an axis was not recorded."""
    zero = np.zeros(ctx.t.size)
    return np.stack([ctx.signals.get(f"angular_rate_{a}", zero) for a in "xyz"], axis=1)


def centripetal_row(w: Array, axis: int) -> Array:
    """Row i of the matrix [w]x[w]x, (n, 3): axis . (w x (w x r)) = row @ r.

    w x (w x r) = w (w . r) - r (w . w).
    """
    row = w[:, axis : axis + 1] * w
    row[:, axis] -= np.sum(w * w, axis=1)
    return row


def tangential_row(w: Array, axis: int, dt: float) -> Array:
    """Row i of [alpha]x, (n, 3): axis . (alpha x r) = row @ r, alpha by central differences of the rate."""
    alpha = np.gradient(w, dt, axis=0, edge_order=2)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    row = np.zeros_like(w)
    row[:, k] = alpha[:, j]
    row[:, j] = -alpha[:, k]
    return row


def _available(signals: Mapping[str, Array], output: str) -> str:
    found = [s for s in signals if s.startswith("angular_rate_") and float(np.ptp(signals[s])) > 0]
    return "" if found else "no angular rate was recorded, or it never changes"


def _place(ctx: Context) -> tuple[int, Array]:
    return int(ctx.facts.get("axis", (0.0,))[0]), np.array(ctx.facts.get("position_m", (0.0, 0.0, 0.0)))


def _centripetal_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    axis, r = _place(ctx)
    return (centripetal_row(rates(ctx), axis) @ r)[:, None]


CENTRIPETAL_ACCELERATION = Effect(
    name="centripetal_acceleration",
    summary="omega x (omega x r)",
    kind="add",
    stages=("mechanics",),
    parts=lambda settings: Parts((), (Parameter("share", "1", -5.0, 5.0),)),
    equation=r"a = x + c\; e \cdot (\omega \times (\omega \times r))",
    source="H. Goldstein, Classical Mechanics, 3rd ed., eq. 4.91",
    excitation="fast rotation (the term grows with the square of the rate)",
    confusable_with=("sensor_position_error", "cross_axis_nonlinearity"),
    basis=_centripetal_basis,
    report=reports(("share", "1")),
    driven=False,
    sites=("output",),
    shared=True,
    twins=("accelerometer_cluster",),
    available=_available,
    vanishes_with=(("share",),),
)


def _position_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    """Decide if the displacement includes its centripetal part: it does if that explains the residual better."""
    axis, r = _place(ctx)
    w = rates(ctx)
    k = thin(ctx.keep, 20_000)
    tangential = tangential_row(w, axis, ctx.dt)
    both = tangential + centripetal_row(w, axis)
    here = centripetal_row(w, axis) @ r
    one = np.ones(k.size)
    first = least_squares(np.column_stack([one, here[k], tangential[k]]), residual[k])[1]
    second = least_squares(np.column_stack([one, here[k], both[k]]), residual[k])[1]
    return {"centripetal": (1.0 if second < 0.999 * first else 0.0,)}


def _position_parts(settings: Settings) -> Parts:
    return Parts((), tuple(Parameter(f"d{a}", "m", -1.0, 1.0, scale=1e-3) for a in "xyz"), 0.02 * np.eye(3))


def _position_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    axis, _ = _place(ctx)
    w = rates(ctx)
    row = tangential_row(w, axis, ctx.dt)
    if settings.get("centripetal", (0.0,))[0]:
        row = row + centripetal_row(w, axis)
    return row


SENSOR_POSITION_ERROR = Effect(
    name="sensor_position_error",
    summary="a sensor sits elsewhere than believed",
    kind="add",
    stages=("mounting",),
    parts=_position_parts,
    equation=r"a = x + e \cdot \left(\alpha \times \delta r + \omega \times (\omega \times \delta r)\right)",
    source="H. Goldstein, Classical Mechanics, 3rd ed., eq. 4.91",
    excitation="angular accelerations about at least two axes",
    confusable_with=("centripetal_acceleration", "misalignment"),
    prepare=_position_prepare,
    basis=_position_basis,
    report=reports(*((f"displacement_{a}", "m") for a in "xyz")),
    driven=False,
    sites=("output",),
    shared=True,
    twins=("accelerometer_cluster",),
    available=_available,
    vanishes_with=(("displacement_*",),),
)
