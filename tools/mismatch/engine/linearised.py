"""Fits an effect beside a model of many parameters, which move along their known sensitivities.

A twin of many modes has many base parameters, and a Jacobian of all of them for every candidate is most of the time of
a search. Near the fitted model they act linearly, and the screen has their sensitivities: they are solved together with
the linear parameters (variable projection), and only the effect's own parameters are searched. The result starts a
quasi-Newton search of all parameters, whose first Jacobian consists of the same sensitivities.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from sim_devices.physics.statistics import bounded_solution
from tools.mismatch.engine.fit import Fit, at_bound, moved_a_little, put_away, search
from tools.mismatch.engine.problem import Problem, spread
from tools.mismatch.engine.projected import Projected
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.screen import ROWS, Ground, Regression
from tools.mismatch.engine.trust import belief, stayed, to_search
from tools.mismatch.simulate import Model

COARSE_ROWS = 4000
"""Number of rows of the search of the effect's own parameters."""
TRIES = 3
STARTS = 2
STEPS, MORE_STEPS = 6, 12
"""Number of steps of the search of the effect's own parameters, and of that of all parameters."""
SHARES = (1.0, 0.5, 0.2, 0.0)
"""Shares of the linear move of the base that are tried in the simulation; the best begins the search."""


class Beside(Projected):
    """Computes residuals as a function of an effect's own nonlinear parameters alone.

    The parameters of the model that it stands beside move linearly from ``current``, by ``shift`` (k,) at the last
    evaluation.
    """

    def __init__(self, problem: Problem, model: Model, current: Fit, ground: Ground, most_rows: int) -> None:
        super().__init__(problem, model, problem.twin.outputs, 1)
        own, weights = model.slices(len(model.placed) - 1)
        its_own = {*range(own.start, own.stop), *range(weights.start, weights.stop)}
        self.free = [i for i in model.nonlinear if i in its_own]
        self.linear = np.array([j for j in model.linear if j in its_own], int)
        self.penalty = model.penalty[:, [i for i, j in enumerate(model.linear) if j in its_own]]
        self.lo = np.array([model.parameters[j].lo for j in self.linear])
        self.hi = np.array([model.parameters[j].hi for j in self.linear])
        self.believed = np.zeros(0, int)
        picked = spread(np.arange(ground.rows.size), most_rows, problem.seed)
        self.rows, self.samples = ground.rows[picked], ground.samples[picked]
        self.measured = {o: problem.measured[o][self.rows] for o in self.outputs}
        self.usual = {o: 1.0 - model.excused(self.view, o)[self.rows] for o in self.outputs}
        self.weight = {o: self.usual[o] / problem.sigma(o) for o in self.outputs}
        # indices in the current model of the parameters that move linearly
        self.moved = (*current.model.nonlinear, *current.model.linear)
        self.carried = _indices(current.model, model)[list(self.moved)]
        self.seen, self.bends = [], []
        for o in self.outputs:
            at, columns = ground.of(o)
            self.seen.append(at)
            self.bends.append(columns[picked] * self.weight[o][:, None])
        width = belief(problem, current.model).width[list(self.moved)]
        slope = [_slope(current.model, i, current.theta) for i in self.moved]
        self.prior = (np.array(slope) / width) ** 2
        gram = np.diag(self.prior)
        for at, b in zip(self.seen, self.bends, strict=True):
            gram[np.ix_(at, at)] += b.T @ b
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram / np.outer(size, size))
        keep = values > 1e-9 * values[-1]
        root = vectors[:, keep] / np.sqrt(values[keep]) / size[:, None]
        self.inverse = root @ root.T
        self.shift = np.zeros(len(self.moved))

    def _less(self, parts: Sequence[Array]) -> tuple[Array, Array]:
        """Return (rest, shift): rows (rows of all outputs[, m]) less what the moved parameters explain of them."""
        seen = np.zeros((len(self.moved), *parts[0].shape[1:]))
        for at, b, x in zip(self.seen, self.bends, parts, strict=True):
            seen[at] += b.T @ x
        shift = self.inverse @ seen
        rest = [x - b @ shift[at] for at, b, x in zip(self.seen, self.bends, parts, strict=True)]
        return np.concatenate(rest), shift

    def evaluate(self, theta: Array) -> tuple[Array, Array]:
        """Return weighted residuals on the rows, followed by those of the prior, and theta with its own linear part."""
        self.evaluations += 1
        theta = theta.copy()
        theta[self.linear] = 0.0
        own = set(self.linear.tolist())
        error: list[Array] = []
        columns: list[Array] = []
        if own:
            design = self.model.design(self.view, theta, self.outputs, self.samples)
            for o in self.outputs:
                js = design.linear[o]
                w = self.weight[o]
                y = design.constant[o] + design.columns[o] @ theta[list(js)]
                error.append((self.measured[o] - y) * w)
                block = np.zeros((y.size, self.linear.size))
                for c, j in enumerate(self.linear.tolist()):
                    if j in js:
                        block[:, c] = design.columns[o][:, js.index(j)] * w
                columns.append(block)
        else:
            simulated = self.model.simulate(self.view, theta, self.outputs)
            error = [(self.measured[o] - simulated[o][self.rows]) * self.weight[o] for o in self.outputs]
        rest, self.shift = self._less(error)
        runaway = np.full(rest.size + len(self.moved), np.inf), theta
        if not np.all(np.isfinite(rest)):
            return runaway
        if own:
            block, shifts = self._less(columns)
            if not np.all(np.isfinite(block)):
                return runaway
            weights = self._weights(block, rest)
            theta[self.linear] = weights
            rest = rest - block @ weights
            self.shift = self.shift - shifts @ weights
        return np.concatenate([rest, np.sqrt(self.prior) * self.shift]), theta

    def _weights(self, block: Array, rest: Array) -> Array:
        """Return the effect's own weights (k,) that leave least of ``rest``, within their bounds."""
        gram, target = block.T @ block, block.T @ rest
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        if np.any(self.penalty):
            rows = self.penalty * (0.02 * np.median(size[np.any(self.penalty != 0, axis=0)]))
            gram = gram + rows.T @ rows
        gram = gram / np.outer(size, size)
        gram[np.diag_indices(size.size)] += 1e-11
        try:
            return bounded_solution(gram, target / size, self.lo * size, self.hi * size) / size
        except np.linalg.LinAlgError:
            return np.clip(np.linalg.lstsq(gram, target / size, rcond=1e-10)[0] / size, self.lo, self.hi)

    def placed_at(self, theta: Array, share: float) -> Array:
        """Return ``theta`` with a ``share`` of the last shift of the moved parameters, inside their bounds."""
        out = theta.copy()
        for i, d in zip(self.carried.tolist(), self.shift.tolist(), strict=True):
            p = self.model.parameters[i]
            out[i] = min(max(theta[i] + share * d, p.lo), p.hi)
        return out


