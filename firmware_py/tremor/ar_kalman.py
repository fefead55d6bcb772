"""Predicts several steps ahead with an autoregressive model behind the band-pass, tracked by a Kalman filter.

The band-passed displacement lags the tip by the phase of all filters before it (RC, integrators, band-pass). Here the
predictor reaches over that lag and over the loop's delay at once: present coefficients are found by predicting the
present value from values one horizon older (direct multi-step, no iterated error). Filter gain is undone.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from firmware_py.records import Array, Integers, Records, field, new, record
from firmware_py.sensing.translation import integrator_sections
from firmware_py.tremor.adaptive_design import sensor_response
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.family import AXES, EstimatorParams, EstimatorState, Family, Samples
from firmware_py.tremor.prefilter import prefilter_response, prefilter_sections, prefilter_step
from hal.compiled import kernel

OUTPUTS = 2
SECTIONS = 5
RING_S = 0.5  # of the longest horizon (one period at 7 Hz and the loop) and the regressor


def chain_sections(config: TremorConfig) -> Array:
    """(5, 5) from sample to band-passed displacement."""
    if config.isolated:
        return np.tile([1.0, 0.0, 0.0, 0.0, 0.0], (SECTIONS, 1))
    band = prefilter_sections(config.wflc, config.tick_hz)
    through = np.tile([1.0, 0.0, 0.0, 0.0, 0.0], (SECTIONS - len(band), 1))
    first = through if config.sees == "displacement" else integrator_sections(config.tick_hz)
    return np.ascontiguousarray(np.vstack([first, band]))


def chain_gain_and_lag(config: TremorConfig) -> tuple[float, float]:
    """Gain and phase lag (s, within one period) from displacement to the predictor's input at the start frequency."""
    hz = np.array([config.wflc.start_hz])
    response = prefilter_response(chain_sections(config), hz, config.tick_hz)[0] * sensor_response(config, hz)[0]
    return float(abs(response)), float((-np.angle(response) % (2.0 * pi)) / (2.0 * pi * hz[0]))


def horizons(config: TremorConfig) -> tuple[int, int]:
    """Return the ticks to predict over the filters' lag, and over lag and loop delay."""
    _, lag_s = chain_gain_and_lag(config)
    return round(lag_s * config.tick_hz), round((lag_s + config.loop_delay_s) * config.tick_hz)


@record
class ArParams:
    """Numbers of the predictors."""

    sections: Array = field("1", SECTIONS, 5)
    scale: float = field("1")
    horizon: Integers = field("1", OUTPUTS)
    spacing: int = field("1")
    walk2: float = field("1")
    noise2: float = field("1")
    smoothing: float = field("1")


@record
class ArState:
    """The band-passed past, and what each predictor has learned from it."""

    memory: Array = field("m", AXES, SECTIONS, 2)
    past: Array = field("m", AXES, "ring")
    power: Array = field("m^2", AXES)
    weights: Array = field("1", AXES, OUTPUTS, "order")
    covariance: Array = field("1", AXES, OUTPUTS, "order", "order")
    gain: Array = field("1", "order")
    regressor: Array = field("m", "order")
    at: int = field("1")


@record
class ArEstimator(EstimatorState):
    """The estimator's state with the predictors'."""

    ar: ArState = field("")


@record
class ArNumbers(EstimatorParams):
    """The estimator's parameters with the predictors'."""

    ar: ArParams = field("")


def ar_params(config: TremorConfig) -> Records[ArParams]:
    """Return the kernels' parameters."""
    gain, _ = chain_gain_and_lag(config)
    return new(
        ArParams,
        sections=chain_sections(config),
        scale=1.0 / gain,
        horizon=horizons(config),
        spacing=max(1, round(config.ar.spacing_s * config.tick_hz)),
        walk2=config.ar.walk**2,
        noise2=config.ar.noise**2,
        smoothing=1.0 / (config.wflc.power_s * config.tick_hz),
    )


def ar_state(config: TremorConfig) -> Records[ArState]:
    """Return the state before the first sample. The first guess of each predictor is zero."""
    sizes = {"ring": round(RING_S * config.tick_hz), "order": config.ar.order}
    return new(ArState, sizes, covariance=np.eye(config.ar.order))


@kernel
def ar_tick(coasts: bool, states: ArEstimator, param: ArNumbers) -> None:
    """Advance one tick without a sample. The last prediction of the present stands in for it."""
    state = states.ar
    ring = state.past.shape[1]
    before = state.at
    state.at = (before + 1) % ring
    for i in range(AXES):
        state.past[i, state.at] = state.past[i, before]


@kernel
def _correct(state: ArState, axis: int, sample: float, params: ArParams) -> None:
    """Process the present tick's sample, after ``ar_tick``: run the filters, then let both predictors learn."""
    x = prefilter_step(sample, state.memory[axis], params.sections)
    state.past[axis, state.at] = x
    state.power[axis] += params.smoothing * (x * x - state.power[axis])
    if state.power[axis] <= 0.0:
        return
    unit = 1.0 / sqrt(state.power[axis])
    r, k = state.regressor, state.gain
    p = len(r)
    for o in range(OUTPUTS):
        _regressor(state, axis, params.horizon[o], params.spacing)
        w, c = state.weights[axis, o], state.covariance[axis, o]
        error, spread = x * unit, params.noise2
        for i in range(p):
            r[i] *= unit
            error -= w[i] * r[i]
        for i in range(p):
            c[i, i] += params.walk2
        for i in range(p):
            k[i] = 0.0
            for j in range(p):
                k[i] += c[i, j] * r[j]
            spread += k[i] * r[i]
        for i in range(p):
            w[i] += k[i] / spread * error
            for j in range(i + 1):
                c[i, j] -= k[i] * k[j] / spread
                c[j, i] = c[i, j]


@kernel
def _regressor(state: ArState, axis: int, back: int, spacing: int) -> None:
    ring = state.past.shape[1]
    for i in range(len(state.regressor)):
        state.regressor[i] = state.past[axis, (state.at - back - i * spacing) % ring]


@kernel
def _predicted(state: ArState, axis: int, output: int, params: ArParams) -> float:
    _regressor(state, axis, 0, params.spacing)
    total = 0.0
    for i in range(len(state.regressor)):
        total += state.weights[axis, output, i] * state.regressor[i]
    return total * params.scale


@kernel
def ar_sample(samples: Samples, states: ArEstimator, param: ArNumbers) -> None:
    """Process the samples of the present tick."""
    for i in range(AXES):
        _correct(states.ar, i, samples.tip[i], param.ar)


@kernel
def ar_output(axis: int, states: ArEstimator, param: ArNumbers) -> tuple[float, float, float]:
    """Return the tremor now and over the loop's delay, twice, m."""
    ahead = _predicted(states.ar, axis, 1, param.ar)
    return _predicted(states.ar, axis, 0, param.ar), ahead, ahead


AUTOREGRESSIVE = Family(ArNumbers, ArEstimator, ar_params, ar_state, ar_tick, ar_sample, ar_output)
