"""Screens effects: every candidate place is tried with one step inside the simulator."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from hal.arrays import Array
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Hint, Problem, spread
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare, probe_signals, starts
from tools.mismatch.twins.memo import Nearby

LEAST_P = 1e-3
"""Largest p-value of an effect's own test at which it may be named."""


@dataclass(frozen=True)
class Candidate:
    """Holds an effect at a place, with settings from the fit part, and the outcome of one step.

    ``share``: part of the residual's weighted mean square that one step explains on fit samples; ``p_value`` of the
    score test; ``tested``: the effect's own test is used instead (lines, bursts, steps, grids).
    """

    placed: Placed
    share: float
    p_value: float
    tested: bool
    starts: tuple[Array, ...]

    @property
    def refused(self) -> bool:
        """Return True if the effect's own test is negative: then no fit, alone or with others, makes it a name."""
        return self.tested and self.p_value > LEAST_P


def places(problem: Problem, effects: Iterable[Effect], present: tuple[Placed, ...]) -> list[Placed]:
    """Return every place that a candidate effect may take beside those present."""
    found = (place for effect in effects for place in sites(problem.twin, problem.recording, effect, present))
    free = (place for place in found if place.label not in problem.imitated)
    return [place for place in free if not any(_takes(p, place) for p in present)]


def _takes(present: Placed, place: Placed) -> bool:
    """Return True if ``place`` is taken: the same effect moves its outputs, or one is a case of the other there."""
    if present.effect.name == place.effect.name:
        return _same_place(present, place)
    nested = present.effect.name == place.effect.plain or place.effect.name == present.effect.plain
    return nested and (present.site, present.target) == (place.site, place.target)


def _same_place(present: Placed, place: Placed) -> bool:
    """Return True if two places move the same outputs, except for forces and flows at different states."""
    if present.site == place.site == "feedback":
        return bool(set(present.target.split("+")) & set(place.target.split("+")))
    return bool(set(present.outputs) & set(place.outputs))


@dataclass(frozen=True)
class Ground:
    """Holds the common data of the screen of all candidates.

    It has ``samples`` of the recording and their ``rows`` in the view; derivatives of the outputs with respect to each
    searched parameter of the current model there (``bends[o]`` (rows, k)); and the energy of each output when
    everything free is regressed out. For a model of many parameters (``is_wide``) it also has the derivatives with
    respect to the linear ones that move an output: their places in ``model.linear``, and (rows, places). ``nearby``:
    the start states of the current model, near which candidates start on the same base.
    """

    rows: NDArray[np.int64]
    samples: NDArray[np.int64]
    bends: dict[str, Array]
    energy: dict[str, float]
    columns: dict[str, tuple[NDArray[np.int64], Array]]
    nearby: Nearby | None = None

    def of(self, output: str) -> tuple[NDArray[np.int64], Array]:
        """Return the derivatives (rows, m) of an output, and which of the parameters they belong to.

        The searched parameters come first, then the linear ones.
        """
        at, columns = self.columns[output]
        bends = self.bends[output]
        return np.concatenate([np.arange(bends.shape[1]), bends.shape[1] + at]), np.hstack([bends, columns])


WIDE = 15
"""Number of searched parameters of a fitted model above which they move linearly beside a candidate."""


def is_wide(problem: Problem, model: Model) -> bool:
    """Return True if the parameters of a fitted model are too many to be differentiated for every candidate."""
    return not problem.twin.static and not problem.twin.apart and len(model.nonlinear) > WIDE


ROWS = 12_000  # number of rows of the fit that a screen uses
OWN_SHARE = 0.05  # least share of the residual of the engineer's base that an effect must explain by itself


STEP = 1e-3  # of a parameter, for its sensitivities


