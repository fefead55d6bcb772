"""Computes weighted residuals as a function of the nonlinear parameters alone.

Linear parameters are solved exactly (variable projection: Golub and Pereyra, SIAM J. Numerical Analysis 10, 1973), and
outliers are bounded by Huber's weights.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.statistics import bounded_solution
from tools.mismatch.engine.problem import Problem, spread
from tools.mismatch.engine.trust import belief, to_search
from tools.mismatch.simulate import Model

Array = NDArray[np.float64]

HUBER = 4.0


def huber_weights(z: Array) -> Array:
    """Return Huber's weights of residuals in units of their robust scale."""
    return np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-12))


def robust_scale(r: Array, floor: float) -> float:
    """Return the robust scale of a residual, never below ``floor``."""
    return max(1.4826 * float(np.median(np.abs(r - np.median(r)))), floor, 1e-300)


class Projected:
    """Computes residuals as a function of the nonlinear parameters alone."""

    def __init__(self, problem: Problem, model: Model, outputs: Sequence[str], most_rows: int) -> None:
        self.problem = problem
        self.model = model
        self.view = problem.view
        self.outputs = tuple(outputs)
        rows = spread(problem.fit_rows, most_rows, problem.seed)
        self.rows = rows
        self.samples = problem.index[rows]
        self.measured = {o: problem.measured[o][rows] for o in self.outputs}
        self.usual = {o: 1.0 - model.excused(self.view, o)[rows] for o in self.outputs}
        self.weight = {o: self.usual[o] / problem.sigma(o) for o in self.outputs}
        prior = belief(problem, model)
        self.centre, self.width = prior.centre, prior.width
        self._name_parameters()
        self.evaluations = 0

    def _name_parameters(self) -> None:
        """Sort the parameters that move ``outputs``: those that are searched, solved, and have a prior."""
        model = self.model
        moving = model.parameters_of(self.outputs)
        self.free = [i for i in model.nonlinear if i in moving]
        self.linear = np.array([j for j in model.linear if j in moving], int)
        self.position = {j: i for i, j in enumerate(self.linear.tolist())}
        kept = [i for i, j in enumerate(model.linear) if j in moving]
        self.penalty = model.penalty[:, kept]
        self.lo = np.array([model.parameters[j].lo for j in self.linear])
        self.hi = np.array([model.parameters[j].hi for j in self.linear])
        believed = [i for i in range(model.n_base) if i in moving and np.isfinite(self.width[i])]
        self.believed = np.array(believed, int)

    def only(self, outputs: Sequence[str]) -> tuple[Projected, NDArray[np.int64]]:
        """Return the residuals of ``outputs`` alone and their places; they share no linear parameter with others."""
        part = copy.copy(self)
        part.outputs = tuple(o for o in self.outputs if o in outputs)
        part._name_parameters()
        m, of_all = self.rows.size, len(self.outputs) * self.rows.size
        at = [np.arange(m) + m * i for i, o in enumerate(self.outputs) if o in part.outputs]
        return part, np.concatenate([*at, of_all + np.flatnonzero(np.isin(self.believed, part.believed))])

    @property
    def usual_count(self) -> float:
        """Return the number of squares in the cost."""
        return float(sum(u.sum() for u in self.usual.values()))

    def reweight(self, residual: dict[str, Array]) -> None:
        for o in self.outputs:
            r = residual[o][self.rows]
            s = robust_scale(r, self.problem.sigma(o))
            robust = np.sqrt(huber_weights((r - np.median(r)) / s))
            robust[self.problem.lively[self.rows]] = 1.0
            self.weight[o] = self.usual[o] * robust / self.problem.sigma(o)

    def _from_belief(self, theta: Array) -> Array:
        """Return the residuals of the prior: distances of base parameters from the engineer's own values."""
        at = [to_search(self.model.parameters[i], float(theta[i])) for i in self.believed]
        return (np.array(at) - self.centre[self.believed]) / self.width[self.believed]

    def evaluate(self, theta: Array) -> tuple[Array, Array]:
        """Return weighted residuals on the rows and theta with its linear part solved.

        All outputs are joined, followed by the residuals of the prior.
        """
        self.evaluations += 1
        theta = theta.copy()
        design = self.model.design(self.view, theta, self.outputs, self.samples)
        if self.linear.size == 0:
            parts = [(self.measured[o] - design.constant[o]) * self.weight[o] for o in self.outputs]
            return np.concatenate([*parts, self._from_belief(theta)]), theta
        k = self.linear.size
        gram = np.zeros((k, k))
        cross = np.zeros(k)
        kept: list[tuple[Array, Array, NDArray[np.int64]]] = []
        for o in self.outputs:
            w = self.weight[o]
            at = np.array([self.position[j] for j in design.linear[o]], int)
            a = design.columns[o]
            a *= w[:, None]
            b = (self.measured[o] - design.constant[o]) * w
            gram[np.ix_(at, at)] += a.T @ a
            cross[at] += a.T @ b
            kept.append((a, b, at))
        # a diverged plant has no finite cost, and LAPACK must not receive its values
        runaway = np.full(sum(b.size for _, b, _ in kept) + self.believed.size, np.inf), theta
        if not (np.all(np.isfinite(gram)) and np.all(np.isfinite(cross))):
            return runaway
        # parameters of effects have no prior: their centre is zero and their width infinite
        centre = self.centre[self.linear]
        prior = 1.0 / self.width[self.linear] ** 2
        gram[np.diag_indices(k)] += prior
        cross += prior * centre
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        scaled = gram / np.outer(size, size)
        if np.any(self.penalty):
            # rows are in units of weight and weak compared with the data
            rows = self.penalty * (0.02 * np.median(size[np.any(self.penalty != 0, axis=0)]))
            scaled = scaled + (rows.T @ rows) / np.outer(size, size)
        scaled[np.diag_indices(k)] += 1e-11
        target = cross / size + 1e-11 * size * centre
        if not (np.all(np.isfinite(scaled)) and np.all(np.isfinite(target))):
            return runaway
        try:
            solution = bounded_solution(scaled, target, self.lo * size, self.hi * size) / size
        except np.linalg.LinAlgError:
            solution = np.clip(np.linalg.lstsq(scaled, target, rcond=1e-10)[0] / size, self.lo, self.hi)
        theta[self.linear] = solution
        return np.concatenate([*(b - a @ solution[at] for a, b, at in kept), self._from_belief(theta)]), theta
