"""Computes displacement now and ahead by FLC, WFLC and WFLC-FLC, by turning the weights.

The WFLC sees the band-passed samples and gives frequency and phase; the FLC fits sine and cosine of that phase. For an
accelerometer it fits the raw samples (with a bias weight in place of a high-pass, so it adds no phase): voluntary
motion is small there. Displacement holds far more voluntary motion than tremor, so there the FLC fits the band-passed
samples and the prefilter's phase and gain at the tracked frequency are undone as well.
"""

from __future__ import annotations

from cmath import exp
from math import pi, sqrt

from firmware_py.biquads import cascade_step
from firmware_py.records import Records, field, new, record
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.flc import flc_step
from firmware_py.tremor.prefilter import prefilter_gain, prefilter_sections
from firmware_py.tremor.sensor_model import SensorModel, invert_sensor, sensor_params
from firmware_py.tremor.wflc import WflcParams, WflcState, wflc_params, wflc_step
from hal.arrays import Array
from hal.compiled import kernel

TRAILING, OWN, FIXED = 0, 1, 2  # whose weights: WFLC-FLC, WFLC, FLC at the start frequency


@record
class CombinerParams:
    """Holds the parameters of the WFLC and of the FLC that trails it."""

    wflc: WflcParams = field("")
    sensor: SensorModel = field("")
    sections: Array = field("1", 3, 5)  # of the prefilter
    trailing_gain: float = field("1")
    bias_gain: float = field("1")
    behind_prefilter: int = field("1")  # the FLC's input
    weights_of: int = field("1")


@record
class CombinerState:
    """Holds the state of one axis: the WFLC, its prefilter, and the FLC's weights."""

    wflc: WflcState = field("")
    memory: Array = field("sample", 3, 2)  # of the prefilter
    weights: Array = field("sample", 3)  # sine, cosine, bias of the FLC
    fixed_phase: float = field("rad")


def combiner_params(config: TremorConfig) -> Records[CombinerParams]:
    """Return the kernels' parameters."""
    return new(
        CombinerParams,
        wflc=wflc_params(config.wflc, config.tick_hz),
        sensor=sensor_params(config),
        sections=prefilter_sections(config.wflc, config.tick_hz),
        trailing_gain=config.wflc.trailing_gain,
        bias_gain=config.wflc.bias_gain,
        behind_prefilter=int(config.behind_prefilter),
        weights_of={"wflc": OWN, "flc": FIXED}.get(config.method, TRAILING),
    )


def combiner_state(config: TremorConfig) -> Records[CombinerState]:
    """Return one axis' state before the first sample: start frequency, no amplitude."""
    wflc = new(WflcState, omega=2.0 * pi * config.wflc.start_hz / config.tick_hz, miss=1.0)
    return new(CombinerState, wflc=wflc)


@kernel
def combiner_step(sample: float, state: CombinerState, params: CombinerParams) -> None:
    """Process one sample, taken behind the RC filter."""
    in_band = cascade_step(sample, state.memory, params.sections)
    wflc_step(in_band, state.wflc, params.wflc)
    state.fixed_phase = (state.fixed_phase + params.wflc.start) % (2.0 * pi)
    phase = state.fixed_phase if params.weights_of == FIXED else state.wflc.phase
    fitted = in_band if params.behind_prefilter else sample
    flc_step(fitted, phase, state.weights, params.trailing_gain, params.bias_gain)


@kernel
def combiner_coast(state: CombinerState, params: CombinerParams) -> None:
    """Advance one tick without a sample. The phase runs on."""
    state.wflc.phase += state.wflc.omega
    state.fixed_phase += params.wflc.start


@kernel
def combiner_displacement(state: CombinerState, params: CombinerParams, ahead_s: float) -> float:
    """Return the tremor displacement (m) ``ahead_s`` after the last sample: Re[(cosine - j sine) e^(j phase) undo]."""
    omega, phase = state.wflc.omega, state.wflc.phase
    sine, cosine = state.weights[0], state.weights[1]
    filtered = params.behind_prefilter != 0
    if params.weights_of == FIXED:
        omega, phase = params.wflc.start, state.fixed_phase
    elif params.weights_of == OWN:
        size = sqrt(state.wflc.power)
        sine, cosine, filtered = size * state.wflc.sine, size * state.wflc.cosine, True
    phasor = (
        (cosine - 1j * sine) * exp(1j * phase) * invert_sensor(omega * params.sensor.tick_hz, ahead_s, params.sensor)
    )
    if filtered:
        phasor /= prefilter_gain(params.sections, omega)
    return phasor.real
