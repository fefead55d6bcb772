"""Measures how the offset of an axis follows the chip's temperature (Erat 2018, 5.2.3 and 5.3.3), and what a line takes
away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tools.imu.series import Array

Verdict = Literal["flat", "linear", "nonlinear", "two points only"]
BIN_K = 1.0
BLOCK_S = 5.0
SMALLEST_SPAN_K = 5.0
LINEAR_SHARE = 0.1
"""A straight line may miss the binned offsets by this much of what the offset changed by, and still be a line."""


@dataclass(frozen=True)
class Thermal:
    """Holds one axis: slope per K with its 95 % interval, and ``change`` of the offset over ``span_K``.

    ``misfit`` is the largest deviation of the binned offsets from the straight line. ``before`` and ``after`` are the
    rms of the slow part (5 s means) about its value at the mean temperature: after compensation by a line that was
    fitted to the other half of the blocks (every second one).
    """

    slope: float
    low: float
    high: float
    span_K: float
    change: float
    misfit: float
    before: float
    after: float
    verdict: Verdict

    @property
    def compensable(self) -> bool:
        """Return True if the straight line removes at least half of the drift on held-out blocks."""
        return self.after < 0.5 * self.before


def thermal(value: Array, temperature_C: Array, rate_hz: float, flat: float) -> Thermal | None:
    """Fit ``value`` (n,) of a motionless axis against ``temperature_C`` (n,). Return None below a span of 5 K.

    ``flat``: a change over the whole span that is too small to matter, in the unit of ``value``.
    """
    blocks = max(4, round(len(value) / rate_hz / BLOCK_S))
    v = np.array([part.mean() for part in np.array_split(value, blocks)])
    t = np.array([part.mean() for part in np.array_split(temperature_C, blocks)])
    span = float(np.ptp(t))
    if span < SMALLEST_SPAN_K:
        return None
    slope, _, error = _line(t, v)
    bins = _bins(t, v)
    line = np.polyfit(bins[:, 0], bins[:, 1], 1)
    misfit = float(np.max(np.abs(bins[:, 1] - np.polyval(line, bins[:, 0]))))
    change = float(np.ptp(bins[:, 1]))
    even, odd = slice(0, None, 2), slice(1, None, 2)
    left = []
    for fit, test in ((even, odd), (odd, even)):
        a, b, _ = _line(t[fit], v[fit])
        left.append(v[test] - (a * t[test] + b))
    rest = np.concatenate(left)
    return Thermal(
        slope=slope,
        low=slope - 1.96 * error,
        high=slope + 1.96 * error,
        span_K=span,
        change=change,
        misfit=misfit,
        before=float(np.std(v)),
        after=float(np.sqrt(np.mean(rest**2))),
        verdict=_verdict(bins[:, 0], change, misfit, flat),
    )


def _verdict(t: NDArray[np.float64], change: float, misfit: float, flat: float) -> Verdict:
    if change < flat:
        return "flat"
    # a gap of more than half of the span: nothing was seen of what lies between
    if np.max(np.diff(t)) > 0.5 * np.ptp(t):
        return "two points only"
    return "linear" if misfit <= LINEAR_SHARE * change else "nonlinear"


def _line(t: Array, v: Array) -> tuple[float, float, float]:
    """Slope, intercept, standard error of the slope (neighbouring blocks taken as independent)."""
    a, b = np.polyfit(t, v, 1)
    left = v - (a * t + b)
    error = np.sqrt(np.sum(left**2) / max(1, len(t) - 2) / np.sum((t - t.mean()) ** 2))
    return float(a), float(b), float(error)


def _bins(t: Array, v: Array) -> Array:
    """Return the mean temperature and value (m, 2) of each kelvin that was visited."""
    index = np.floor((t - t.min()) / BIN_K).astype(int)
    return np.array([[t[index == i].mean(), v[index == i].mean()] for i in np.unique(index)])
