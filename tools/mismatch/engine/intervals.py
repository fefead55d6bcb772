"""How sure fitted parameters are: a covariance that colour, few blocks and a wrong form widen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from tools.mismatch.engine.colour import fit_whitener
from tools.mismatch.engine.fit import Fit, moved_a_little
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import HUBER, robust_scale
from tools.mismatch.engine.trust import TIMES_GIVEN, TIMES_SCALE
from tools.mismatch.simulate import Model

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


def jacobian(problem: Problem, fitted: Fit, stride: int = 1) -> Array:
    """Sensitivity of the noise-weighted outputs on fit rows to every parameter (rows, parameters).

    The steps of a quantiser have no slope that says anything: what lies before it is moved without it.
    """
    model, theta = fitted.model, fitted.theta
    rows = problem.fit_rows[:: max(1, stride)]
    outputs = problem.twin.outputs
    found = np.zeros((rows.size * len(outputs), theta.size))
    smooth = Model(problem.twin, [p for p in model.placed if p.effect.name != "quantization"])
    if len(smooth.placed) < len(model.placed):
        at = smooth.carry(model, theta, problem.recording)
        names = [p.name for p in model.parameters]
        before = [names.index(p.name) for p in smooth.parameters]
        found[:, before] = jacobian(problem, replace(fitted, model=smooth, theta=at), stride)
        return _moved(problem, model, theta, rows, found, [i for i in range(theta.size) if i not in before])
    design = model.design(problem.view, theta, samples=problem.index[rows])
    for k, o in enumerate(outputs):
        for i, j in enumerate(design.linear[o]):
            found[k * rows.size : (k + 1) * rows.size, j] = design.columns[o][:, i] / problem.sigma(o)
    return _moved(problem, model, theta, rows, found, model.nonlinear)


def _moved(problem: Problem, model: Model, theta: Array, rows: Rows, found: Array, which: Sequence[int]) -> Array:
    """``found`` with the columns of these parameters from differences of two simulations."""
    stack = lambda y: np.concatenate([y[o][rows] / problem.sigma(o) for o in problem.twin.outputs])  # noqa: E731
    here = stack(model.simulate(problem.view, theta)) if which else np.zeros(0)
    for i in which:
        shifted = moved_a_little(model, theta, i)
        by = shifted[i] - theta[i]
        if by != 0.0:
            found[:, i] = (stack(model.simulate(problem.view, shifted)) - here) / by
    return found


def covariance(problem: Problem, fitted: Fit) -> Array:
    """Covariance of theta for 95 % intervals of 1.96 standard deviations: block-clustered sandwich (Liang and Zeger,
    Biometrika 73, 1986), wider where few blocks carry a parameter (Student's t with Satterthwaite's degrees of
    freedom), never below what the residual's own colour or white residuals would give. What held-out samples leave
    beyond the fit is the form of the model, and counts. A parameter that the data do not move is as wide as its bounds.
    """
    stride = max(1, problem.fit_rows.size * len(problem.twin.outputs) // 200_000)
    j = jacobian(problem, fitted, stride)
    rows = problem.fit_rows[::stride]
    r = np.concatenate([fitted.residual[o][rows] / problem.sigma(o) for o in problem.twin.outputs])
    limit = HUBER * robust_scale(r, 1.0)
    r = np.clip(r, -limit, limit)
    size = np.sqrt(np.maximum(np.sum(j * j, axis=0), 1e-300))
    js = j / size
    bread = np.linalg.pinv(js.T @ js, rcond=1e-12)
    block = np.zeros(rows.size, int)
    for b, (start, stop) in enumerate(problem.fit_blocks):
        block[(rows >= start) & (rows < stop)] = b
    blocks = np.tile(block, len(problem.twin.outputs))
    scores = np.zeros((len(problem.fit_blocks), j.shape[1]))
    np.add.at(scores, blocks, js * r[:, None])
    moved = scores @ bread * np.sqrt(len(problem.fit_blocks) / max(len(problem.fit_blocks) - 1, 1))
    sandwich = moved.T @ moved
    plain = bread * float(np.mean(r * r))
    wide = np.maximum(np.diag(sandwich) * few_blocks(moved) ** 2, np.diag(plain))
    if stride == 1:
        wide = np.maximum(wide, np.diag(bread @ _coloured_meat(problem, js, r) @ bread))
    inflate = np.sqrt(np.maximum(wide, 1e-300) / np.maximum(np.diag(sandwich), 1e-300))
    found = sandwich * np.outer(inflate, inflate) / np.outer(size, size) * _beyond_fit(problem, fitted)
    for i in np.flatnonzero(size < 1e-6 * np.sqrt(rows.size) / np.maximum(_ranges(fitted), 1e-300)):
        found[i, :] = found[:, i] = 0.0
        found[i, i] = (_ranges(fitted)[i] / 3.92) ** 2
    return found


def few_blocks(moved: Array) -> Array:
    """Student's quantile over the normal one (parameters,) for what each block ``moved`` (blocks, parameters)."""
    share = moved**2
    freedom = np.sum(share, axis=0) ** 2 / np.maximum(np.sum(share**2, axis=0), 1e-300)
    return student.ppf(0.975, np.clip(freedom, 3.0, None)) / 1.96


def _coloured_meat(problem: Problem, js: Array, r: Array) -> Array:
    """Covariance (parameters, parameters) of the scores when the residual has the spectrum of its autoregression."""
    m = problem.fit_rows.size
    out = np.zeros((js.shape[1], js.shape[1]))
    cuts = np.flatnonzero(np.diff(problem.fit_rows) != 1) + 1
    spans = list(zip(np.r_[0, cuts].tolist(), np.r_[cuts, m].tolist(), strict=True))
    for i in range(len(problem.twin.outputs)):
        mine = slice(i * m, (i + 1) * m)
        e, slopes = r[mine], js[mine]
        whitener = fit_whitener(e, stretches=spans)
        for a, b in spans:
            waves = np.fft.rfft(slopes[a:b], axis=0)
            # one-sided spectrum: all but the ends stand for two
            twice = np.full(waves.shape[0], 2.0)
            twice[0] = 1.0
            if (b - a) % 2 == 0:
                twice[-1] = 1.0
            level = twice * whitener.spectrum(np.arange(waves.shape[0]) / (b - a)) / (b - a)
            out += np.real(waves.conj().T @ (waves * level[:, None]))
    return out


def _beyond_fit(problem: Problem, fitted: Fit) -> float:
    """Mean square on held-out samples over that on fitted ones, at least 1, outliers bounded alike."""
    ratio = 1.0
    for o, r in fitted.residual.items():
        limit = HUBER * robust_scale(r[problem.fit_rows], problem.sigma(o))
        there, here = (float(np.mean(np.clip(r[k], -limit, limit) ** 2)) for k in (problem.held_rows, problem.fit_rows))
        ratio = max(ratio, there / max(here, 1e-300))
    return ratio


def _ranges(fitted: Fit) -> Array:
    """Widths of the bounds (parameters,); of an unbounded one that of its prior, or its scale where it has none."""
    model = fitted.model
    wide = np.array([p.hi - p.lo for p in model.parameters])
    scale = np.array([abs(p.scale) for p in model.parameters])
    base = slice(0, model.n_base)
    scale[base] = np.maximum(TIMES_GIVEN * np.abs(fitted.theta[base]), TIMES_SCALE * scale[base])
    return np.where(np.isfinite(wide), wide, scale)