def bend(problem: Problem, current: Fit, step: float = STEP) -> Ground:
    """Return the common data of the candidates, with sensitivities by forward differences over ``step`` of each
    parameter."""
    model, theta = current.model, current.theta
    rows = spread(problem.fit_rows, ROWS, problem.seed)
    samples = problem.index[rows]
    outputs = problem.twin.outputs
    bends = {o: np.zeros((rows.size, len(model.nonlinear))) for o in outputs}
    view = problem.view.near()
    base = model.simulate(view, theta)  # the others start near it
    for c, i in enumerate(model.nonlinear):
        p = model.parameters[i]
        h = step * max(abs(theta[i]), abs(p.scale) if np.isfinite(p.scale) else 0.0, 1e-12)
        shifted = theta.copy()
        shifted[i] = theta[i] + h if theta[i] + h <= p.hi else theta[i] - h
        for o, y in model.simulate(view, shifted, model.moved_by(i)).items():
            bends[o][:, c] = (y[rows] - base[o][rows]) / (shifted[i] - theta[i])
    energy: dict[str, float] = {}
    if problem.twin.apart:
        design = model.design(problem.view, theta, samples=samples)
        for o in outputs:
            s = problem.sigma(o)
            known = Regression([np.column_stack([design.columns[o], bends[o]]) / s])
            left = known.less(current.residual[o][rows] / s)
            energy[o] = float(left @ left)
    columns: dict[str, tuple[NDArray[np.int64], Array]] = {}
    if is_wide(problem, model):
        design = model.design(problem.view, theta, samples=samples)
        place = {j: c for c, j in enumerate(model.linear)}
        columns = {o: (np.array([place[j] for j in design.linear[o]], int), design.columns[o]) for o in outputs}
    return Ground(rows, samples, bends, energy, columns, view.nearby)


