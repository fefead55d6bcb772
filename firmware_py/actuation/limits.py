"""Limits of voltage and slew; what they hold back is reported, never silent."""

from __future__ import annotations

from hal.compiled import kernel


@kernel
def limit_voltage(wanted_V: float, low_V: float, high_V: float) -> float:
    return max(low_V, min(high_V, wanted_V))


@kernel
def limit_slew(wanted_V: float, previous_V: float, step_V: float) -> float:
    """``wanted_V``, but no further from ``previous_V`` than ``step_V``."""
    return max(previous_V - step_V, min(previous_V + step_V, wanted_V))
