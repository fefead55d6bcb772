"""Computes displacement now and ahead by FLC, WFLC and WFLC-FLC, by turning the weights.

The WFLC sees the band-passed samples and gives frequency and phase; the FLC fits sine and cosine of that phase. For an
accelerometer it fits the raw samples (with a bias weight in place of a high-pass, so it adds no phase): voluntary
motion is small there. Displacement holds far more voluntary motion than tremor, so there the FLC fits the band-passed
samples and the prefilter's phase and gain at the tracked frequency are undone as well.
"""

from __future__ import annotations

from cmath import exp
from math import pi, sqrt

import numpy as np

from firmware_py.records import Record, new_record
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.flc import flc_step
from firmware_py.tremor.prefilter import prefilter_gain, prefilter_sections, prefilter_step
from firmware_py.tremor.seen import SEEN, seen_params, undo
from firmware_py.tremor.wflc import WFLC, WFLC_STATE, wflc_params, wflc_step
from hal.compiled import kernel

TRAILING, OWN, FIXED = 0, 1, 2  # whose weights: WFLC-FLC, WFLC, FLC at the start frequency

COMBINER = np.dtype(
    [
        ("wflc", WFLC),
        ("seen", SEEN),
        ("sections", "f8", (3, 5)),
        ("trailing_gain", "f8"),
        ("bias_gain", "f8"),
        ("behind_prefilter", "i8"),  # the FLC's input
        ("weights_of", "i8"),
    ]
)
COMBINER_STATE = np.dtype(
    [
        ("wflc", WFLC_STATE),
        ("memory", "f8", (3, 2)),  # of the prefilter
        ("weights", "f8", (3,)),  # sine, cosine, bias of the FLC, in the sample's unit
        ("fixed_phase", "f8"),
    ]
)


def combiner_params(config: TremorConfig) -> Record:
    """Return the kernels' parameters (dtype ``COMBINER``)."""
    return new_record(
        COMBINER,
        wflc=wflc_params(config.wflc, config.tick_hz),
        seen=seen_params(config),
        sections=prefilter_sections(config.wflc, config.tick_hz),
        trailing_gain=config.wflc.trailing_gain,
        bias_gain=config.wflc.bias_gain,
        behind_prefilter=int(config.behind_prefilter),
        weights_of={"wflc": OWN, "flc": FIXED}.get(config.method, TRAILING),
    )


def combiner_state(config: TremorConfig) -> Record:
    """Return the state before the first sample: start frequency, no amplitude."""
    wflc = new_record(WFLC_STATE, omega=2.0 * pi * config.wflc.start_hz / config.tick_hz, miss=1.0)
    return new_record(COMBINER_STATE, wflc=wflc)


@kernel
def combiner_step(sample: float, state: Record, params: Record) -> None:
    """Process one sample, taken behind the RC filter."""
    in_band = prefilter_step(sample, state.memory, params.sections)
    wflc_step(in_band, state.wflc, params.wflc)
    state.fixed_phase = (state.fixed_phase + params.wflc.start) % (2.0 * pi)
    phase = state.fixed_phase if params.weights_of == FIXED else state.wflc.phase
    fitted = in_band if params.behind_prefilter else sample
    flc_step(fitted, phase, state.weights, params.trailing_gain, params.bias_gain)


@kernel
def combiner_coast(state: Record, params: Record) -> None:
    """Advance one tick without a sample. The phase runs on."""
    state.wflc.phase += state.wflc.omega
    state.fixed_phase += params.wflc.start


@kernel
def combiner_displacement(state: Record, params: Record, ahead_s: float) -> float:
    """Return the tremor displacement (m) ``ahead_s`` after the last sample: Re[(cosine - j sine) e^(j phase) undo]."""
    omega, phase = state.wflc.omega, state.wflc.phase
    sine, cosine = state.weights[0], state.weights[1]
    filtered = params.behind_prefilter != 0
    if params.weights_of == FIXED:
        omega, phase = params.wflc.start, state.fixed_phase
    elif params.weights_of == OWN:
        size = sqrt(state.wflc.power)
        sine, cosine, filtered = size * state.wflc.sine, size * state.wflc.cosine, True
    phasor = (cosine - 1j * sine) * exp(1j * phase) * undo(omega * params.seen.tick_hz, ahead_s, params.seen)
    if filtered:
        phasor /= prefilter_gain(params.sections, omega)
    return phasor.real