def _indices(small: Model, large: Model) -> NDArray[np.int64]:
    """Return the index in ``large`` of every parameter of ``small``, which has the same effects but for the last."""
    out = np.zeros(len(small.parameters), np.int64)
    out[: small.n_base] = np.arange(small.n_base)
    for k in range(len(small.placed)):
        for a, b in zip(small.slices(k), large.slices(k), strict=True):
            out[a] = np.arange(b.start, b.stop)
    return out


def _slope(model: Model, i: int, theta: Array) -> float:
    """Return the derivative of a parameter's search coordinate with respect to the parameter."""
    p = model.parameters[i]
    return 1.0 / max(float(theta[i]), 1e-300) if p.log and p.lo > 0 else 1.0


def fit_beside(
    problem: Problem, model: Model, current: Fit, ground: Ground, starts: Sequence[Array], *, hopeless: float
) -> Fit:
    """Return the fit of ``model``, which is that of ``current`` with one more effect, from the best of ``starts``.

    If the search of the effect's own parameters ends above ``hopeless`` (weighted mean square), it is not refined.
    """
    beside = Beside(problem, model, current, ground, COARSE_ROWS)
    begin = model.carry(current.model, current.theta, problem.recording)
    own, weights = model.slices(len(model.placed) - 1)
    ranked: dict[bytes, tuple[float, int, Array]] = {}
    for i, start in enumerate(starts[: 3 * TRIES]):
        theta = begin.copy()
        theta[own], theta[weights] = start[own], start[weights]
        if theta.tobytes() not in ranked:
            residual, _ = beside.evaluate(theta)
            cost = float(residual @ residual)
            ranked[theta.tobytes()] = (cost if np.isfinite(cost) else np.inf, i, theta)
    found: list[tuple[float, int, Array]] = []
    for _, i, theta in sorted(ranked.values(), key=lambda r: r[:2])[:TRIES]:
        theta, cost = search(beside, theta, STEPS, 1e-3)
        found.append((cost if np.isfinite(cost) else np.inf, i, theta))
    coarse, _, theta = min(found, key=lambda r: r[:2])
    _, theta = beside.evaluate(theta)
    projected = Projected(problem, model, problem.twin.outputs, ROWS)
    theta, cost = _carried_over(beside, projected, theta, starts[:STARTS])
    give_up = not coarse / max(1.0, beside.usual_count) <= hopeless
    if not give_up and np.isfinite(cost):
        theta, cost = search(projected, theta, MORE_STEPS, 1e-3, _first_jacobian(projected, current, ground, theta))
        theta, cost = put_away(projected, theta, cost)
    left = residuals(problem, model, theta)
    ok = (give_up or bool(np.isfinite(cost))) and bool(np.all(np.isfinite(theta))) and stayed(problem, left)
    evaluations = beside.evaluations + projected.evaluations
    return Fit(model, theta, left, cost, at_bound(model, theta), evaluations, ok)


