"""Tracks the tremor's frequency by a weighted-frequency Fourier linear combiner (Ang 2004 (5.6)-(5.10), errata 51-56).

The input is divided by the square root of its own smoothed power, so the gains hold for 5 um and for 500 um.
Frequency is limited to the band, amplitude weights leak a little towards zero. It is locked while the combiner explains
most of the band-passed signal.
"""

from __future__ import annotations

from math import cos, exp, pi, sin, sqrt

from firmware_py.records import Records, field, new, record
from firmware_py.tremor.config import WflcConfig
from hal.compiled import kernel


@record
class WflcParams:
    """Holds the parameters of the combiner that tracks the frequency."""

    start: float = field("rad/sample")
    low: float = field("rad/sample")
    high: float = field("rad/sample")
    frequency_gain: float = field("1")
    weight_gain: float = field("1")
    keep: float = field("1")  # 1 - leakage
    power_smoothing: float = field("1")


@record
class WflcState:
    """Holds frequency, phase and weights of the combiner."""

    omega: float = field("rad/sample")
    phase: float = field("rad")  # running sum of omega, within 2 pi
    sine: float = field("1")
    cosine: float = field("1")
    power: float = field("sample^2")
    miss: float = field("1")  # smoothed error^2 of the normalised signal: 0 locked .. 1 nothing explained


def wflc_params(config: WflcConfig, tick_hz: float) -> Records[WflcParams]:
    """Return the kernel's parameters."""
    per_sample = 2.0 * pi / tick_hz
    return new(
        WflcParams,
        start=config.start_hz * per_sample,
        low=config.low_hz * per_sample,
        high=config.high_hz * per_sample,
        frequency_gain=config.frequency_gain,
        weight_gain=config.weight_gain,
        keep=1.0 - config.leakage,
        power_smoothing=1.0 - exp(-1.0 / (config.power_s * tick_hz)),
    )


@kernel
def wflc_step(signal: float, state: WflcState, params: WflcParams) -> None:
    """Process one sample of the band-passed signal, any unit: advance phase, weights and frequency.

    The frequency step follows -d(error^2)/d(omega) with the phase as a running sum (erratum 53).
    """
    state.phase = (state.phase + state.omega) % (2.0 * pi)
    state.power += params.power_smoothing * (signal * signal - state.power)
    if state.power <= 0.0:
        return
    s = sin(state.phase)
    c = cos(state.phase)
    # a transient far above the smoothed power must not throw the frequency
    normal = max(-3.0, min(3.0, signal / sqrt(state.power)))
    error = normal - state.sine * s - state.cosine * c
    state.miss += params.power_smoothing * (error * error - state.miss)
    omega = state.omega + 2.0 * params.frequency_gain * error * (state.sine * c - state.cosine * s)
    state.omega = max(params.low, min(params.high, omega))
    state.sine = params.keep * state.sine + 2.0 * params.weight_gain * s * error
    state.cosine = params.keep * state.cosine + 2.0 * params.weight_gain * c * error
