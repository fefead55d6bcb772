"""Filters samples through second-order sections, and states the response of such a filter.

A section is the row b0 b1 b2 a1 a2 of z^-1, with a0 = 1. Its memory is two numbers, zero at the start (direct form II
transposed).
"""

from __future__ import annotations

from math import pi

import numpy as np

from hal.arrays import Array, ComplexArray
from hal.compiled import kernel


@kernel
def biquad_step(sample: float, memory: Array, section: Array) -> float:
    """Filter one sample through one ``section`` (5,) with its ``memory`` (2,)."""
    out = section[0] * sample + memory[0]
    memory[0] = section[1] * sample - section[3] * out + memory[1]
    memory[1] = section[2] * sample - section[4] * out
    return out


@kernel
def cascade_step(sample: float, memory: Array, sections: Array) -> float:
    """Filter one sample through ``sections`` (n, 5), one after the other, with their ``memory`` (n, 2)."""
    for j in range(len(sections)):
        sample = biquad_step(sample, memory[j], sections[j])
    return sample


def cascade_response(sections: Array, frequency_hz: Array, tick_hz: float) -> ComplexArray:
    """Return the complex gain (k,) of ``sections`` (n, 5) at ``frequency_hz`` (k,)."""
    delay = np.exp(-2j * pi * np.asarray(frequency_hz, dtype=np.float64) / tick_hz)
    gain = np.ones_like(delay)
    for b0, b1, b2, a1, a2 in sections:
        gain = gain * (b0 + b1 * delay + b2 * delay**2) / (1.0 + a1 * delay + a2 * delay**2)
    return gain