def one_step(problem: Problem, current: Fit, place: Placed, ground: Ground) -> Candidate:
    """Apply the score test to a candidate.

    The residual is regressed on the change of the simulated output by the effect at each of its starting points,
    together with everything that is free already (``ground`` from ``bend``).
    """
    placed = prepare(current.model, problem.fit_view, current.theta, place)
    model = Model(problem.twin, (*current.model.placed, placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    k = len(model.placed) - 1
    begin = starts(model, k, problem.fit_view, theta)
    found = Candidate(placed, 0.0, 1.0, False, tuple(begin))
    if placed.effect.test is not None:
        o = placed.outputs[0]
        x, ctx = probe_signals(current.model, problem.fit_view, current.theta, placed, o)
        full = np.zeros(problem.recording.n)
        index = problem.fit_view.index
        full[index] = current.residual[o][problem.row_of_sample[index]]
        signature = placed.effect.test(x, full, ctx)
        found = replace(found, share=signature.share, p_value=signature.p_value, tested=True)
        if found.refused:
            return found
    for start in begin[:6]:
        gained, p = _step_gain(problem, current, model, start, ground)
        p_value = found.p_value if found.tested else min(found.p_value, p * len(begin))
        found = replace(found, share=max(found.share, gained), p_value=p_value)
    if found.tested:
        return found
    hinted = (_from_hint(problem, current, hint, ground) for hint in problem.hints if _is_about(hint, place))
    return max((found, *hinted), key=lambda c: c.share)


def _is_about(hint: Hint, place: Placed) -> bool:
    return hint.placed.label == place.label and hint.placed.effect.equation == place.effect.equation


def _from_hint(problem: Problem, current: Fit, hint: Hint, ground: Ground) -> Candidate:
    """Test one step from the best fit on a part of the recording; its base is used, too, without other effects."""
    model = Model(problem.twin, (*current.model.placed, hint.placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    if not current.model.placed:
        theta[: model.n_base] = hint.base
    for where, values in zip(model.slices(len(model.placed) - 1), hint.own, strict=True):
        theta[where] = values
    share, p_value = _step_gain(problem, current, model, theta, ground)
    return Candidate(hint.placed, share, p_value, False, (theta,))


def _step_gain(problem: Problem, current: Fit, model: Model, theta: Array, ground: Ground) -> tuple[float, float]:
    """Return (explained share of the mean square, p-value of the F test) of one linear step from ``theta``."""
    outputs = model.together(model.placed[-1].outputs)
    rows = ground.rows
    base = current.theta.copy()
    base[: model.n_base] = theta[: model.n_base]
    elsewhere_based = not problem.twin.static and not np.array_equal(base, current.theta)
    nearby = current.model.started(problem.view, base) if elsewhere_based else ground.nearby
    view = problem.view.near(nearby)
    design = model.design(view, theta, outputs, ground.samples)
    n_old = {p.name for p in current.model.parameters}
    new_weights = [j for j in model.nonlinear if model.parameters[j].name not in n_old and _is_weight(model, j)]
    # the design at these parameters contains the simulation
    moved = {o: design.constant[o] + design.columns[o] @ theta[list(design.linear[o])] for o in outputs}
    # a start on another base is compared with that base without the effect, whose gain is not the effect's share
    without = current.model.simulate(problem.view.near(nearby), base, outputs) if elsewhere_based else None
    pushed: list[dict[str, Array]] = []
    for j in new_weights:
        other = theta.copy()
        other[j] += 0.05 * model.parameters[j].scale
        pushed.append(model.simulate(view, other, outputs))
    seen = {j for o in outputs for j in design.linear[o]}
    old_linear = [j for j in model.linear if j in seen and model.parameters[j].name in n_old]
    new_linear = [j for j in model.linear if j in seen and model.parameters[j].name not in n_old]
    target: list[Array] = []
    old: list[Array] = []
    new: list[Array] = []
    shift: list[Array] = []
    for o in outputs:
        s = problem.sigma(o)
        target.append(current.residual[o][rows] / s)
        at = {j: i for i, j in enumerate(design.linear[o])}

        def columns(js: list[int], at: dict[int, int] = at, o: str = o, s: float = s) -> Array:
            block = np.zeros((rows.size, len(js)))
            for c, j in enumerate(js):
                if j in at:
                    block[:, c] = design.columns[o][:, at[j]] / s
            return block

        here = problem.measured[o][rows] - current.residual[o][rows]
        shift.append((without[o][rows] - here) / s if without is not None else np.zeros(rows.size))
        old.append(np.column_stack([columns(old_linear), ground.bends[o] / s]))
        extra = [columns(new_linear)]
        if model.nonlinear:
            extra.append(((moved[o] - (here if without is None else without[o][rows])) / s)[:, None])
            extra += [((p[o][rows] - moved[o]) / s)[:, None] for p in pushed]
        new.append(np.column_stack(extra))
    e, more = np.concatenate(target), np.concatenate(new)
    if not (all(np.all(np.isfinite(b)) for b in old) and np.all(np.isfinite(more))):
        return 0.0, 1.0
    known = Regression(old)
    e0, more = known.less(e), known.less(more)
    size = np.linalg.norm(more, axis=0)
    more = more[:, size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)]
    # outputs that share nothing with the candidate keep their residual
    idle = sum(ground.energy[o] for o in problem.twin.outputs if o not in outputs)
    before_ = float(e0 @ e0) + idle
    if before_ <= 0 or more.shape[1] == 0:
        return 0.0, 1.0
    null, begin = before_, e0
    if without is not None:
        begin = known.less(e - np.concatenate(shift))
        null = min(before_, float(begin @ begin) + idle)
    left = Regression([more]).less(begin)
    after = float(left @ left) + idle
    dof = max(rows.size * len(problem.twin.outputs) - more.shape[1] - old[0].shape[1], 1)
    f = (null - after) / more.shape[1] / max(after / dof, 1e-300)
    # the gain of another base by itself is not the effect's
    share = 1 - after / (before_ if null - after > OWN_SHARE * null else null)
    return max(0.0, share), float(f_distribution.sf(max(f, 0.0), more.shape[1], dof))


def _is_weight(model: Model, j: int) -> bool:
    return any(w.start <= j < w.stop for _, w in (model.slices(k) for k in range(len(model.placed))))


DIVERGED = 1e100  # of a derivative in noise rms: its square must stay finite


class Regression:
    """Solves least squares with columns of which each block of rows (an output) has few: zeros are not multiplied.

    ``blocks``: (rows, columns) each, of the same size; the columns are those of all blocks, stacked.
    """

    def __init__(self, blocks: Sequence[Array]) -> None:
        self.blocks: list[tuple[NDArray[np.int64], Array]] = []
        k = blocks[0].shape[1]
        gram = np.zeros((k, k))
        for block in blocks:
            # a parameter whose small step makes the simulation diverge has no derivative
            largest = np.max(np.abs(block), axis=0, initial=0.0)
            seen = np.flatnonzero((largest > 0.0) & (largest < DIVERGED))
            x = block if seen.size == k else block[:, seen]
            self.blocks.append((seen, x))
            gram[np.ix_(seen, seen)] += x.T @ x
        size = np.sqrt(np.diag(gram))
        scale = np.where(size > 0, 1.0 / np.maximum(size, 1e-300), 0.0)
        self.inverse = np.zeros((k, k))
        if k:
            values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
            keep = values > max(1e-9 * values[-1], 1e-300)
            root = scale[:, None] * vectors[:, keep] / np.sqrt(values[keep])
            self.inverse = root @ root.T

    def less(self, y: Array) -> Array:
        """Return ``y`` (rows of all blocks[, m]) less its projection on the columns."""
        parts = np.split(y, len(self.blocks))
        seen = np.zeros((self.inverse.shape[0], *y.shape[1:]))
        for (at, x), part in zip(self.blocks, parts, strict=True):
            seen[at] += x.T @ part
        weights = self.inverse @ seen
        return np.concatenate([part - x @ weights[at] for (at, x), part in zip(self.blocks, parts, strict=True)])
