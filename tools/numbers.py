"""Figures of a signal that several tools need."""

from __future__ import annotations

import sys
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray


def is_finite_number(value: object) -> TypeGuard[int | float]:
    """Return True for a number that a float can hold: no truth value, no nan, no integer of hundreds of digits."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def rms(values: NDArray[np.float64]) -> float:
    """Return the root of the mean square of all ``values``, in their unit; 0 without any."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0


def vector_rms(vectors: NDArray[np.float64]) -> float:
    """Return the root of the mean square length of ``vectors`` (n, k), in their unit."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
