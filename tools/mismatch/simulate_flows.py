"""Finds starts for fits of flows between storages: beside the equations as given, or in place of linear terms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array
from sim_devices.physics.forces import FLOW, flow_of
from sim_devices.physics.statistics import least_squares
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.equations import rates_at
from tools.mismatch.twins.ode import OdeTwin, inside_of

FIELD_SAMPLES = 60
"""Number of samples of a run at which two fields of derivatives are compared."""


def flow_starts(model: Model, k: int, view: View, theta: Array, output: str) -> list[Array]:
    """Return the starts of a search for flow ``k`` of ``model``, whose levels ``theta`` holds."""
    inside = inside_of(model.twin)
    assert inside is not None
    _, b = model.slices(k)
    found = tangent(model, k, view, theta, inside)
    weights, base = tried_together(model, k, view, theta, output)
    for shift in (base, np.zeros(model.n_base)):
        other = theta.copy()
        other[b] = weights
        other[: model.n_base] = _bounded(model, theta[: model.n_base] + shift)
        found.append(other)
    return found


def _bounded(model: Model, base: Array) -> Array:
    parameters = model.parameters[: model.n_base]
    return np.array([min(max(v, p.lo), p.hi) for v, p in zip(base, parameters, strict=True)])


def tangent(model: Model, k: int, view: View, theta: Array, inside: OdeTwin) -> list[Array]:
    """Return the start at which flow ``k`` replaces the linear terms that are tangent to it; at most one.

    A linear model of a storage is the tangent of its law at the mean level (Schoukens and Noel 2017, section 2): the
    flow gets the slope of the linear term there, and the base parameters move so that the derivatives along the run
    stay what they are. A search from beside the linear terms passes through models that are worse than either.
    """
    placed = model.placed[k]
    a, b = model.slices(k)
    if placed.effect.fill is None:
        return []
    rows = placed.effect.fill(theta[a], np.ones(b.stop - b.start), placed.settings).get("flows")
    if rows is None:
        return []
    base = theta[: model.n_base]
    run = view_run(model.twin, view)
    others = [model.chain.force(j, theta) for j, p in enumerate(model.placed) if p.site == "feedback" and j != k]
    states, signals = inside.states(run, {}, base, others)
    at = np.linspace(0, states.shape[0] - 1, FIELD_SAMPLES).astype(np.int64)
    x, u = np.ascontiguousarray(states[at]), np.ascontiguousarray(signals[at])
    mean, size = x.mean(axis=0), np.maximum(np.std(x, axis=0), 1e-300)
    slopes = inside.linearised(inside.values(base)).a
    strength = np.zeros(b.stop - b.start)
    field = np.zeros(x.shape)
    for i, (law, source, target, sign, level) in enumerate(rows.reshape(-1, FLOW)):
        s, d = int(source), int(target)
        step = 1e-3 * size[s]
        slope = (flow_of(mean[s] + step, law, sign, level) - flow_of(mean[s] - step, law, sign, level)) / (2 * step)
        if slope == 0.0:
            return []
        strength[i] = max(slopes[d, s] / slope, 0.0)
        field[:, d] += strength[i] * np.array([flow_of(v, law, sign, level) for v in x[:, s]])
    if not np.any(strength):
        return []
    now = rates_at(inside.equations, x, u, inside.values(base))
    scale = np.maximum(np.std(now, axis=0), 1e-300)
    columns: list[Array] = []
    steps = np.array([1e-3 * (abs(v) or abs(p.scale)) for v, p in zip(base, model.parameters, strict=False)])
    for j, step in enumerate(steps):
        moved = base.copy()
        moved[j] += step
        columns.append(((rates_at(inside.equations, x, u, inside.values(moved)) - now) / scale).ravel())
    shift, _ = least_squares(np.column_stack(columns), -(field / scale).ravel(), 1e-9)
    start = theta.copy()
    start[b] = strength
    start[: model.n_base] = _bounded(model, base + shift * steps)
    return [start] if np.all(np.isfinite(start)) else []


def tried_together(model: Model, k: int, view: View, theta: Array, output: str) -> tuple[Array, Array]:
    """Return the weights of flow ``k``, fitted to the residual to first order, and the shift of the base parameters.

    Each is simulated with a small change, because the columns act on several states and no single path to the output
    carries them.
    """
    _, b = model.slices(k)
    at = theta.copy()
    at[b] = 0.0
    # without weights it is the model without the flow, whose start states all candidates share
    rest = Model(model.twin, [p for j, p in enumerate(model.placed) if j != k])
    view = view.near(rest.started(view, rest.carry(model, theta, view.recording)))
    now = model.residual(view, at, (output,))[output]
    moved: Sequence[int] = [*range(b.start, b.stop), *range(model.n_base)]
    steps = [1e-2 * (model.parameters[j].scale or 1.0) for j in moved]
    columns: list[Array] = []
    for j, step in zip(moved, steps, strict=True):
        other = at.copy()
        other[j] += step
        columns.append(now - model.residual(view, other, (output,))[output])
    design = np.column_stack([*columns, np.ones(now.size)])
    own, still = model.parameters[b], np.zeros(model.n_base)
    if not np.all(np.isfinite(design)) or not np.all(np.isfinite(now)):
        return np.array([0.1 * p.scale for p in own]), still
    found = least_squares(design, now, 1e-5)[0][: len(steps)] * np.array(steps)
    weights = [
        min(max(float(w), p.lo, 0.05 * p.scale if p.lo == 0.0 else p.lo), p.hi)
        for w, p in zip(found, own, strict=False)
    ]
    return np.array(weights), found[len(own) :]
