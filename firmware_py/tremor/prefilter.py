"""Designs the band-pass in front of the WFLC. The default is elliptic, sixth order, 7-13 Hz (Ang 2004, 5.2.1; erratum
56).

Ripple and attenuation are not printed there; they are parameters here. Its response is known exactly at any
frequency, so phase and gain of its output can be inverted.
"""

from __future__ import annotations

from cmath import exp

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


@kernel
def prefilter_gain(sections: NDArray[np.float64], omega: float) -> complex:
    """Return the complex gain at ``omega`` rad/sample."""
    z = exp(-1j * omega)
    gain = 1.0 + 0.0j
    for j in range(len(sections)):
        b0, b1, b2, a1, a2 = sections[j, 0], sections[j, 1], sections[j, 2], sections[j, 3], sections[j, 4]
        gain *= (b0 + z * (b1 + z * b2)) / (1.0 + z * (a1 + z * a2))
    return gain
