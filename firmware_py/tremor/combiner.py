"""WFLC-FLC on tip acceleration: displacement now and ahead, by turning the weights.

The WFLC sees the band-passed acceleration and gives frequency and phase; the FLC fits sine and cosine of that
phase to the raw acceleration (with a bias weight in place of a high-pass, so it adds no phase). Amplitude and
phase of RC filter, double integration and loop delay at the tracked frequency are one complex number, which
turns the FLC's weights into displacement.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np

from firmware_py.records import Record, new_record
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.flc import flc_step
from firmware_py.tremor.prefilter import prefilter_sections, prefilter_step
from firmware_py.tremor.wflc import WFLC, WFLC_STATE, wflc_params, wflc_step
from hal.compiled import kernel

COMBINER = np.dtype(
    [
        ("wflc", WFLC),
        ("sections", "f8", (3, 5)),
        ("trailing_gain", "f8"),
        ("bias_gain", "f8"),
        ("tick_hz", "f8"),
        ("cutoff_rad_s", "f8"),
        ("delay_s", "f8"),
    ]
)
COMBINER_STATE = np.dtype(
    [
        ("wflc", WFLC_STATE),
        ("memory", "f8", (3, 2)),  # of the prefilter
        ("weights", "f8", (3,)),  # sine, cosine, bias of the acceleration, m/s^2
    ]
)


def combiner_params(config: TremorConfig) -> Record:
    """The kernels' numbers (dtype ``COMBINER``)."""
    return new_record(
        COMBINER,
        wflc=wflc_params(config.wflc, config.tick_hz),
        sections=prefilter_sections(config.wflc, config.tick_hz),
        trailing_gain=config.wflc.trailing_gain,
        bias_gain=config.wflc.bias_gain,
        tick_hz=config.tick_hz,
        cutoff_rad_s=config.filter_cutoff_rad_s,
        delay_s=config.loop_delay_s,
    )


@kernel
def combiner_step(acceleration: float, state: Record, params: Record) -> None:
    """One sample of the tip's acceleration m/s^2, behind the RC filter."""
    wflc_step(prefilter_step(acceleration, state.memory, params.sections), state.wflc, params.wflc)
    flc_step(acceleration, state.wflc.phase, state.weights, params.trailing_gain, params.bias_gain)


@kernel
def combiner_coast(state: Record) -> None:
    """One tick without a sample: the phase runs on."""
    state.wflc.phase += state.wflc.omega


@kernel
def combiner_displacement(state: Record, params: Record, ahead_s: float) -> float:
    """Tremor displacement m at ``ahead_s`` after the last sample.

    x = Re[W e^(j phase) G], W = cosine - j sine, G = -e^(j w t) (1 + j w / cutoff) / w^2.
    """
    w = state.wflc.omega * params.tick_hz
    lag = w / params.cutoff_rad_s
    size = -sqrt(1.0 + lag * lag) / (w * w)
    angle = state.wflc.phase + atan2(lag, 1.0) + w * ahead_s
    return size * (state.weights[1] * cos(angle) + state.weights[0] * sin(angle))
