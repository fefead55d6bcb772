"""Computes weighted residuals as a function of the nonlinear parameters alone.

Linear parameters are solved exactly (variable projection: Golub and Pereyra, SIAM J. Numerical Analysis 10, 1973), and
outliers are bounded by Huber's weights.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from sim_devices.physics.statistics import bounded_solution
from tools.mismatch.engine.problem import Problem, spread
from tools.mismatch.engine.trust import belief, to_search
from tools.mismatch.simulate import Model

HUBER = 4.0
SHRUNK = 3
"""Least number of weights that have a common prior. From three values on, estimates that are shrunk to a
common centre are nearer to the truth than those of least squares, whatever it is (C. Stein, Proc. Third Berkeley
Symp., 1956)."""
EVIDENCE = 8
"""Number of fixed-point steps to the prior variance of the weights."""

AGAIN = 3
"""Most times that weights whose columns follow the run are solved again at the run that they give."""
ALIKE = 1e-3
"""Change of the residual, as a share of it, below which they are not."""


def huber_weights(z: Array) -> Array:
    """Return Huber's weights of residuals in units of their robust scale."""
    return np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-12))


def robust_scale(r: Array, floor: float) -> float:
    """Return the robust scale of a residual, never below ``floor``."""
    return max(1.4826 * float(np.median(np.abs(r - np.median(r)))), floor, 1e-300)


@dataclass(frozen=True)
class Shrunk:
    """Holds the learned prior of the weights of an effect.

    ``precision`` (k,): reciprocal variances of the weights, the noise being 1; ``freedom``: number of weights that the
    data determine, 0 to k.
    """

    precision: Array
    freedom: float


