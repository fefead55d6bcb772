"""Figures of a signal that several tools need."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rms(values: NDArray[np.float64]) -> float:
    """Return the root of the mean square of all ``values``, in their unit; 0 without any."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0
