"""Computes the response of an input to each effect, with base parameters projected out, and its tangents.

Everything is computed at the twin by simulation: an effect is added at a size, the outputs change, and the part that a
re-fit of the base parameters absorbs is projected out. ``rows`` are samples of all outputs, in noise standard
deviations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import moved_a_little
from tools.mismatch.engine.problem import Problem, spread
from tools.mismatch.placed import Placed, middle
from tools.mismatch.plan.situation import noisy, problem_of, simulated, with_outputs
from tools.mismatch.recording import Array, Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare, starts

ROWS = 3000
"""Number of rows of an output that are compared."""
GRID = (0.02, 0.1, 0.25, 0.45, 0.65, 0.85)
"""Points between the bounds of a searched parameter at which an effect is tried."""
MOST_STARTS = 4
SIGNS_OF_LIFE = 1e-9
"""Share of an output's movement below which an effect does not move it."""
OWN_EVENTS = frozenset(("spikes", "dropped_samples", "quantization", "step_shift"))
"""Effects that are recognised by samples of their own and not by their response to an input."""


@dataclass(frozen=True)
class Response:
    """Holds the response of an effect at a place.

    ``move`` (rows,) is its typical response of unit norm, base parameters projected out; ``norm_per_rms`` is the norm
    of that response for an effect whose rms on its output is one noise rms; ``tangents`` are orthonormal bases (rows,
    k) of its possible responses around several of its parameters.
    """

    effect: Effect
    placed: Placed
    move: Array
    norm_per_rms: float
    tangents: tuple[Array, ...]


@dataclass(frozen=True)
class Ground:
    """Holds a twin on an input: the problem, its outputs, the compared rows and a basis (rows, k) of the responses to
    base parameters.
    """

    problem: Problem
    model: Model
    theta: Array
    here: Mapping[str, Array]
    rows: NDArray[np.int64]
    base: Array
    sigma: Mapping[str, float]

    def stack(self, moves: Mapping[str, Array]) -> Array:
        """Stack movements of the outputs (n,) to a column of rows."""
        zero = np.zeros(self.rows.size)
        return np.concatenate(
            [moves[o][self.rows] / self.sigma[o] if o in moves else zero for o in self.problem.twin.outputs]
        )

    def less_base(self, columns: Array) -> Array:
        """Return ``columns`` less the part that base parameters can imitate."""
        return columns - self.base @ (self.base.T @ columns)


def ground(course: Recording, sigma: Mapping[str, float], seed: int = 0) -> Ground:
    """Return the twin on the inputs of ``course``, with its noisy outputs as the recording."""
    problem = problem_of(course, sigma, seed)
    model = Model(problem.twin)
    theta = problem.twin.start(course) if problem.twin.parameters else np.zeros(0)
    if not np.all(np.isfinite(theta)):
        theta = model.start(course)
    clean = simulated(course, model, theta)
    rng = np.random.default_rng([seed, 5])
    problem = problem_of(with_outputs(course, noisy(clean, sigma, rng)), sigma, seed)
    rows = spread(np.arange(course.n), ROWS, seed)
    found = Ground(problem, model, theta, clean, rows, np.zeros((0, 0)), sigma)
    columns = _columns(found, model, theta, range(model.n_base), clean)
    size = len(problem.twin.outputs) * rows.size
    return replace(found, base=orthonormal(np.column_stack(columns) if columns else np.zeros((size, 0))))


def _columns(on: Ground, model: Model, theta: Array, which: Iterable[int], now: Mapping[str, Array]) -> list[Array]:
    """Return the derivatives of the outputs with respect to parameters ``which`` of a model, a column of rows each."""
    wanted = list(which)
    design = model.design(on.problem.view, theta)
    out: list[Array] = []
    for i in wanted:
        if i in model.linear:
            out.append(on.stack({o: design.columns[o][:, js.index(i)] for o, js in design.linear.items() if i in js}))
            continue
        shifted = moved_a_little(model, theta, i)
        after = simulated(on.problem.recording, model, shifted)
        step = shifted[i] - theta[i]
        if step != 0.0:
            out.append(on.stack({o: (after[o] - now[o]) / step for o in now}))
    return [c for c in out if np.all(np.isfinite(c))]


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis (rows, k) of the span of the columns."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 1e-12 * max(float(size.max(initial=0.0)), 1e-300)]
    if kept.shape[1] == 0:
        return np.zeros((columns.shape[0], 0))
    u, s, _ = np.linalg.svd(kept / np.linalg.norm(kept, axis=0), full_matrices=False)
    return u[:, s > 1e-7 * s[0]]


