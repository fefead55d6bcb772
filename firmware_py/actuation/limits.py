"""Limits voltage and slew. What the limits hold back is always reported."""

from __future__ import annotations

from hal.compiled import kernel


@kernel
def limit_voltage(wanted_V: float, low_V: float, high_V: float) -> float:
    return max(low_V, min(high_V, wanted_V))


@kernel
def limit_slew(wanted_V: float, previous_V: float, step_V: float) -> float:
    """Return ``wanted_V``, limited to at most ``step_V`` from ``previous_V``."""
    return max(previous_V - step_V, min(previous_V + step_V, wanted_V))
