"""The limit: the best causal linear estimator of a signal set, at each horizon (Wiener filter by least squares).

``others``: one filter for all hands but the one it is scored on. ``oracle``: a filter fitted to the very record that it
is scored on, so nothing linear and fixed does better. ``unseen``: fitted to that record but for the second that it is
scored on, in turn for every second; where it leaves much more than the oracle, the oracle has learned its own second by
heart: the bank has 24 weights an axis, and a swing of 3 s is not many more independent values. Filters are sums over
the adaptive method's filter bank, which stands for 0.6 s of taps: tests compare it with plain taps.

Errors are compared as the loop is asked to make them small: through the filter that lifts 8 to 12 Hz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from firmware_py.tremor.adaptive_design import AdaptiveDesign, design_adaptive, solve_scaled
from firmware_py.tremor.config import TremorConfig
from hal.arrays import Array
from tools.research.tremor.cases import RATE_HZ, Case

EVERY = 5  # samples between the rows of a regression: the bank is far narrower than 100 Hz
SKIP_S = 5.0  # a new hand: adaptation is over


@dataclass(frozen=True)
class _Sums:
    """Holds sums of an axis at a horizon; the first axis counts the seconds."""

    matrix: Array  # (s, m, m)
    right: Array  # (s, m)
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


def _sums(features: Array, truth: Array, ticks: int) -> _Sums:
    """Features (n, m) at t, truth (n,) at t + horizon, both after the run-in."""
    matrix: list[Array] = []
    right: list[Array] = []
    power = 0.0
    for start, stop in _seconds(len(truth)):
        at = features[start : min(stop, len(truth) - ticks) : EVERY]
        then = truth[start + ticks : stop + ticks : EVERY]
        matrix.append(at.T @ at)
        right.append(at.T @ then)
        power += float(np.sum(then**2))
    return _Sums(np.stack(matrix), np.stack(right), power)


def _seconds(n: int) -> list[tuple[int, int]]:
    """First and last sample (exclusive) of every second after the run-in; the last one may be up to 2 s long."""
    second = round(RATE_HZ)
    starts = list(range(round(SKIP_S * RATE_HZ), max(n - second, round(SKIP_S * RATE_HZ) + 1), second))
    return list(zip(starts, [*starts[1:], n], strict=True))


@dataclass(frozen=True)
class Bounds:
    """Predictions (n, k) of one case, one entry per horizon (ticks); sample t predicts t + horizon."""

    others: dict[int, Array]
    oracle: dict[int, Array]
    unseen: dict[int, Array]


def wiener_bounds(
    cases: Sequence[Case],
    horizons: Sequence[int],
    config: TremorConfig,
    elsewhere: Sequence[Case] = (),
    *,
    lifted: bool = True,
) -> list[Bounds]:
    """Bounds of every case; hands of the same subject are not trained on. ``lifted`` False: for the plain error.

    ``elsewhere``: hands of other sets, which stand in where ``cases`` are of one subject. Without them there are no
    ``others`` of such a set.
    """
    design = design_adaptive(config)
    features = [_features(case, design) for case in cases]
    sums = [_all_sums(case, f, horizons, design if lifted else None) for case, f in zip(cases, features, strict=True)]
    far = list(elsewhere) if len({case.subject for case in cases}) == 1 else []
    far_sums = [_all_sums(case, _features(case, design), horizons, design if lifted else None) for case in far]
    out: list[Bounds] = []
    for n, case in enumerate(cases):
        bounds = Bounds({}, {}, {})
        for ticks in horizons:
            pool = [
                s
                for other, of_other in zip([*cases, *far], [*sums, *far_sums], strict=True)
                if other.subject != case.subject
                for s in of_other[ticks]
                if s.power > 0.0
            ]
            if pool:
                # every hand counts the same, whatever its size
                matrix = np.sum([np.sum(s.matrix, axis=0) / s.power for s in pool], axis=0)
                right = np.sum([np.sum(s.right, axis=0) / s.power for s in pool], axis=0)
                row = solve_scaled(matrix, right[None, :])[0]
                bounds.others[ticks] = np.stack([f @ row for f in features[n]], axis=1)
            bounds.oracle[ticks], bounds.unseen[ticks] = _own(features[n], sums[n][ticks])
        out.append(bounds)
    return out


def _features(case: Case, design: AdaptiveDesign) -> list[Array]:
    return [bank_features(case.samples[:, i], design) for i in range(case.samples.shape[1])]


def _all_sums(
    case: Case, features: Sequence[Array], horizons: Sequence[int], design: AdaptiveDesign | None
) -> dict[int, list[_Sums]]:
    """``design`` None: nothing is lifted."""
    truth = case.truth if design is None else lift(case.truth, design)
    lifted = list(features) if design is None else [lift(f, design) for f in features]
    return {ticks: [_sums(f, truth[:, i], ticks) for i, f in enumerate(lifted)] for ticks in horizons}


def _own(features: Sequence[Array], sums: Sequence[_Sums]) -> tuple[Array, Array]:
    """Predictions (n, k) of the oracle, and of filters that have not seen the second they serve."""
    seen, unseen = (np.zeros((len(features[0]), len(features))) for _ in range(2))
    seconds = _seconds(len(features[0]))
    for i, (f, s) in enumerate(zip(features, sums, strict=True)):
        matrix, right = np.sum(s.matrix, axis=0), np.sum(s.right, axis=0)
        seen[:, i] = f @ solve_scaled(matrix, right[None, :])[0]
        unseen[:, i] = seen[:, i]
        if len(seconds) < 2:
            continue
        for n, (start, stop) in enumerate(seconds):
            left = solve_scaled(matrix - s.matrix[n], (right - s.right[n])[None, :])[0]
            unseen[start:stop, i] = f[start:stop] @ left
    return seen, unseen