def responses(on: Ground, effects: Iterable[Effect], size: float) -> list[Response]:
    """Return the response of every effect at its most likely place, at an rms of ``size`` noise rms on the output.

    Effects that this input does not excite are left out.
    """
    out: list[Response] = []
    for effect in effects:
        if effect.name in OWN_EVENTS:
            continue
        for place in sites(on.problem.twin, on.problem.recording, effect):
            with np.errstate(all="ignore"):
                found = _response(on, place, size)
            if found is not None:
                out.append(found)
    return out


def _response(on: Ground, place: Placed, size: float) -> Response | None:
    problem = on.problem
    placed = prepare(on.model, problem.fit_view, on.theta, place)
    model = Model(problem.twin, (placed,))
    begin = model.carry(on.model, on.theta, problem.recording)
    a, b = model.slices(0)
    best: tuple[float, Array, float] | None = None
    spaces: list[Array] = []
    for theta in _points(on, model, begin):
        weighted = b.stop > b.start
        now = simulated(problem.recording, model, theta)
        if not all(np.all(np.isfinite(y)) for y in now.values()):
            continue
        columns = _columns(on, model, theta, range(a.start, b.stop), now)
        moved = on.stack({o: now[o] - on.here[o] for o in now})
        whole = [*columns, moved] if not weighted or not columns else columns
        if not whole:
            continue
        raw = np.column_stack(whole)
        left = on.less_base(raw)
        spaces.append(orthonormal(left))
        mix = _last(left.shape[1])
        if weighted and columns:
            mix = _typical(left, [model.parameters[i].scale for i in range(b.start, b.stop)], a.stop - a.start)
        v, full = left @ mix, raw @ mix
        rms = float(np.sqrt(np.mean(full**2) * len(problem.twin.outputs) / max(len(placed.outputs), 1)))
        norm = float(np.linalg.norm(v))
        if rms <= 0.0 or norm <= SIGNS_OF_LIFE * float(np.linalg.norm(full)):
            continue
        # an effect that is not linear in its size is evaluated at the requested size
        miss = 0.0 if weighted and columns else abs(float(np.log(max(rms, 1e-300) / size)))
        if best is None or miss < best[0]:
            best = (miss, v / norm, norm / rms)
    if best is None or not spaces:
        return None
    thinned = np.sqrt(problem.recording.n / on.rows.size)
    return Response(place.effect, placed, best[1], best[2] * thinned, tuple(spaces))


def _points(on: Ground, model: Model, begin: Array) -> list[Array]:
    """Return the parameters of the placed effect at which it is evaluated."""
    a, b = model.slices(0)
    out = list(starts(model, 0, on.problem.fit_view, begin))[:MOST_STARTS]
    middles = begin.copy()
    for i in range(a.start, a.stop):
        middles[i] = middle(model.parameters[i])
    for i in range(b.start, b.stop):
        middles[i] = model.parameters[i].scale if np.isfinite(model.parameters[i].scale) else 1.0
    for i in range(a.start, min(a.stop, a.start + 2)):
        p = model.parameters[i]
        if not np.isfinite(p.hi - p.lo):
            continue
        for share in GRID:
            theta = middles.copy()
            low, high = p.lo, p.hi
            theta[i] = low * (high / low) ** share if p.log and low > 0 else low + share * (high - low)
            out.append(theta)
    return out or [middles]


def _last(count: int) -> Array:
    """Return weights that select the last of so many columns."""
    out = np.zeros(count)
    out[-1] = 1.0
    return out


def _typical(left: Array, scales: list[float], searched: int) -> Array:
    """Return weights of the columns with the most visible joint response; ``searched`` first columns count nothing."""
    weights = np.zeros(left.shape[1])
    finite = [s if np.isfinite(s) and s > 0 else 1.0 for s in scales]
    weights[searched : searched + len(finite)] = finite[: max(0, left.shape[1] - searched)]
    if np.count_nonzero(weights) <= 1:
        return weights
    _, _, v = np.linalg.svd(left * weights, full_matrices=False)
    return weights * v[0]
