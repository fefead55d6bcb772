"""Which effects may matter: every candidate place tried with one step inside the simulator."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Hint, Problem, spread
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare, probe_signals, starts

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
            taken = any(p.effect.name == effect.name and _same_place(p, place) for p in present)
            if not taken:
                out.append(place)
    return out


def _same_place(present: Placed, place: Placed) -> bool:
    """Return whether two places move the same outputs, but for forces and flows at different states."""
    if present.site == place.site == "feedback":
        return bool(set(present.target.split("+")) & set(place.target.split("+")))
    return bool(set(present.outputs) & set(place.outputs))


@dataclass(frozen=True)
class Ground:
    """What every candidate is screened against: ``samples`` of the recording and their ``rows`` in the view, the
    outputs' movement with each searched parameter of the current model there (``bends[o]`` (rows, k)), and the energy
    that is left to each output when everything free is regressed out.
    """

    rows: NDArray[np.int64]
    samples: NDArray[np.int64]
    bends: dict[str, Array]
    energy: dict[str, float]


ROWS = 12_000  # of the fit, that a screen looks at
OWN_SHARE = 0.05  # of what the engineer's base leaves: an effect that takes less there has only the base to thank


def bend(problem: Problem, current: Fit) -> Ground:
    """The ground that the candidates share, with the sensitivities by forward differences."""
    model, theta = current.model, current.theta
    rows = spread(problem.fit_rows, ROWS, problem.seed)
    samples = problem.index[rows]
    outputs = problem.twin.outputs
    bends = {o: np.zeros((rows.size, len(model.nonlinear))) for o in outputs}
    for c, i in enumerate(model.nonlinear):
        p = model.parameters[i]
        h = 1e-3 * max(abs(theta[i]), abs(p.scale) if np.isfinite(p.scale) else 0.0, 1e-12)
        shifted = theta.copy()
        shifted[i] = theta[i] + h if theta[i] + h <= p.hi else theta[i] - h
        for o, y in model.simulate(problem.view, shifted, model.moved_by(i)).items():
            now = problem.measured[o][rows] - current.residual[o][rows]
            bends[o][:, c] = (y[rows] - now) / (shifted[i] - theta[i])
    energy: dict[str, float] = {}
    if problem.twin.apart:
        design = model.design(problem.view, theta, samples=samples)
        for o in outputs:
            s = problem.sigma(o)
            known = Regression([np.column_stack([design.columns[o], bends[o]]) / s])
            left = known.less(current.residual[o][rows] / s)
            energy[o] = float(left @ left)
    return Ground(rows, samples, bends, energy)


def one_step(problem: Problem, current: Fit, place: Placed, ground: Ground) -> Candidate:
    """Score test of one candidate: the simulator's output moved by the effect at each of its starting points,
    regressed on the residual together with everything that is free already (``ground`` from ``bend``).
    """
    placed = prepare(current.model, problem.fit_view, current.theta, place)
    model = Model(problem.twin, (*current.model.placed, placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    k = len(model.placed) - 1
    begin = starts(model, k, problem.fit_view, theta)
    share, p_value, tested = 0.0, 1.0, False
    if placed.effect.test is not None:
        o = placed.outputs[0]
        x, ctx = probe_signals(current.model, problem.fit_view, current.theta, placed, o)
        full = np.zeros(problem.recording.n)
        index = problem.fit_view.index
        full[index] = current.residual[o][problem.row_of_sample[index]]
        signature = placed.effect.test(x, full, ctx)
        share, p_value, tested = signature.share, signature.p_value, True
    for start in begin[:6]:
        gained, p = _step_gain(problem, current, model, start, ground)
        share = max(share, gained)
        if not tested:
            p_value = min(p_value, min(1.0, p * len(begin)))
    found = Candidate(placed, share, p_value, tested, tuple(begin))
    if tested:
        return found
    hinted = (_from_hint(problem, current, hint, ground) for hint in problem.hints if _is_about(hint, place))
    return max((found, *hinted), key=lambda c: c.share)


def _is_about(hint: Hint, place: Placed) -> bool:
    return hint.placed.label == place.label and hint.placed.effect.equation == place.effect.equation


def _from_hint(problem: Problem, current: Fit, hint: Hint, ground: Ground) -> Candidate:
    """One step from where a part of the recording had its best fit; its base, too, while no other effect is there."""
    model = Model(problem.twin, (*current.model.placed, hint.placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    if not current.model.placed:
        theta[: model.n_base] = hint.base
    for where, values in zip(model.slices(len(model.placed) - 1), hint.own, strict=True):
        theta[where] = values
    share, p_value = _step_gain(problem, current, model, theta, ground)
    return Candidate(hint.placed, share, p_value, False, (theta,))


def _step_gain(problem: Problem, current: Fit, model: Model, theta: Array, ground: Ground) -> tuple[float, float]:
    """(share of the mean square taken, p-value of the F test) by one linear step from ``theta``."""
    outputs = model.together(model.placed[-1].outputs)
    rows = ground.rows
    design = model.design(problem.view, theta, outputs, ground.samples)
    n_old = {p.name for p in current.model.parameters}
    new_weights = [j for j in model.nonlinear if model.parameters[j].name not in n_old and _is_weight(model, j)]
    # the design at these parameters holds the simulation, too
    moved = {o: design.constant[o] + design.columns[o] @ theta[list(design.linear[o])] for o in outputs}
    # a start on another base is measured from there: what that base does without the effect is not the effect's share
    base = current.theta.copy()
    base[: model.n_base] = theta[: model.n_base]
    elsewhere_based = not problem.twin.static and not np.array_equal(base, current.theta)
    without = current.model.simulate(problem.view, base, outputs) if elsewhere_based else None
    pushed: list[dict[str, Array]] = []
    for j in new_weights:
        other = theta.copy()
        other[j] += 0.05 * model.parameters[j].scale
        pushed.append(model.simulate(problem.view, other, outputs))
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
    # outputs that share nothing with the candidate keep what they have
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
    # what another base does by itself is not the effect's
    share = 1 - after / (before_ if null - after > OWN_SHARE * null else null)
    return max(0.0, share), float(f_distribution.sf(max(f, 0.0), more.shape[1], dof))


def _is_weight(model: Model, j: int) -> bool:
    return any(w.start <= j < w.stop for _, w in (model.slices(k) for k in range(len(model.placed))))


class Regression:
    """Least squares on columns of which each block of rows (an output) sees few: zeros are not multiplied.

    ``blocks``: (rows, columns) each, of the same size; the columns are those of all blocks on top of one another.
    """

    def __init__(self, blocks: Sequence[Array]) -> None:
        self.blocks: list[tuple[NDArray[np.int64], Array]] = []
        k = blocks[0].shape[1]
        gram = np.zeros((k, k))
        for block in blocks:
            seen = np.flatnonzero(np.any(block != 0.0, axis=0))
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
        """``y`` (rows of all blocks[, m]) less its projection on the columns."""
        parts = np.split(y, len(self.blocks))
        seen = np.zeros((self.inverse.shape[0], *y.shape[1:]))
        for (at, x), part in zip(self.blocks, parts, strict=True):
            seen[at] += x.T @ part
        weights = self.inverse @ seen
        return np.concatenate([part - x @ weights[at] for (at, x), part in zip(self.blocks, parts, strict=True)])
