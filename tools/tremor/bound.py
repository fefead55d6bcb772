"""The limit: the best causal linear estimator of a signal set, at each horizon (Wiener filter by least squares).

``others``: one filter for all hands of a set but the one it is scored on. ``oracle``: a filter fitted to the very
record that it is scored on, so nothing linear and fixed does better. Filters are sums over the adaptive method's filter
bank, which stands for 0.6 s of taps: tests compare it with plain taps.

Errors are compared as the loop is asked to make them small: through the filter that lifts 8 to 12 Hz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from firmware_py.tremor.adaptive_design import AdaptiveDesign, design_adaptive, solve_scaled
from firmware_py.tremor.config import TremorConfig
from tools.tremor.cases import RATE_HZ, Case

Array = NDArray[np.float64]
EVERY = 5  # samples between the rows of a regression: the bank is far narrower than 100 Hz
SKIP_S = 5.0  # a new hand: adaptation is over


@dataclass(frozen=True)
class _Sums:
    matrix: Array
    right: Array  # (h, m)
    power: float


def bank_features(samples: Array, design: AdaptiveDesign) -> Array:
    """(n, m) features of ``samples`` (n,)."""
    columns: list[Array] = []
    for pole in design.bank.pole:
        z = np.asarray(lfilter([1.0 - abs(pole)], [1.0, -pole], samples.astype(np.complex128)), dtype=np.complex128)
        columns += [z.real, z.imag]
    columns += [np.asarray(lfilter([1.0 - keep], [1.0, -keep], samples)) for keep in design.bank.slow]
    return np.stack([*columns, samples], axis=1)


def lift(x: Array, design: AdaptiveDesign) -> Array:
    """Through the filter that lifts the tremor band, along the first axis."""
    b, a = design.weight[:3], np.concatenate([[1.0], design.weight[3:]])
    return np.asarray(lfilter(b, a, x, axis=0))


def _rows(truth: Array, ticks: int) -> tuple[slice, slice]:
    """Features at t, truth at t + horizon, both after the run-in."""
    first = round(SKIP_S * RATE_HZ)
    return slice(first, len(truth) - ticks, EVERY), slice(first + ticks, len(truth), EVERY)


@dataclass(frozen=True)
class Bounds:
    """Predictions (n, k) of one case, one entry per horizon (ticks); sample t predicts t + horizon."""

    others: dict[int, Array]
    oracle: dict[int, Array]


def wiener_bounds(cases: Sequence[Case], horizons: Sequence[int], config: TremorConfig) -> list[Bounds]:
    """Bounds of every case; hands of the same subject are not trained on. One case alone has no ``others``."""
    design = design_adaptive(config)
    features = [[bank_features(case.samples[:, i], design) for i in range(case.samples.shape[1])] for case in cases]
    sums: list[dict[int, list[_Sums]]] = []
    for case, axes in zip(cases, features, strict=True):
        truth = lift(case.truth, design)
        lifted = [lift(f, design) for f in axes]
        per_horizon: dict[int, list[_Sums]] = {}
        for ticks in horizons:
            at, then = _rows(truth, ticks)
            per_horizon[ticks] = [
                _Sums(f[at].T @ f[at], (f[at].T @ truth[then, i])[None, :], float(np.sum(truth[then, i] ** 2)))
                for i, f in enumerate(lifted)
            ]
        sums.append(per_horizon)
    out: list[Bounds] = []
    for n, case in enumerate(cases):
        others: dict[int, Array] = {}
        oracle: dict[int, Array] = {}
        for ticks in horizons:
            pool = [
                s
                for k, other in enumerate(cases)
                if k != n and other.subject != case.subject
                for s in sums[k][ticks]
                if s.power > 0.0
            ]
            if pool:
                # every hand counts the same, whatever its size
                matrix = np.sum([s.matrix / s.power for s in pool], axis=0)
                right = np.sum([s.right / s.power for s in pool], axis=0)
                row = solve_scaled(matrix, right)[0]
                others[ticks] = np.stack([f @ row for f in features[n]], axis=1)
            own = [solve_scaled(s.matrix, s.right)[0] for s in sums[n][ticks]]
            oracle[ticks] = np.stack([f @ row for f, row in zip(features[n], own, strict=True)], axis=1)
        out.append(Bounds(others, oracle))
    return out
