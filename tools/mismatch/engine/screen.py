"""Which effects may matter: every candidate place tried with one step inside the simulator."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.simulate import Model, Placed, prepare, probe_signals
from tools.mismatch.simulate_sites import sites

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """An effect at a place, its settings read off the fit part, with the outcome of one step.

    ``share``: part of the residual's weighted mean square that one step takes on fit samples; ``p_value`` of the
    score test; ``tested``: by the effect's own test instead (lines, bursts, steps, grids).
    """

    placed: Placed
    share: float
    p_value: float
    tested: bool
    starts: tuple[Array, ...]


def places(problem: Problem, effects: Iterable[Effect], present: tuple[Placed, ...]) -> list[Placed]:
    """Every place that a candidate effect may take beside those present."""
    out: list[Placed] = []
    for effect in effects:
        for place in sites(problem.twin, problem.recording, effect, present):
            taken = any(p.effect.name == effect.name and set(p.outputs) & set(place.outputs) for p in present)
            if not taken:
                out.append(place)
    return out


def one_step(problem: Problem, current: Fit, place: Placed) -> Candidate:
    """Score test of one candidate: the simulator's output moved by the effect at each of its starting points,
    regressed on the residual together with the base parameters.
    """
    placed = prepare(current.model, problem.fit_view, current.theta, place)
    model = Model(problem.twin, (*current.model.placed, placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    k = len(model.placed) - 1
    starts = model.starts(k, problem.fit_view, theta)
    share, p_value, tested = 0.0, 1.0, False
    if placed.effect.test is not None:
        o = placed.outputs[0]
        x, ctx = probe_signals(current.model, problem.fit_view, current.theta, placed, o)
        full = np.zeros(problem.recording.n)
        index = problem.fit_view.index
        full[index] = current.residual[o][problem.row_of_sample[index]]
        signature = placed.effect.test(x, full, ctx)
        share, p_value, tested = signature.share, signature.p_value, True
    thin = max(1, problem.fit_rows.size // 15000)
    rows = problem.fit_rows[::thin]
    for start in starts[:6]:
        gained, p = _step_gain(problem, current, model, start, rows)
        share = max(share, gained)
        if not tested:
            p_value = min(p_value, min(1.0, p * len(starts)))
    return Candidate(placed, share, p_value, tested, tuple(starts))


def _step_gain(problem: Problem, current: Fit, model: Model, theta: Array, rows: Array) -> tuple[float, float]:
    design = model.design(problem.view, theta)
    target: list[Array] = []
    columns: list[Array] = []
    linear = {j: i for i, j in enumerate(model.linear)}
    n_old = {p.name for p in current.model.parameters}
    moved_theta = theta.copy()
    moved = None
    if model.nonlinear:
        moved = model.simulate(problem.view, moved_theta)
    for o in problem.twin.outputs:
        s = problem.sigma(o)
        r = current.residual[o][rows] / s
        block = np.zeros((rows.size, len(linear) + 1))
        for i, j in enumerate(design.linear[o]):
            block[:, linear[j]] = design.columns[o][rows, i] / s
        if moved is not None:
            before = problem.measured[o][rows] - current.residual[o][rows]
            block[:, -1] = (moved[o][rows] - before) / s
        target.append(r)
        columns.append(block)
    e = np.concatenate(target)
    x = np.concatenate(columns)
    if not np.all(np.isfinite(x)):
        return 0.0, 1.0
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    old = np.array([model.parameters[j].name in n_old for j in model.linear] + [False])[size > 0]
    gram = x.T @ x
    gram[np.diag_indices_from(gram)] += 1e-9
    weight = np.linalg.solve(gram, x.T @ e)
    left = float(np.sum((e - x @ weight) ** 2))
    base = x[:, old]
    if base.shape[1]:
        g = base.T @ base
        g[np.diag_indices_from(g)] += 1e-9
        e0 = e - base @ np.linalg.solve(g, base.T @ e)
    else:
        e0 = e
    before_ = float(np.sum(e0**2))
    extra = int((~old).sum())
    if before_ <= 0 or extra == 0:
        return 0.0, 1.0
    share = max(0.0, 1 - left / before_)
    dof = max(e.size - x.shape[1], 1)
    f = (before_ - left) / extra / max(left / dof, 1e-300)
    return share, float(f_distribution.sf(max(f, 0.0), extra, dof))
