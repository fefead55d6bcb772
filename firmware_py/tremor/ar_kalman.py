"""Predicts several steps ahead with an autoregressive model behind the band-pass, tracked by a Kalman filter.

The band-passed displacement lags the tip by the phase of all filters before it (RC, integrators, band-pass). Here the
predictor reaches over that lag and over the loop's delay at once: present coefficients are found by predicting the
present value from values one horizon older (direct multi-step, no iterated error). Filter gain is undone.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, new_record
from firmware_py.sensing.translation import integrator_sections
from firmware_py.tremor.adaptive_design import sensor_response
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.prefilter import prefilter_response, prefilter_sections, prefilter_step
from hal.compiled import kernel

Array = NDArray[np.float64]
AXES = 3
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


AR = np.dtype(
    [
        ("sections", "f8", (SECTIONS, 5)),
        ("scale", "f8"),
        ("horizon", "i8", (OUTPUTS,)),
        ("spacing", "i8"),
        ("walk2", "f8"),
        ("noise2", "f8"),
        ("smoothing", "f8"),
    ]
)


def ar_state_dtype(config: TremorConfig) -> np.dtype[Any]:
    p = config.ar.order
    return np.dtype(
        [
            ("memory", "f8", (AXES, SECTIONS, 2)),
            ("past", "f8", (AXES, round(RING_S * config.tick_hz))),
            ("power", "f8", (AXES,)),
            ("weights", "f8", (AXES, OUTPUTS, p)),
            ("covariance", "f8", (AXES, OUTPUTS, p, p)),
            ("gain", "f8", (p,)),
            ("regressor", "f8", (p,)),
            ("at", "i8"),
        ]
    )


def ar_params(config: TremorConfig) -> Record:
    """Return the kernels' parameters."""
    gain, _ = chain_gain_and_lag(config)
    return new_record(
        AR,
        sections=chain_sections(config),
        scale=1.0 / gain,
        horizon=horizons(config),
        spacing=max(1, round(config.ar.spacing_s * config.tick_hz)),
        walk2=config.ar.walk**2,
        noise2=config.ar.noise**2,
        smoothing=1.0 / (config.wflc.power_s * config.tick_hz),
    )


def ar_state(config: TremorConfig) -> Record:
    """Return the state before the first sample. The first guess of each predictor is zero."""
    return new_record(ar_state_dtype(config), covariance=np.eye(config.ar.order))


@kernel
def ar_coast(state: Record) -> None:
    """Advance one tick without a sample. The last prediction of the present stands in for it."""
    ring = state.past.shape[1]
    before = state.at
    state.at = (before + 1) % ring
    for i in range(AXES):
        state.past[i, state.at] = state.past[i, before]


@kernel
def ar_correct(state: Record, axis: int, sample: float, params: Record) -> None:
    """Process the present tick's sample, after ``ar_coast``: run the filters, then let both predictors learn."""
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
def _regressor(state: Record, axis: int, back: int, spacing: int) -> None:
    ring = state.past.shape[1]
    for i in range(len(state.regressor)):
        state.regressor[i] = state.past[axis, (state.at - back - i * spacing) % ring]


@kernel
def ar_output(state: Record, axis: int, output: int, params: Record) -> float:
    """Return the tremor, m. ``output`` 0: now; 1: over the loop's delay."""
    _regressor(state, axis, 0, params.spacing)
    total = 0.0
    for i in range(len(state.regressor)):
        total += state.weights[axis, output, i] * state.regressor[i]
    return total * params.scale
