"""Instrument noise of known rms: white, coloured, heavy-tailed, quantised."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from hal.arrays import Array
from tools.research.prove.forms_memory import Rng

KINDS = ("white", "coloured", "heavy_tailed", "quantised")


def draw(rng: Rng, kind: str, n: int, rms: float) -> Array:
    """Noise of shape (n,) whose expected rms is ``rms``; 'quantised' is white here, the rounding comes last."""
    if kind == "coloured":
        rho = rng.uniform(0.5, 0.95)
        white_share = rng.uniform(0.3, 0.8)
        slow = lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], rng.normal(size=n + 2000))[2000:]
        return rms * (np.sqrt(white_share) * rng.normal(size=n) + np.sqrt(1 - white_share) * slow)
    if kind == "heavy_tailed":
        dof = rng.uniform(3.5, 6.0)
        return rms * rng.standard_t(dof, n) * np.sqrt((dof - 2.0) / dof)
    return rms * rng.normal(size=n)


def rounding_step(rng: Rng, rms: float) -> tuple[float, float]:
    """(step, rms of the noise with the rounding) of a converter a little coarser than is good."""
    step = rms * rng.uniform(0.5, 1.3)
    return step, float(np.hypot(rms, step / np.sqrt(12.0)))
