"""A drive from which all of a stack's model is identified."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def excitation_V(
    rate_hz: float, seconds: float = 40.0, centre_V: float = 50.0, low_V: float = 0.0
) -> NDArray[np.float64]:
    """A drive that identifies all of the model: two full sweeps, full cycles at 20 Hz, then 10 Hz loops that
    shrink from full range to 2 V four times, with a slow wander of their centre."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    half = centre_V - low_V
    sweep_s, fast_s = 0.1 * seconds, 0.04 * seconds
    sweep = half * (1.0 - np.cos(4.0 * np.pi * t / sweep_s))
    fast = half * (1.0 - np.cos(40.0 * np.pi * (t - sweep_s)))
    rest = t - sweep_s - fast_s
    size = half * np.exp(-np.log(half) * ((rest * 4.0 / (seconds - sweep_s - fast_s)) % 1.0))
    loops = half + size * np.sin(2.0 * np.pi * 10.0 * rest)
    loops += 0.9 * (half - size) * np.sin(2.0 * np.pi * 0.31 * rest)
    drive = np.where(t < sweep_s, sweep, np.where(rest < 0.0, fast, loops))
    return low_V + np.clip(drive, 0.0, 2.0 * half)