def _carried_over(beside: Beside, projected: Projected, theta: Array, starts: Sequence[Array]) -> tuple[Array, float]:
    """Return theta with the share of the linear move that serves best in the simulation, and the cost there.

    One of ``starts``, whose effect is weak and whose base may be another one, is returned if it is better.
    """
    best = np.inf, theta
    for share in SHARES:
        residual, solved = projected.evaluate(beside.placed_at(theta, share))
        cost = float(residual @ residual)
        if best[0] < np.inf and not cost < best[0]:
            break
        if cost < best[0]:
            best = cost, solved
    for start in starts:
        residual, solved = projected.evaluate(start)
        cost = float(residual @ residual)
        if cost < best[0]:
            best = cost, solved
    return best[1], best[0]


def _first_jacobian(projected: Projected, current: Fit, ground: Ground, theta: Array) -> Array:
    """Return the sensitivity (rows, free) of the projected residual, those of the moved parameters as in ``current``.

    Their part that the solved parameters explain is taken off (Kaufman, BIT 15, 1975).
    """
    model, small = projected.model, current.model
    residual, theta = projected.evaluate(theta)
    out = np.zeros((residual.size, len(projected.free)))
    moved = (*small.nonlinear, *small.linear)
    place = {int(j): (c, i) for c, (i, j) in enumerate(zip(moved, _indices(small, model)[list(moved)], strict=True))}
    blocks: list[Array] = []
    known: list[Array] = []
    design = model.design(projected.view, theta, projected.outputs, projected.samples)
    for o in projected.outputs:
        at, columns = ground.of(o)
        where = {int(c): k for k, c in enumerate(at)}
        block = np.zeros((projected.rows.size, len(projected.free)))
        for c, i in enumerate(projected.free):
            if i in place and place[i][0] in where:
                slope = _slope(model, i, theta)
                block[:, c] = -columns[:, where[place[i][0]]] * projected.weight[o] / slope
        blocks.append(block)
        solved = np.zeros((projected.rows.size, projected.linear.size))
        solved[:, [projected.position[j] for j in design.linear[o]]] = design.columns[o] * projected.weight[o][:, None]
        known.append(solved)
    rows = np.concatenate(blocks)
    out[: rows.shape[0]] = Regression(known).less(rows) if projected.linear.size else rows
    prior = {int(i): rows.shape[0] + k for k, i in enumerate(projected.believed)}
    for c, i in enumerate(projected.free):
        if i in place and i in prior:
            out[prior[i], c] = 1.0 / projected.width[i]
        elif i not in place:
            shifted = moved_a_little(model, theta, i)
            p = model.parameters[i]
            step = to_search(p, shifted[i]) - to_search(p, theta[i])
            if step != 0.0:
                out[:, c] = (projected.evaluate(shifted)[0] - residual) / step
    return out
