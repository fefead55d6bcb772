"""Fits a Fourier linear combiner with a bias weight at a given phase (Ang 2004 (5.11), (5.12))."""

from __future__ import annotations

from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel


@kernel
def flc_step(signal: float, phase: float, weights: NDArray[np.float64], weight_gain: float, bias_gain: float) -> None:
    """Make one LMS step of ``weights`` (sine, cosine, bias) on ``signal``, in the signal's unit.

    The weights settle with 1 / weight_gain samples (erratum 52).
    """
    s = sin(phase)
    c = cos(phase)
    error = signal - weights[0] * s - weights[1] * c - weights[2]
    weights[0] += 2.0 * weight_gain * s * error
    weights[1] += 2.0 * weight_gain * c * error
    weights[2] += 2.0 * bias_gain * error