def _families(model: Model, which: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the places in ``which`` of each family of weights: those whose names differ in their number alone."""
    found: dict[str, list[int]] = {}
    for place, i in enumerate(which.tolist()):
        name = model.parameters[i].name
        if i >= model.n_base and name[-1:].isdigit():
            found.setdefault(name.rstrip("0123456789"), []).append(place)
    return [np.array(at, int) for at in found.values() if len(at) >= SHRUNK]


def evidence(
    gram: Array, cross: Array, squares: tuple[float, int], families: Sequence[NDArray[np.int64]],
    rough: Callable[[Array], Array],
) -> tuple[Array, Array]:  # fmt: skip
    """Return the precisions (k,) of the priors that maximise the evidence, and the share (k,) of each weight that the
    data determine, for ``families`` of weights; of all others 0 and 1.

    ``gram`` (k, k) and ``cross`` (k,) of the columns and values in noise units; ``squares``: sum of the squares of the
    values, and their number; ``rough`` returns a further penalty (k, k) from the norms (k,) of the columns. Weights
    times the norm of their column are alike (D. J. C. MacKay, Neural Computation 4, 1992, eq. 4.8).
    """
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    data, target, penalty = gram / np.outer(size, size), cross / size, rough(size)
    precision, freedom = np.zeros(size.size), np.ones(size.size)
    for _ in range(EVIDENCE):
        covariance = np.linalg.pinv(data + penalty + np.diag(precision + 1e-11), hermitian=True)
        w = covariance @ target
        seen = np.einsum("ij,ji->i", covariance, data)
        noise = max((squares[0] - 2.0 * float(w @ target) + float(w @ data @ w)) / max(squares[1], 1), 1.0)
        for at in families:
            freedom[at] = np.clip(seen[at], 0.0, 1.0)
            precision[at] = noise * float(np.sum(freedom[at])) / max(float(w[at] @ w[at]), 1e-300)
    return precision * size**2, freedom


def _alike(one: Sequence[Array], other: Sequence[Array]) -> bool:
    """Return True if two residuals (rows,) per output differ by less than ``ALIKE`` of their size."""
    apart = sum(float((a - b) @ (a - b)) for a, b in zip(one, other, strict=True))
    return apart <= ALIKE**2 * sum(float(b @ b) for b in other)


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
        self.ridge = np.zeros(len(model.parameters))
        self.freedom = np.ones(len(model.parameters))
        self._name_parameters()
        self.evaluations = 0

    def anew(self) -> None:
        """Forget the start states of the search before."""
        known = self.view.nearby
        self.view = self.problem.view.near(known.elsewhere() if known is not None else None)

    @property
    def is_near(self) -> bool:
        """Return True if start states are moved from those at the begin of the search, to first order."""
        return self.view.nearby is not None and bool(self.view.nearby.of_stretches)

    def renewed(self, trial: Array, theta: Array, *, below: float) -> tuple[Array, Array, float]:
        """Return residual, theta and cost at a step with its own start states, near which the search goes on.

        If the step was better to first order alone, the search stays where it was, and the cost is infinite.
        """
        before = self.view
        self.anew()
        residual, solved = self.evaluate(theta)
        cost = float(residual @ residual)
        if not cost < below:
            self.view = before
            return trial, theta, np.inf
        return residual, solved, cost

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
        self.solved = _families(model, self.linear)
        self.searched = _families(model, np.array(self.free, int))
        places = [self.linear[at] for at in self.solved], [np.array(self.free, int)[at] for at in self.searched]
        self.small = np.sort(np.concatenate([np.zeros(0, int), *places[0], *places[1]]))

    def only(self, outputs: Sequence[str]) -> tuple[Projected, NDArray[np.int64]]:
        """Return the residuals of ``outputs`` alone and their places; they share no linear parameter with others."""
        part = copy.copy(self)
        part.outputs = tuple(o for o in self.outputs if o in outputs)
        part._name_parameters()
        m, of_all = self.rows.size, len(self.outputs) * self.rows.size
        at = [np.arange(m) + m * i for i, o in enumerate(self.outputs) if o in part.outputs]
        priors = np.isin(np.r_[self.believed, self.small], np.r_[part.believed, part.small])
        return part, np.concatenate([*at, of_all + np.flatnonzero(priors)])

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

    def _from_priors(self, theta: Array) -> Array:
        """Return the residuals of the priors: distances of base parameters from the engineer's own values, and of the
        weights of an effect from zero.
        """
        at = [to_search(self.model.parameters[i], float(theta[i])) for i in self.believed]
        own = (np.array(at) - self.centre[self.believed]) / self.width[self.believed]
        return np.r_[own, np.sqrt(self.ridge[self.small]) * theta[self.small]]

    def shrink(self, theta: Array, jacobian: Callable[[Array, Array], Array]) -> None:
        """Learn the priors of the weights of effects at ``theta``.

        The weights of a family, each times the norm of its column, are normal about zero with a common variance. Many
        collinear columns would otherwise follow the noise of a short recording. ``jacobian(theta, residual)``
        returns the sensitivities of weights that are searched, because they are before a simulator.
        """
        if self.solved and (normal := self._normal(theta.copy())) is not None:
            gram, cross, kept = normal
            squares = sum(float(b @ b) for _, b, _ in kept), sum(b.size for _, b, _ in kept)
            found = evidence(gram, cross, squares, self.solved, self._smoothness)
            self.ridge[self.linear], self.freedom[self.linear] = found
        if self.searched:
            residual, theta = self.evaluate(theta)
            data = slice(0, residual.size - self.believed.size - self.small.size)
            j, r = jacobian(theta, residual)[data], residual[data]
            inside = j @ np.array([to_search(self.model.parameters[i], theta[i]) for i in self.free]) - r
            if np.all(np.isfinite(j)) and np.all(np.isfinite(r)):
                squares = float(inside @ inside), r.size
                found = evidence(j.T @ j, j.T @ inside, squares, self.searched, lambda s: np.zeros((s.size, s.size)))
                self.ridge[self.free], self.freedom[self.free] = found

    def shrunk(self) -> dict[str, Shrunk]:
        """Return the learned priors of the effects that have a family of weights."""
        weights = {p.label: self.model.slices(k)[1] for k, p in enumerate(self.model.placed)}
        return {
            label: Shrunk(self.ridge[w], float(np.sum(self.freedom[w])))
            for label, w in weights.items()
            if np.any(self.ridge[w] > 0.0)
        }

    def _smoothness(self, size: Array) -> Array:
        """Return the penalty of rough weights (k, k), each times the norm ``size`` (k,) of its column."""
        if not np.any(self.penalty):
            return np.zeros((size.size, size.size))
        # rows are in units of weight and weak compared with the data
        rows = self.penalty * (0.02 * np.median(size[np.any(self.penalty != 0, axis=0)]))
        return (rows.T @ rows) / np.outer(size, size)

    def _normal(self, theta: Array) -> tuple[Array, Array, list[tuple[Array, Array, NDArray[np.int64]]]] | None:
        """Return (gram, cross, (columns, values, places) per output) of the linear parameters; None if diverged."""
        design = self.model.design(self.view, theta, self.outputs, self.samples)
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
        return (gram, cross, kept) if np.all(np.isfinite(gram)) and np.all(np.isfinite(cross)) else None

    def evaluate(self, theta: Array) -> tuple[Array, Array]:
        """Return weighted residuals on the rows and theta with its linear part solved.

        All outputs are joined, followed by the residuals of the priors.
        """
        self.evaluations += 1
        theta = theta.copy()
        if self.linear.size == 0:
            design = self.model.design(self.view, theta, self.outputs, self.samples)
            parts = [(self.measured[o] - design.constant[o]) * self.weight[o] for o in self.outputs]
            return np.concatenate([*parts, self._from_priors(theta)]), theta
        solved = self._solved(theta)
        for _ in range(AGAIN if self.model.chain.curved else 0):
            if solved is None:
                break
            theta, before = solved
            solved = self._solved(theta)
            if solved is not None and _alike(before, solved[1]):
                break
        if solved is None:
            return np.full(len(self.outputs) * self.rows.size + self.believed.size + self.small.size, np.inf), theta
        theta, left = solved
        return np.concatenate([*left, self._from_priors(theta)]), theta

    def _solved(self, theta: Array) -> tuple[Array, list[Array]] | None:
        """Return theta with its linear part solved, and what is left (rows,) per output; None if it diverges."""
        normal = self._normal(theta)
        if normal is None:
            return None
        gram, cross, kept = normal
        # of effects only the weights of a group have a prior
        centre = self.centre[self.linear]
        prior = 1.0 / self.width[self.linear] ** 2
        gram[np.diag_indices_from(gram)] += prior
        cross += prior * centre
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        scaled = gram / np.outer(size, size) + self._smoothness(size)
        scaled[np.diag_indices_from(gram)] += 1e-11 + self.ridge[self.linear] / size**2
        target = cross / size + 1e-11 * size * centre
        if not (np.all(np.isfinite(scaled)) and np.all(np.isfinite(target))):
            return None
        try:
            solution = bounded_solution(scaled, target, self.lo * size, self.hi * size) / size
        except np.linalg.LinAlgError:
            solution = np.clip(np.linalg.lstsq(scaled, target, rcond=1e-10)[0] / size, self.lo, self.hi)
        theta = theta.copy()
        theta[self.linear] = solution
        return theta, [b - a @ solution[at] for a, b, at in kept]
