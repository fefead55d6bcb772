"""Estimates the uncertainty of fitted parameters: colour, few blocks and a wrong form widen their intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from hal.arrays import Array
from tools.mismatch.engine.colour import fit_whitener
from tools.mismatch.engine.fit import Fit, moved_a_little
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import HUBER, robust_scale
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.trust import TIMES_GIVEN, TIMES_SCALE
from tools.mismatch.simulate import Model

Rows = NDArray[np.int64]

LEAST_SQUARE = 1e-12
"""Least square of a direction of parameters, as a share of the largest: below it is rounding."""


def jacobian(problem: Problem, fitted: Fit, stride: int = 1) -> Array:
    """Return the sensitivity of the noise-weighted outputs on fit rows to every parameter (rows, parameters).

    The steps of a quantiser have no meaningful slope, so parameters in front of it are moved without it.
    """
    model, theta = fitted.model, fitted.theta
    rows = problem.fit_rows[:: max(1, stride)]
    outputs = problem.twin.outputs
    found = np.zeros((rows.size * len(outputs), theta.size))
    smooth = before_rounding(problem, fitted)
    if smooth is not fitted:
        names = [p.name for p in model.parameters]
        before = [names.index(p.name) for p in smooth.model.parameters]
        found[:, before] = jacobian(problem, smooth, stride)
        return _moved(problem, model, theta, rows, found, [i for i in range(theta.size) if i not in before])
    design = model.design(problem.view, theta, samples=problem.index[rows])
    for k, o in enumerate(outputs):
        for i, j in enumerate(design.linear[o]):
            found[k * rows.size : (k + 1) * rows.size, j] = design.columns[o][:, i] / problem.sigma(o)
    return _moved(problem, model, theta, rows, found, model.nonlinear)


def before_rounding(problem: Problem, fitted: Fit) -> Fit:
    """Return ``fitted`` without its quantisers, the residual of which contains the error of rounding."""
    model = fitted.model
    smooth = Model(problem.twin, [p for p in model.placed if p.effect.name != "quantization"])
    if len(smooth.placed) == len(model.placed):
        return fitted
    at = smooth.carry(model, fitted.theta, problem.recording)
    return replace(fitted, model=smooth, theta=at, residual=residuals(problem, smooth, at))


def rounding_left(problem: Problem, fitted: Fit, output: str) -> float:
    """Return the rms that a fitted quantiser leaves: the mean reading is predicted, not the side on which one falls.

    B. Widrow, I. Kollar, Quantization Noise (2008), chapter 16: noise and rounding together, less the mean of steps.
    """
    model, theta = fitted.model, fitted.theta
    placed = [k for k, p in enumerate(model.placed) if p.effect.name == "quantization" and output in p.outputs]
    if not placed:
        return 0.0
    (step,), dither = model.placed[placed[0]].settings["step"], float(theta[model.slices(placed[0])[0]][0])
    smooth = before_rounding(problem, fitted)
    before = smooth.model.simulate(problem.view, smooth.theta, (output,))[output]
    after = model.simulate(problem.view, theta, (output,))[output]
    known = float(np.mean((after - before)[problem.held_rows] ** 2))
    return math.sqrt(max(dither**2 + step**2 / 12.0 - known, 0.0))


def _moved(problem: Problem, model: Model, theta: Array, rows: Rows, found: Array, which: Sequence[int]) -> Array:
    """Return ``found`` with the columns of these parameters from differences of two simulations."""
    stack = lambda y: np.concatenate([y[o][rows] / problem.sigma(o) for o in problem.twin.outputs])  # noqa: E731
    here = stack(model.simulate(problem.view, theta)) if which else np.zeros(0)
    for i in which:
        shifted = moved_a_little(model, theta, i)
        by = shifted[i] - theta[i]
        if by != 0.0:
            found[:, i] = (stack(model.simulate(problem.view, shifted)) - here) / by
    return found


@dataclass(frozen=True)
class Uncertainty:
    """Holds the uncertainty of fitted parameters.

    Three estimates are kept separately, and the largest counts for each quantity. Weights that cancel each other have a
    certain sum although each is uncertain, which a single matrix of the largest variances would not express.

    ``moved`` (blocks, parameters): shift of the parameters by each block of the data; ``plain`` and ``coloured``
    (parameters, parameters): their covariance for a white residual, and for one with the spectrum of its
    autoregression; ``own`` (parameters,): variance of those that the data do not move; ``beyond``: factor for the form
    of the model. ``whole`` returns the variance of a factor of all that an effect adds to the outputs but a curve
    beside it.
    """

    moved: Array
    plain: Array
    coloured: Array
    own: Array
    beyond: float
    whole: Callable[[int], float]

    def spread(self, gradients: Array) -> Array:
        """Return standard deviations (k,) of quantities with these ``gradients`` (k, parameters).

        A 95 % interval is 1.96 of them either way.
        """
        moved = self.moved @ gradients.T
        accounts = [np.sum(moved**2, axis=0) * few_blocks(moved) ** 2]
        accounts += [np.einsum("ij,jk,ik->i", gradients, c, gradients) for c in (self.plain, self.coloured)]
        return np.sqrt(np.maximum(np.max(accounts, axis=0), 0.0) * self.beyond + gradients**2 @ self.own)

    def chance_of_none(self, k: int, figures: int) -> float:
        """Return the p-value that effect ``k`` with ``figures`` parameters adds nothing (Wald's test).

        Parameters that cancel each other are jointly certain although each is uncertain.
        """
        return float(chi2.sf(1.0 / (self.whole(k) * self.beyond), max(figures, 1)))

    def deviations(self) -> Array:
        """Return the standard deviation of each parameter (parameters,)."""
        return self.spread(np.eye(self.own.size))


def uncertainty(problem: Problem, fitted: Fit) -> Uncertainty:
    """Estimate the uncertainty of the parameters of a fit.

    It is the shift by each block (block-clustered sandwich, Liang and Zeger, Biometrika 73, 1986), wider if few blocks
    carry a quantity (Student's t with Satterthwaite's degrees of freedom), and never below that of the residual's own
    colour or of white residuals. A larger residual on held-out samples is an error of the model's form, and counts. A
    parameter that the data do not move is as wide as its bounds.
    """
    stride = max(1, problem.fit_rows.size * len(problem.twin.outputs) // 200_000)
    j = jacobian(problem, fitted, stride)
    rows = problem.fit_rows[::stride]
    # a rounding that is explained exactly is still what the parameters are uncertain by (Widrow and Kollar 2008)
    smooth = before_rounding(problem, fitted)
    r = np.concatenate([smooth.residual[o][rows] / problem.sigma(o) for o in problem.twin.outputs])
    limit = HUBER * robust_scale(r, 1.0)
    r = np.clip(r, -limit, limit)
    size = np.sqrt(np.maximum(np.sum(j * j, axis=0), 1e-300))
    block = np.zeros(rows.size, int)
    for b, (start, stop) in enumerate(problem.fit_blocks):
        block[(rows >= start) & (rows < stop)] = b
    blocks = np.tile(block, len(problem.twin.outputs))
    priors = _priors(fitted) / stride
    accounts = partial(_accounts, problem, r=r, blocks=blocks, thinned=stride > 1)
    moved, plain, coloured = accounts(j / size, priors=priors / size**2)

    def factor(k: int) -> float:
        own, weights = fitted.model.slices(k)
        figures = np.r_[own, weights.start : weights.stop - fitted.model.placed[k].weights_beside]
        column = _added(problem, fitted, j, rows, k)
        norm = float(np.linalg.norm(column))
        if norm <= 1e-150:
            return np.inf
        # all figures as one column: their matrix may be too nearly singular to be inverted
        others, v = np.delete(np.arange(size.size), figures), fitted.theta[figures]
        joined = np.column_stack([j[:, others] / size[others], column / norm])
        small = np.r_[priors[others] / size[others] ** 2, float(v @ (priors[figures] * v)) / norm**2]
        m, p, c = accounts(joined, priors=small)
        return max(float(np.sum(m[:, -1] ** 2)), float(p[-1, -1]), float(c[-1, -1])) / norm**2

    idle = size < 1e-6 * np.sqrt(rows.size) / np.maximum(_ranges(fitted), 1e-300)
    scale = np.where(idle, 0.0, 1.0 / size)
    own = np.where(idle, (_ranges(fitted) / 3.92) ** 2, 0.0)
    both = np.outer(scale, scale)
    return Uncertainty(moved * scale, plain * both, coloured * both, own, _beyond_fit(problem, smooth), factor)


def _added(problem: Problem, fitted: Fit, j: Array, rows: Rows, k: int) -> Array:
    """Return what effect ``k`` adds to the noise-weighted outputs on ``rows``, without a curve beside it.

    ``j``: the Jacobian there.
    """
    model, theta = fitted.model, fitted.theta
    own, weights = model.slices(k)
    weights = slice(weights.start, weights.stop - model.placed[k].weights_beside)
    if own.start == own.stop:
        return j[:, weights] @ theta[weights]
    stack = lambda y: np.concatenate([y[o][rows] / problem.sigma(o) for o in problem.twin.outputs])  # noqa: E731
    without = Model(problem.twin, [p for i, p in enumerate(model.placed) if i != k])
    at = without.carry(model, theta, problem.recording)
    return stack(model.simulate(problem.view, theta)) - stack(without.simulate(problem.view, at))


def _accounts(
    problem: Problem, js: Array, *, r: Array, blocks: NDArray[np.int64], thinned: bool, priors: Array
) -> tuple[Array, Array, Array]:
    """Return (moved, plain, coloured) of ``Uncertainty`` for columns ``js`` (rows, k) of unit norm.

    ``r`` (rows,): residual; ``blocks`` (rows,): its blocks; ``priors`` (k,): precisions.
    """
    small = np.diag(priors)
    squares, axes = np.linalg.eigh(js.T @ js + small)
    # a direction that moves nothing, as width against slope of a zone that no sample is in, is not certain
    bread = (axes / np.maximum(squares, max(LEAST_SQUARE * squares.max(initial=0.0), 1e-300))) @ axes.T
    scores = np.zeros((len(problem.fit_blocks), js.shape[1]))
    np.add.at(scores, blocks, js * r[:, None])
    moved = scores @ bread * np.sqrt(len(problem.fit_blocks) / max(len(problem.fit_blocks) - 1, 1))
    # the noise alone moves an estimate, its prior does not: bread (js'js) bread, without the square of its condition
    plain = (bread - bread @ small @ bread) * float(np.mean(r * r))
    coloured = plain if thinned else bread @ _coloured_meat(problem, js, r) @ bread
    return moved, plain, coloured


def _priors(fitted: Fit) -> Array:
    """Return the precisions (parameters,) of the learned priors of the weights of effects, the noise being 1."""
    out = np.zeros(fitted.theta.size)
    for k, p in enumerate(fitted.model.placed):
        if p.label in fitted.shrunk:
            out[fitted.model.slices(k)[1]] = fitted.shrunk[p.label].precision
    return out


def few_blocks(moved: Array) -> Array:
    """Return Student's quantile over the normal one (parameters,) for the shifts ``moved`` (blocks, parameters)."""
    share = moved**2
    freedom = np.sum(share, axis=0) ** 2 / np.maximum(np.sum(share**2, axis=0), 1e-300)
    return student.ppf(0.975, np.clip(freedom, 3.0, None)) / 1.96


def _coloured_meat(problem: Problem, js: Array, r: Array) -> Array:
    """Return the covariance (parameters, parameters) of the scores by the spectrum of the residual's autoregression."""
    m = problem.fit_rows.size
    out = np.zeros((js.shape[1], js.shape[1]))
    cuts = np.flatnonzero(np.diff(problem.fit_rows) != 1) + 1
    spans = list(zip(np.r_[0, cuts].tolist(), np.r_[cuts, m].tolist(), strict=True))
    for i in range(len(problem.twin.outputs)):
        rows = slice(i * m, (i + 1) * m)
        e, slopes = r[rows], js[rows]
        whitener = fit_whitener(e, stretches=spans)
        for a, b in spans:
            waves = np.fft.rfft(slopes[a:b], axis=0)
            # the spectrum is one-sided: all bins but the ends count twice
            twice = np.full(waves.shape[0], 2.0)
            twice[0] = 1.0
            if (b - a) % 2 == 0:
                twice[-1] = 1.0
            level = twice * whitener.spectrum(np.arange(waves.shape[0]) / (b - a)) / (b - a)
            out += np.real(waves.conj().T @ (waves * level[:, None]))
    return out


def _beyond_fit(problem: Problem, fitted: Fit) -> float:
    """Return the mean square on held-out samples over that on fitted ones, at least 1, outliers bounded alike."""
    ratio = 1.0
    for o, r in fitted.residual.items():
        limit = HUBER * robust_scale(r[problem.fit_rows], problem.sigma(o))
        held, here = (float(np.mean(np.clip(r[k], -limit, limit) ** 2)) for k in (problem.held_rows, problem.fit_rows))
        ratio = max(ratio, held / max(here, 1e-300))
    return ratio


def _ranges(fitted: Fit) -> Array:
    """Return the widths of the bounds (parameters,); for an unbounded one that of its prior, or else its scale."""
    model = fitted.model
    wide = np.array([p.hi - p.lo for p in model.parameters])
    scale = np.array([abs(p.scale) for p in model.parameters])
    base = slice(0, model.n_base)
    scale[base] = np.maximum(TIMES_GIVEN * np.abs(fitted.theta[base]), TIMES_SCALE * scale[base])
    return np.where(np.isfinite(wide), wide, scale)
