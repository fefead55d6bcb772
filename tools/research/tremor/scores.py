"""Scores an estimator on a case: how much is left, in which band, how late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import hilbert

from firmware_py.tremor.adaptive_design import AdaptiveDesign
from hal.arrays import Array
from tools.numbers import vector_rms
from tools.reports.figures import TREMOR_BAND_HZ, VOLUNTARY_HZ, band_pass
from tools.research.tremor.bound import SKIP_S, lift
from tools.research.tremor.cases import RATE_HZ, Case, low_pass

_EDGE_S = 1.0  # zero-phase filters and targets are not trusted this close to the end


@dataclass(frozen=True)
class Score:
    """Residuals in percent of the truth's rms, all axes together.

    ``all_percent``: every frequency; ``band_percent``: 8 to 12 Hz; ``lifted_percent``: through the filter that lifts
    that band, which is what the adaptive method and the bound make small. ``delay_ms``: how late the estimate of the
    horizon's instant is, in the tremor band. ``slow_percent``: share of the motion below 1 Hz that is taken for tremor.
    """

    all_percent: float
    band_percent: float
    lifted_percent: float
    delay_ms: float
    slow_percent: float


def _scored(n: int) -> slice:
    return slice(round(SKIP_S * RATE_HZ), n - round(_EDGE_S * RATE_HZ))


def residual(case: Case, ahead: Array, ticks: int) -> Array:
    """(n, k) m: truth at t less what was predicted for it ``ticks`` earlier."""
    late = np.zeros_like(ahead)
    late[ticks:] = ahead[: len(ahead) - ticks]
    return case.truth - late


def score(case: Case, ahead: Array, ticks: int, design: AdaptiveDesign) -> Score:
    """Figures of ``ahead`` (n, k), predictions over ``ticks``, from ``SKIP_S`` to 1 s before the end."""
    keep = _scored(len(ahead))
    left = residual(case, ahead, ticks)
    parts: list[float] = []
    for before, after in (
        (case.truth, left),
        (band_pass(case.truth, RATE_HZ, TREMOR_BAND_HZ), band_pass(left, RATE_HZ, TREMOR_BAND_HZ)),
        (lift(case.truth, design), lift(left, design)),
    ):
        whole = vector_rms(before[keep])
        parts.append(100.0 * vector_rms(after[keep]) / whole if whole > 0.0 else float("nan"))
    return Score(parts[0], parts[1], parts[2], _delay_ms(case, left, keep), _slow_percent(case, ahead, keep))


def _delay_ms(case: Case, left: Array, keep: slice) -> float:
    """Phase between truth and estimate in 8 to 12 Hz, as time at the case's frequency."""
    if not np.isfinite(case.frequency_hz):
        return float("nan")
    truth = np.asarray(hilbert(band_pass(case.truth, RATE_HZ, TREMOR_BAND_HZ), axis=0))[keep]
    estimate = np.asarray(hilbert(band_pass(case.truth - left, RATE_HZ, TREMOR_BAND_HZ), axis=0))[keep]
    angle = np.angle(np.sum(truth * np.conj(estimate)))
    return float(1e3 * angle / (2.0 * np.pi * max(case.frequency_hz, TREMOR_BAND_HZ[0])))


def _slow_percent(case: Case, ahead: Array, keep: slice) -> float:
    """Regression of the estimate on the voluntary path below 1 Hz; nan where that path is not known."""
    if case.slow is None:
        return float("nan")
    path, predicted = (low_pass(x, VOLUNTARY_HZ)[keep] for x in (case.slow, ahead))
    path, predicted = path - path.mean(axis=0), predicted - predicted.mean(axis=0)
    return float(100.0 * abs(np.sum(path * predicted)) / np.sum(path**2))
