"""A stable inverse of what follows the hysteresis (amplifier lag, resonance), with preview: Ang 2004 sec. 7.5, 5.1.

The exact inverse of a sampled resonance is not stable (zeros outside the unit circle). A short FIR filter that may look
a little ahead is, always: its taps are the least squares that make taps x answer = 1 over the tremor's band, with a
penalty on gain beyond it. How far it looks ahead is a number of seconds that the tremor predictor must reach.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.arrays import Array, ComplexArray

Answer = Callable[[Array], ComplexArray]
"""(n,) complex gain from demands that are held for a tick to the stroke, at (n,) Hz; 1 at rest."""


def design_feedforward(
    answer: Answer, dt: float, preview_s: float, taps: int = 6, band_hz: float = 40.0, penalty: float = 1e-3
) -> Array:
    """(taps,) weights on the wanted stroke at ``preview_s`` from now, one tick earlier, ...

    Every frequency up to ``band_hz`` weighs the same. ``penalty`` weighs the taps' own gain beyond: they must not raise
    the noise of what is wanted. The gain at rest is exactly one.
    """
    inside: Array = np.linspace(0.0, band_hz, 61)
    outside: Array = np.linspace(band_hz, 0.5 / dt, 61)
    k = np.arange(taps)
    # taps on x(t + preview - k dt); what follows adds its own lag; wanted: x(t)
    track = (answer(inside) * np.exp(2j * np.pi * inside * preview_s))[:, None]
    track = track * np.exp(-2j * np.pi * inside[:, None] * k * dt)
    noise = penalty * np.exp(-2j * np.pi * outside[:, None] * k * dt)
    matrix = np.concatenate([track, noise])
    wanted = np.concatenate([np.ones(61), np.zeros(61)])
    # the last tap is one minus the others
    free = matrix[:, :-1] - matrix[:, -1:]
    target = wanted - matrix[:, -1]
    a = np.concatenate([free.real, free.imag])
    b = np.concatenate([target.real, target.imag])
    found = np.linalg.lstsq(a, b, rcond=None)[0]
    return np.concatenate([found, [1.0 - found.sum()]])


def tracking_gain(taps: Array, answer: Answer, dt: float, preview_s: float, hz: Array) -> ComplexArray:
    """(n,) complex ratio of what comes out to what was wanted at ``hz``: 1 is perfect."""
    z = np.exp(-2j * np.pi * hz * dt)
    return np.polynomial.polynomial.polyval(z, taps) * answer(hz) * np.exp(2j * np.pi * hz * preview_s)
