"""Intervals of fitted parameters from the block-clustered sandwich: coloured residuals do not make them too narrow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.mismatch.engine.fit import HUBER, Fit, moved_a_little, robust_scale
from tools.mismatch.engine.problem import Problem

Array = NDArray[np.float64]


def jacobian(problem: Problem, fitted: Fit, stride: int = 1) -> Array:
    """Sensitivity of the noise-weighted outputs on fit rows to every parameter (rows, parameters)."""
    model, theta = fitted.model, fitted.theta
    rows = problem.fit_rows[:: max(1, stride)]
    design = model.design(problem.view, theta)
    outputs = problem.twin.outputs
    sensitivity = {o: np.zeros((rows.size, theta.size)) for o in outputs}
    for o in outputs:
        for i, j in enumerate(design.linear[o]):
            sensitivity[o][:, j] = design.columns[o][rows, i]
    here = model.simulate(problem.view, theta) if model.nonlinear else {}
    for i in model.nonlinear:
        shifted = moved_a_little(model, theta, i)
        moved = shifted[i] - theta[i]
        if moved == 0.0:
            continue
        there = model.simulate(problem.view, shifted)
        for o in outputs:
            sensitivity[o][:, i] = (there[o][rows] - here[o][rows]) / moved
    return np.concatenate([sensitivity[o] / problem.sigma(o) for o in outputs])


def covariance(problem: Problem, fitted: Fit) -> Array:
    """Block-clustered sandwich covariance of theta (Liang and Zeger, Biometrika 73, 1986), never below the one
    that white residuals would give.
    """
    stride = max(1, problem.fit_rows.size * len(problem.twin.outputs) // 200_000)
    j = jacobian(problem, fitted, stride)
    rows = problem.fit_rows[::stride]
    r = np.concatenate([fitted.residual[o][rows] / problem.sigma(o) for o in problem.twin.outputs])
    limit = HUBER * robust_scale(r, 0.0)
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
    meat = scores.T @ scores * (len(problem.fit_blocks) / max(len(problem.fit_blocks) - 1, 1))
    sandwich = bread @ meat @ bread
    plain = bread * float(np.mean(r * r))
    inflate = np.sqrt(np.maximum(np.diag(plain), 1e-300) / np.maximum(np.diag(sandwich), 1e-300))
    sandwich = sandwich * np.outer(np.maximum(inflate, 1.0), np.maximum(inflate, 1.0))
    return sandwich / np.outer(size, size)
