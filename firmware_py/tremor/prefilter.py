"""The band-pass in front of the WFLC: elliptic, sixth order, 7-13 Hz (Ang 2004, 5.2.1; erratum 56), unless told
otherwise.

Ripple and attenuation are not printed there; they are parameters here. Its response is known exactly at any
frequency, so phase and gain of its output can be inverted.
"""

from __future__ import annotations

from cmath import exp
from math import pi

import numpy as np
from numpy.typing import NDArray

from firmware_py.designs import design
from firmware_py.tremor.config import WflcConfig
from hal.compiled import kernel

SECTIONS = 3


def prefilter_sections(config: WflcConfig, tick_hz: float) -> NDArray[np.float64]:
    """Return three second-order sections (3, 5): b0 b1 b2 a1 a2. Sections that a lower order does not need have gain
    1."""
    ripple = [config.ripple_dB, config.attenuation_dB] if config.prefilter == "elliptic" else []
    name = "ellip" if config.prefilter == "elliptic" else "butter"
    edges = [config.low_hz, config.high_hz]
    (sos,) = design(name, config.prefilter_order, *ripple, edges, btype="bandpass", output="sos", fs=tick_hz)
    sections = np.tile([1.0, 0.0, 0.0, 0.0, 0.0], (SECTIONS, 1))
    sections[: len(sos)] = sos[:, [0, 1, 2, 4, 5]]
    return sections


def prefilter_response(
    sections: NDArray[np.float64], frequency_hz: NDArray[np.float64], tick_hz: float
) -> NDArray[np.complex128]:
    """Return the complex gain (n,) of ``sections`` (k, 5) at ``frequency_hz`` (n,)."""
    delay = np.exp(-2j * pi * np.asarray(frequency_hz, dtype=np.float64) / tick_hz)
    gain = np.ones_like(delay)
    for b0, b1, b2, a1, a2 in sections:
        gain = gain * (b0 + b1 * delay + b2 * delay**2) / (1.0 + a1 * delay + a2 * delay**2)
    return gain


@kernel
def prefilter_step(x: float, memory: NDArray[np.float64], sections: NDArray[np.float64]) -> float:
    """Filter one sample through the sections; ``memory`` (n, 2), direct form II transposed."""
    for j in range(len(sections)):
        y = sections[j, 0] * x + memory[j, 0]
        memory[j, 0] = sections[j, 1] * x - sections[j, 3] * y + memory[j, 1]
        memory[j, 1] = sections[j, 2] * x - sections[j, 4] * y
        x = y
    return x


@kernel
def prefilter_gain(sections: NDArray[np.float64], omega: float) -> complex:
    """Return the complex gain at ``omega`` rad/sample."""
    z = exp(-1j * omega)
    gain = 1.0 + 0.0j
    for j in range(len(sections)):
        b0, b1, b2, a1, a2 = sections[j, 0], sections[j, 1], sections[j, 2], sections[j, 3], sections[j, 4]
        gain *= (b0 + z * (b1 + z * b2)) / (1.0 + z * (a1 + z * a2))
    return gain
