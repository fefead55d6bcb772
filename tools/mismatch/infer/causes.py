"""Tests if the past of what moves predicts a residual, as it does not predict noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array
from sim_devices.physics.statistics import thin
from tools.mismatch.engine.dependence import Dependence, projected_energy, whitened_f
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.infer.loudness import LEAST_P

LAGS = 64
"""Number of samples of a past."""
LEAST_ROWS, MOST_ROWS = 8 * LAGS, 20_000
"""Least and largest number of samples at which the residual is predicted."""


def caused_by(problem: Problem, fitted: Fit, output: str) -> Dependence | None:
    """Return the signal whose past predicts the residual of ``output`` beside its own past; None if none does.

    Physics that the simulation lacks carries an input, or a curve of what moves, to the output, whatever the dynamics
    between (C. W. J. Granger, Econometrica 37, 1969, sec. 3). The present of a signal is left out: where a controller
    feeds noise back, the present command depends on the present noise, and the past commands do not. The p-value is
    corrected for the number of tests.
    """
    # a signal, and a run that starts afresh, jumps between ranges
    rows = thin(np.concatenate([np.arange(b - a) >= LAGS for a, b in problem.view.ranges]), MOST_ROWS)
    if rows.size < LEAST_ROWS:
        return None
    residual = fitted.residual[output]
    own = np.linalg.qr(np.column_stack([np.ones(rows.size), _past(residual, rows)]))[0]
    news = residual[rows] - own @ (own.T @ residual[rows])
    best, tests = Dependence(output, "value", 1.0, 0.0, True), 0
    for name, feature, curve in _moving(problem, fitted):
        if np.ptp(curve) == 0.0:
            continue
        tests += 1
        past = _past(curve, rows)
        past -= own @ (own.T @ past)
        p = whitened_f(news, past)
        if p < best.p_value:
            share = projected_energy(news, past)[0] / float(news @ news)
            best = Dependence(name, feature, p, share, True)
    p = min(1.0, best.p_value * tests)
    return replace(best, p_value=p) if p < LEAST_P else None


def _past(x: Array, rows: NDArray[np.int64]) -> Array:
    """Return the samples before ``rows`` (m,) of ``x`` (n,), (m, LAGS)."""
    return np.stack([x[rows - k] for k in range(1, LAGS + 1)], axis=1)


def _moving(problem: Problem, fitted: Fit) -> Iterator[tuple[str, str, Array]]:
    """Yield (name, feature, curve (m,)) of inputs and simulated outputs; friction and drag follow the rates."""
    inputs = {s: problem.recording.signals[s][problem.index] for s in problem.twin.inputs}
    outputs = {o: problem.measured[o] - fitted.residual[o] for o in problem.twin.outputs}
    for name, signal in (*inputs.items(), *outputs.items()):
        x = signal - signal.mean()
        yield from ((name, "value", x), (name, "square", x**2), (name, "value", x**3))
        if name in outputs:
            rate = np.diff(x, prepend=x[0])
            yield from ((name, "rate", np.sign(rate)), (name, "rate", rate * np.abs(rate)))
