"""Limits of stroke, voltage and slew; what they hold back is reported, never silent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel


@kernel
def reach_scale(strokes: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Largest factor <= 1 that brings every stroke (m from neutral) into its range, low < 0 < high.

    A stroke within 1e-9 of its range beyond the border counts as inside; one that is not finite gives 0.
    """
    scale = 1.0
    for i in range(3):
        if not np.isfinite(strokes[i]):
            return 0.0
        if strokes[i] > high[i] * (1.0 + 1e-9):
            scale = min(scale, high[i] / strokes[i])
        elif strokes[i] < low[i] * (1.0 + 1e-9):
            scale = min(scale, low[i] / strokes[i])
    return scale


@kernel
def limit_voltage(wanted_V: float, low_V: float, high_V: float) -> float:
    return max(low_V, min(high_V, wanted_V))


@kernel
def limit_slew(wanted_V: float, previous_V: float, step_V: float) -> float:
    """``wanted_V``, but no further from ``previous_V`` than ``step_V``."""
    return max(previous_V - step_V, min(previous_V + step_V, wanted_V))
