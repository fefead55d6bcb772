"""A stable inverse of what follows the hysteresis (amplifier lag, resonance), with preview: 000 sec. 7.5, 5.1.

The exact inverse of a sampled resonance is not stable (zeros outside the unit circle). A short FIR filter that may look
a little ahead is, always: its taps are the least squares that make taps x response = 1 over the tremor's band, with a
penalty on gain beyond it. How far it looks ahead is a number of seconds that the tremor predictor must reach.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def design_feedforward(
    response: Array, dt: float, preview_s: float, taps: int = 6, band_hz: float = 60.0, penalty: float = 0.03
) -> Array:
    """(taps,) weights on the wanted extension at ``preview_s`` from now, one tick earlier, ...

    ``response``: (n,) weights of the levels held m ticks ago in what counts now. Every frequency up to ``band_hz``
    weighs the same; ``penalty`` keeps the gain above ``band_hz`` near one. The gain at rest is exactly one.
    """
    inside = np.linspace(0.0, band_hz, 61)
    outside = np.linspace(band_hz, 0.5 / dt, 61)
    hz = np.concatenate([inside, outside])
    weight = np.concatenate([np.ones(61), np.full(61, penalty)])
    z = np.exp(-2j * np.pi * hz * dt)
    plant = np.polynomial.polynomial.polyval(z, response / response.sum())
    # taps on x(t + preview - k dt); the plant adds its own lag; wanted: x(t)
    matrix = (plant * np.exp(2j * np.pi * hz * preview_s))[:, None] * z[:, None] ** np.arange(taps)
    # the last tap is one minus the others
    free = matrix[:, :-1] - matrix[:, -1:]
    target = 1.0 - matrix[:, -1]
    a = np.concatenate([free.real, free.imag]) * np.tile(weight, 2)[:, None]
    b = np.concatenate([target.real, target.imag]) * np.tile(weight, 2)
    found = np.linalg.lstsq(a, b, rcond=None)[0]
    return np.concatenate([found, [1.0 - found.sum()]])


def tracking_gain(taps: Array, response: Array, dt: float, preview_s: float, hz: Array) -> NDArray[np.complex128]:
    """(n,) complex ratio of what comes out to what was wanted at ``hz``: 1 is perfect."""
    z = np.exp(-2j * np.pi * hz * dt)
    plant = np.polynomial.polynomial.polyval(z, response / response.sum())
    return np.polynomial.polynomial.polyval(z, taps) * plant * np.exp(2j * np.pi * hz * preview_s)
