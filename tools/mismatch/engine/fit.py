"""Fits output errors inside the simulator: linear parameters are solved exactly, others are searched within bounds.

A damped Gauss-Newton search over the nonlinear parameters of projected, noise-weighted residuals. Base parameters are
always free. On a long recording the search begins on its first part, when that shows all that the inputs do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.optimize import lsq_linear

from hal.arrays import Array
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import Projected, Shrunk
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.trust import belief, fit_loss, stayed, to_search
from tools.mismatch.placed import Free, Placed
from tools.mismatch.simulate import Model
from tools.mismatch.twins.ode import inside_of

LEAST_ROWS = 2000  # number of rows of a coarse search
MOST_ROWS = 300_000  # largest number of rows of any search
SEARCH_ROWS = 12_000
"""Number of rows of the first part of a long search."""
NEAR = 1.05
"""Cost ratio of the second best start of a coarse search to the best, above which the second is not refined."""
NEAR_INSIDE = 2.0
"""Value of ``NEAR`` for forces inside differential equations, where the first steps from a distant start say little. It
was set on a motor with friction, where the start that led to the optimum came second by 1.13."""
COARSE_STEPS_INSIDE = 6
"""Number of steps of a coarse search of forces inside differential equations, of other searches 4."""
LAST_ITERATIONS = 4
"""Number of steps on all rows at the end of a long search."""


@dataclass(frozen=True)
class Fit:
    """Holds a fitted model.

    ``theta`` has all parameters; ``residual[output]`` (m,) on the problem's view is measured minus simulated; ``cost``
    is the weighted sum of squares on fit rows; ``at_bound`` names the parameters that ended at a bound. ``shrunk`` has
    the priors of the weights of effects, per label.
    """

    model: Model
    theta: Array
    residual: dict[str, Array] = field(repr=False)
    cost: float
    at_bound: tuple[str, ...]
    evaluations: int
    ok: bool = True
    shrunk: Mapping[str, Shrunk] = field(default_factory=dict[str, Shrunk], repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.effect.name for p in self.model.placed)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(p.label for p in self.model.placed)


def _inside(p: Free, v: float) -> float:
    return float(min(max(v, p.lo), p.hi))


def _backward(p: Free, v: float) -> float:
    return _inside(p, float(np.exp(min(v, 700.0))) if p.log and p.lo > 0 else v)


STEP, STEP_STICKING = 1e-3, 0.03
"""Step of a sensitivity, relative to the parameter, and the one tried first where friction acts inside differential
equations. Bodies stick and slip at samples that jump from step to step, and the difference must span many of them. The
other is short: of a mode that hardly decays, the phase at the end of a stretch moves with every per cent."""


def _step_size(p: Free, v: float, step: float) -> float:
    if p.log and p.lo > 0:
        return step
    wide = p.hi - p.lo
    typical = max(abs(v), abs(p.scale)) * step
    return min(typical, 0.01 * wide) if np.isfinite(wide) else typical


def forces_inside(model: Model) -> bool:
    """Return True if forces or flows act inside differential equations."""
    return inside_of(model.twin) is not None and any(p.site == "feedback" for p in model.placed)


def sticks(model: Model) -> bool:
    """Return True if friction acts inside differential equations."""
    return forces_inside(model) and any("friction" in rows_of(p) for p in model.placed if p.site == "feedback")


def rows_of(placed: Placed) -> Mapping[str, Array]:
    """Return the packed rows of a force or flow whose parameters are one."""
    parts, fill = placed.parts, placed.effect.fill
    return fill(np.ones(len(parts.nonlinear)), np.ones(len(parts.weights)), placed.settings) if fill else {}


def steps_of(model: Model) -> tuple[float, ...]:
    """Return the steps of sensitivities, relative to the parameter, in the order in which they are tried."""
    return (STEP_STICKING, STEP) if sticks(model) else (STEP,)


def moved_a_little(model: Model, theta: Array, i: int, step: float | None = None) -> Array:
    """Return ``theta`` with parameter ``i`` moved by a small step, by default the first of ``steps_of``, inside its
    bounds."""
    p = model.parameters[i]
    z, h = to_search(p, theta[i]), _step_size(p, theta[i], steps_of(model)[0] if step is None else step)
    shifted = theta.copy()
    shifted[i] = _backward(p, z + h)
    if shifted[i] == theta[i]:
        shifted[i] = _backward(p, z - h)
    return shifted


def slopes(projected: Projected, theta: Array, residual: Array, step: float | None = None) -> Array:
    """Return the sensitivity (rows, free) of the projected residual to the searched parameters, by forward differences
    over ``step`` of each, by default the first of ``steps_of``.

    A parameter that moves only some outputs is simulated on these.
    """
    model = projected.model
    out = np.zeros((residual.size, len(projected.free)))
    parts = {projected.outputs: (projected, np.arange(residual.size), residual)}
    for c, i in enumerate(projected.free):
        p = model.parameters[i]
        shifted = moved_a_little(model, theta, i, step)
        moved = to_search(p, shifted[i]) - to_search(p, theta[i])
        if moved == 0.0:
            continue
        outputs = tuple(o for o in model.moved_by(i) if o in projected.outputs)
        if outputs not in parts:
            part, at = projected.only(outputs)
            parts[outputs] = (part, at, part.evaluate(theta)[0])
        part, at, here = parts[outputs]
        out[at, c] = (part.evaluate(shifted)[0] - here) / moved
    return out


UNSEEN = 1e-9
"""Relative change of a residual by a parameter of its full size below which the parameter is not moved."""


def without_unseen(gradient: Array, hessian: Array, typical: Array, cost: float) -> tuple[Array, Array]:
    """Return (gradient, hessian) with zeros for parameters that move no output, whose slopes are only rounding.

    ``typical`` (k,): sizes of the parameters; ``cost``: square of the residual.
    """
    moves = np.sqrt(np.maximum(np.diag(hessian), 0.0)) * np.where(np.isfinite(typical), typical, 1.0)
    seen = moves > UNSEEN * np.sqrt(cost)
    return np.where(seen, gradient, 0.0), np.where(np.outer(seen, seen), hessian, 0.0)


def bounded_step(hessian: Array, gradient: Array, damping: float, least: Array, most: Array) -> Array:
    """Return the damped Gauss-Newton step (k,) with the lowest quadratic cost within ``least`` and ``most`` (k,).

    A step that is solved for all parameters and clipped afterwards may increase the cost, and a search then ends in a
    corner that is no minimum. The active set solves it within bounds (P. B. Stark, R. L. Parker, Comput. Stat. 10,
    1995).
    """
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    system = hessian / np.outer(scale, scale) + damping * np.eye(scale.size)
    step = -np.linalg.lstsq(system, gradient / scale, rcond=1e-12)[0] / scale
    if np.all((least <= step) & (step <= most)):
        return step
    values, vectors = np.linalg.eigh(system)
    root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    wanted = -(vectors.T @ (gradient / scale)) / root
    found = lsq_linear(root[:, None] * vectors.T, wanted, (least * scale, most * scale), method="bvls")
    return np.clip(found.x / scale, least, most)


ROUGH = 1e-3
"""Tolerance of searches that only rank candidates."""


def search(
    projected: Projected, theta: Array, iterations: int, tolerance: float, jacobian: Array | None = None
) -> tuple[Array, float]:
    """Search by damped Gauss-Newton steps with bounds; return theta and the cost.

    Between steps the sensitivities are updated by the result of the step (Broyden, Mathematics of Computation 19, 1965)
    and computed again only when that no longer decreases the cost, at last over a shorter step (``steps_of``) unless
    the search is a ``ROUGH`` one. Those that are given as ``jacobian`` are only updated.
    """
    given = jacobian is not None
    model = projected.model
    steps = steps_of(model)[: 1 if tolerance >= ROUGH else None]
    free = projected.free
    projected.anew()
    residual, theta = projected.evaluate(theta)
    cost = float(residual @ residual)
    if not free or not np.isfinite(cost):
        return theta, cost
    parameters = [model.parameters[i] for i in free]
    lower = np.array([to_search(p, p.lo) if np.isfinite(p.lo) else -np.inf for p in parameters])
    upper = np.array([to_search(p, p.hi) if np.isfinite(p.hi) else np.inf for p in parameters])
    damping = 1e-2
    jacobian = jacobian.copy() if jacobian is not None else slopes(projected, theta, residual)
    fresh = True
    for _ in range(iterations):
        if not np.all(np.isfinite(jacobian)):
            break
        z = np.array([to_search(p, theta[i]) for p, i in zip(parameters, free, strict=True)])
        gradient = jacobian.T @ residual
        hessian = jacobian.T @ jacobian
        if not np.all(np.isfinite(hessian)):
            break
        typical = [1.0 if p.log and p.lo > 0 else max(abs(v), abs(p.scale)) for p, v in zip(parameters, z, strict=True)]
        gradient, hessian = without_unseen(gradient, hessian, np.array(typical), cost)
        gain = -1.0
        for _try in range(6 if fresh else 2):
            step = bounded_step(hessian, gradient, damping, lower - z, upper - z)
            for c, p in enumerate(parameters):
                reach = 1.6 if p.log and p.lo > 0 else projected.width[free[c]]
                step[c] = float(np.clip(step[c], -reach, reach))
            candidate = theta.copy()
            for c, (p, i) in enumerate(zip(parameters, free, strict=True)):
                candidate[i] = _backward(p, z[c] + step[c])
            if np.array_equal(candidate, theta):
                break
            trial, solved = projected.evaluate(candidate)
            new = float(trial @ trial)
            if np.isfinite(new) and new < cost and projected.is_near:
                trial, solved, new = projected.renewed(trial, solved, below=cost)
            if np.isfinite(new) and new < cost:
                gain = (cost - new) / max(cost, 1e-300)
                moved = np.array([to_search(p, solved[i]) for p, i in zip(parameters, free, strict=True)]) - z
                length = float(moved @ moved)
                if length > 0.0:
                    jacobian += np.outer((trial - residual - jacobian @ moved) / length, moved)
                theta, residual, cost = solved, trial, new
                damping = max(damping / 6, 1e-8)
                break
            damping *= 8
        if gain > tolerance:
            fresh = False
        elif given or (fresh and len(steps) == 1):
            break
        else:
            steps = steps[1:] if fresh else steps
            jacobian = slopes(projected, theta, residual, steps[0])
            fresh = True
            damping = min(damping, 1e-2)
    return theta, cost


def at_bound(model: Model, theta: Array) -> tuple[str, ...]:
    stuck: list[str] = []
    for i, p in enumerate(model.parameters):
        if i < model.n_base or not np.isfinite(p.hi - p.lo):
            continue
        z, lo, hi = to_search(p, theta[i]), to_search(p, p.lo), to_search(p, p.hi)
        if z - lo < 1e-3 * (hi - lo) or hi - z < 1e-3 * (hi - lo):
            stuck.append(p.name)
    return tuple(stuck)


@np.errstate(all="ignore")  # trials may diverge
def fit(
    problem: Problem,
    model: Model,
    starts: Sequence[Array],
    *,
    stride: int = 1,
    iterations: int = 25,
    rounds: int = 2,
    tolerance: float = 1e-5,
    tries: int = 3,
    hopeless: float = np.inf,
    keep: Fit | None = None,
    touched: Sequence[str] = (),
) -> Fit:
    """Return the best fit over ``starts``. Each start is tried coarsely on few rows; the best two are refined.

    ``stride`` thins the fit rows (the simulation itself keeps every sample). If the coarse search ends above
    ``hopeless`` (weighted mean square), it is not refined. ``keep`` is a fit whose residual is used for every output
    that shares no parameter with the outputs ``touched``; then only the latter are fitted.
    """
    outputs = model.together(touched) if keep is not None and touched else problem.twin.outputs
    rows = min(max(1, problem.fit_rows.size // max(1, stride)), MOST_ROWS)
    opening = problem.opening if model.nonlinear and all(p.effect.name in OPENING for p in model.placed) else None
    ground = opening or problem
    evaluations = 0
    give_up = False
    best = list(starts[:1])
    if model.nonlinear and (len(starts) > 1 or np.isfinite(hopeless)):
        few = min(rows, max(LEAST_ROWS, rows // 3), ground.fit_rows.size)
        tried, evaluations = _coarsely(Projected(ground, model, outputs, few), starts, tries)
        best = [t[1] for t in tried[:2]]
        if len(tried) > 1 and tried[1][0] > (NEAR_INSIDE if inside_of(model.twin) else NEAR) * tried[0][0]:
            best = best[:1]
        if opening is not None and np.isfinite(hopeless):
            # the cost on the opening does not predict that on the whole
            projected = Projected(problem, model, outputs, few)
            residual, _ = projected.evaluate(best[0])
            left = float(residual @ residual) / max(1.0, projected.usual_count)
        else:
            left = tried[0][0]
        give_up = left > hopeless
    found: tuple[float, Array] | None = None
    fitted: Projected | None = None
    for theta in best[:1] if give_up else best:
        cost, projected = np.inf, None
        if not give_up:
            limits = Limits(min(rows, ground.fit_rows.size), iterations, rounds, tolerance)
            theta, cost, count, projected = _finely(ground, model, outputs, theta, limits)
            evaluations += count
        if found is None or (np.isfinite(cost) and cost < found[0]):
            found, fitted = (cost, theta), projected
    assert found is not None
    cost, theta = found
    if opening is not None and not give_up and np.isfinite(cost):
        limits = Limits(rows, 10, rounds, tolerance)
        theta, cost, count, fitted = _finely(problem, model, outputs, theta, limits)
        evaluations += count
    elif give_up and opening is not None:
        _, theta = Projected(problem, model, outputs, rows).evaluate(theta)
    residual = residuals(problem, model, theta, outputs)
    if keep is not None:
        residual = {o: residual.get(o, keep.residual[o]) for o in problem.twin.outputs}
    ok = (give_up or bool(np.isfinite(cost))) and bool(np.all(np.isfinite(theta))) and stayed(problem, residual)
    shrunk = {**(keep.shrunk if keep is not None else {}), **(fitted.shrunk() if fitted is not None else {})}
    return Fit(model, theta, residual, cost, at_bound(model, theta), evaluations, ok, shrunk)


OPENING = frozenset(
    (
        "hysteresis", "rate_dependent_hysteresis", "creep", "backlash", "dead_zone", "saturation", "slew_limit",
        "static_nonlinearity", "one_sided_conduction", "first_order_lag", "resonance", "dead_time", "channel_delay",
        "misalignment",
        "soft_iron", "cross_axis_nonlinearity", "scale_factor_variation", "coulomb_friction", "stribeck_friction",
        "cubic_stiffness", "cogging", "gravity_load", "centripetal_acceleration", "sensor_position_error",
    )
)  # fmt: skip
"""Effects that depend on the inputs alone. Others depend on time (drifts, steps, clocks, lines, lost samples) or on a
context and may not occur in the first part of a recording.
"""


def _coarsely(projected: Projected, starts: Sequence[Array], tries: int) -> tuple[list[tuple[float, Array]], int]:
    """Return (cost per usual sample, theta), best first, of the best ``tries`` starts after few steps; evaluations.

    The best on each base comes first: a base that has been re-fitted without the effect may imitate it, and starts
    there with less.
    """
    model = projected.model
    steps = COARSE_STEPS_INSIDE if forces_inside(model) else 4
    within = [np.array([_inside(p, v) for p, v in zip(model.parameters, s, strict=True)]) for s in starts]
    starts = list({s.tobytes(): s for s in within}.values())
    ranked: list[tuple[float, int, Array]] = []
    for i, theta in enumerate(starts[: 3 * tries]):
        projected.anew()
        residual, solved = projected.evaluate(theta)
        cost = float(residual @ residual)
        ranked.append((cost if np.isfinite(cost) else np.inf, i, solved))
    ranked.sort(key=lambda r: (r[0], r[1]))
    of_base = {starts[i][: model.n_base].tobytes(): i for _, i, _ in reversed(ranked)}
    ranked.sort(key=lambda r: r[1] not in of_base.values())
    tried: list[tuple[float, int, Array]] = []
    for _, i, theta in ranked[:tries]:
        theta, cost = search(projected, theta, steps, ROUGH)
        tried.append((cost if np.isfinite(cost) else np.inf, i, theta))
    tried.sort(key=lambda r: (r[0], r[1]))
    size = max(1.0, projected.usual_count)
    return [(cost / size, theta) for cost, _, theta in tried], projected.evaluations


@dataclass(frozen=True)
class Limits:
    """Limits a search: rows of each output, iterations and tolerance of each round, rounds of reduced weights."""

    rows: int
    iterations: int
    rounds: int
    tolerance: float


def _finely(
    problem: Problem,
    model: Model,
    outputs: Sequence[str],
    theta: Array,
    limits: Limits,
) -> tuple[Array, float, int, Projected]:
    """Return (theta, cost, evaluations, residuals) after a search on some rows and another with reduced weights of
    outliers and with the priors of the weights of effects.
    """
    rows, iterations, rounds, tolerance = limits.rows, limits.iterations, limits.rounds, limits.tolerance
    before = 0
    if rows > 2 * SEARCH_ROWS:
        # the search begins on part of the rows and ends on all of them
        part = Projected(problem, model, outputs, SEARCH_ROWS)
        theta, _ = search(part, theta, iterations, tolerance)
        before, iterations = part.evaluations, min(iterations, LAST_ITERATIONS)
    projected = Projected(problem, model, outputs, rows)
    cost = np.inf
    for round_ in range(rounds):
        theta, cost = search(projected, theta, iterations if round_ == 0 else 4, tolerance)
        if not np.isfinite(cost):
            break
        if round_ + 1 < rounds:
            projected.reweight(residuals(problem, model, theta, outputs))
            projected.shrink(theta, partial(slopes, projected))
    theta, cost = put_away(projected, theta, cost)
    return theta, cost, before + projected.evaluations, projected


NOTICED = 3.84
"""Largest change of the cost, in noise variances, that counts as insignificant: the 95 % quantile for a
parameter that is not there."""


def put_away(projected: Projected, theta: Array, cost: float) -> tuple[Array, float]:
    """Return (theta, cost) with every insignificant parameter at its value without influence (``Parameter.away``)."""
    for i in projected.free:
        away = projected.model.parameters[i].away
        if away is not None and theta[i] != away and np.isfinite(cost):
            without = theta.copy()
            without[i] = away
            residual, solved = projected.evaluate(without)
            if float(residual @ residual) < cost + NOTICED:
                theta, cost = solved, float(residual @ residual)
    return theta, cost


def as_given(problem: Problem) -> Fit:
    """Return the twin as given by the engineer, as a fit."""
    model = problem.base()
    theta = model.start(problem.recording)
    return Fit(model, theta, residuals(problem, model, theta), np.nan, (), 1)


POOR = 0.5
"""Residual of a re-fit, as a share of the mean square as given, above which other starts are tried, too."""
ENOUGH = 4.0
"""Residual of a re-fit, in noise variances, below which a single start suffices."""
FACTORS = ((0.8, 1.0), (1.25, 1.0), (1.0, 3.0), (1.0, 0.33))
"""Factors of other starts on parameters that are searched by their logarithm (rates, frequencies) and on other searched
parameters (damping ratios)."""


def around(model: Model, theta: Array) -> list[Array]:
    """Return ``theta`` and a few points around it, as starts of a search of the base parameters."""
    out = [theta]
    for rate, other in FACTORS:
        moved = theta.copy()
        for i in model.nonlinear:
            p = model.parameters[i]
            moved[i] = _inside(p, theta[i] * (rate if p.log and p.lo > 0 else other))
        if not any(np.array_equal(moved, t) for t in out):
            out.append(moved)
    return out


def fit_base(problem: Problem) -> Fit:
    """Fit the base parameters alone from the engineer's values.

    If that improves little, a few points around are tried, too. The result is never worse on the fitted samples than as
    given.
    """
    model, given = problem.base(), as_given(problem)
    found = fit(problem, model, [given.theta])
    believed = fit_loss(problem, given.residual)
    left = fit_loss(problem, found.residual)
    rates = any(model.parameters[i].log for i in model.nonlinear)
    if rates and not (found.ok and (left < POOR * believed or left < ENOUGH)):
        others = fit(problem, model, around(model, given.theta), tries=4)
        if others.ok and fit_loss(problem, others.residual) < 0.98 * left:
            found, left = others, fit_loss(problem, others.residual)
    if not (found.ok and left <= believed):
        # the robust cost may prefer a fit that plain squares do not
        found = fit(problem, model, [given.theta], rounds=1)
        left = fit_loss(problem, found.residual)
    return found if found.ok and left <= believed else given


def ground_of(problem: Problem, base: Fit) -> Fit:
    """Return the fit beside which the first effects are sought: the re-fitted ``base``, or the twin as given.

    Physics that is missing bends the parameters that are there. A re-fit that leaves more than noise and moves a
    parameter by more than the width of its prior says nothing about it, and forces are not found beside it.
    """
    if problem.twin.apart or fit_loss(problem, base.residual) < ENOUGH:
        return base
    prior = belief(problem, base.model)
    at = np.array([to_search(p, v) for p, v in zip(base.model.parameters, base.theta, strict=True)])
    given = as_given(problem)
    bent = bool(np.any(np.abs(at - prior.centre) > prior.width))
    return given if bent and given.ok and stayed(problem, given.residual) else base
