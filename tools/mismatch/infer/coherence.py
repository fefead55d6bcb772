"""Tests if a residual is coherent with what moves, which noise that knows nothing of it is not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import detrend
from scipy.stats import chi2

from sim_devices.physics.effect import Array
from sim_devices.physics.statistics import whiten
from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.infer.loudness import LEAST_P

SEGMENTS = (16, 32, 64)
"""Numbers of segments of a record."""
LEAST_SAMPLES = 64
"""Least number of samples of a segment."""
ORDER = 30
"""Order of the filter that whitens a signal: ten resonances and their company."""
APART = 3
"""Distance of the bins that are tested: spectra behind a Hann window are independent from there."""


def coherence(a: Array, b: Array, segments: int) -> tuple[float, float]:
    """Return (share of the power of ``b`` (n,) that is coherent with ``a`` (n,), p-value that none is); both are white.

    If ``b`` knows nothing of ``a``, (1 - coherence)^(segments - 1) is uniform in every bin (G. C. Carter, C. H. Knapp,
    A. H. Nuttall, IEEE Trans. Audio Electroacoust. 21, 1973, eq. 3); the bins are combined by Fisher's method.
    """
    n = a.size // segments
    x, y = (
        np.fft.rfft(detrend(v[: n * segments].reshape(segments, n)) * np.hanning(n), axis=1)[:, APART:-APART:APART]
        for v in (a, b)
    )
    cross = np.abs(np.sum(np.conj(x) * y, axis=0)) ** 2
    of_x, of_y = (np.sum(np.abs(v) ** 2, axis=0) for v in (x, y))
    some = of_x * of_y > 0.0
    if not np.any(some):
        return 0.0, 1.0
    alike = np.minimum(cross[some] / (of_x * of_y)[some], 1.0 - 1e-12)
    statistic = -2.0 * (segments - 1) * float(np.sum(np.log1p(-alike)))
    chance = 1.0 / segments
    share = float(np.average(np.maximum(alike - chance, 0.0) / (1.0 - chance), weights=of_y[some]))
    return share, float(chi2.sf(statistic, 2 * alike.size))


def coherent_with(problem: Problem, fitted: Fit, output: str) -> Dependence | None:
    """Return the signal with which the residual of ``output`` is coherent; None if with none.

    Physics that the simulation lacks carries an input, or a curve of what moves, to the output, whatever the dynamics
    between. Curves of the simulated outputs stand for all that moves. The p-value is corrected for the number of tests.
    """
    inside = _inside(problem)
    # white, neither rings from segment to segment nor leaks from one bin into the others
    residual = whiten(fitted.residual[output], inside, ORDER)
    best, tests = Dependence(output, "value", 1.0, 0.0, True), 0
    for name, feature, curve in _moving(problem, fitted):
        signal = whiten(curve, inside, ORDER)
        for segments in SEGMENTS:
            if residual.size // segments < LEAST_SAMPLES or np.ptp(signal) == 0.0:
                continue
            tests += 1
            share, p = coherence(signal, residual, segments)
            if p < best.p_value:
                best = Dependence(name, feature, p, share, True)
    p = min(1.0, best.p_value * tests)
    return replace(best, p_value=p) if p < LEAST_P else None


def _inside(problem: Problem) -> NDArray[np.bool_]:
    """Return a mask (m,) without the ends of the ranges: a signal, and a run that starts afresh, jumps between them."""
    out = np.ones(problem.index.size, np.bool_)
    stops = np.cumsum([b - a for a, b in problem.view.ranges])
    out[stops - 1] = False
    out[stops[:-1]] = False
    return out


def _moving(problem: Problem, fitted: Fit) -> Iterator[tuple[str, str, Array]]:
    """Yield (name, feature, curve (m,)) of inputs and simulated outputs; friction and drag follow the rates."""
    inputs = {s: problem.recording.signals[s][problem.index] for s in problem.twin.inputs}
    outputs = {o: problem.measured[o] - fitted.residual[o] for o in problem.twin.outputs}
    for name, signal in (*inputs.items(), *outputs.items()):
        x = signal - signal.mean()
        yield from ((name, "value", x), (name, "square", x**2), (name, "value", x**3))
        if name in outputs:
            rate = np.gradient(x)
            yield from ((name, "rate", np.sign(rate)), (name, "rate", rate * np.abs(rate)))
