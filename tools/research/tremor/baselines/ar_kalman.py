"""Predicts several steps ahead with an autoregressive model behind the band-pass, tracked by a Kalman filter.

The band-passed displacement lags the tip by the phase of all filters before it (RC, integrators, band-pass). Here the
predictor reaches over that lag and over the loop's delay at once: present coefficients are found by predicting the
present value from values one horizon older (direct multi-step, no iterated error). Filter gain is undone.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from firmware_py.biquads import cascade_response, cascade_step
from firmware_py.sensing.translation import integrator_sections
from firmware_py.tremor.adaptive_design import sensor_response
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.own import OwnEstimator
from firmware_py.tremor.prefilter import prefilter_sections
from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from hal.validation import Positive, StrictTable, validate_table

OUTPUTS = 2
SECTIONS = 5
RING_S = 0.5  # of the longest horizon (one period at 7 Hz and the loop) and the regressor
MEMORY, NUMBERS = 4096, 64
SCALARS = 9
FIXED = 2 + 2 * SECTIONS  # numbers in the memory in front of what depends on the order


class ArConfig(StrictTable):
    """Direct multi-step autoregressive predictor, its coefficients tracked by a Kalman filter (Tatinati, Ang 2013)."""

    order: Annotated[int, Field(ge=2, le=12)] = 6
    spacing_s: Positive = 0.01
    walk: Positive = 1e-4
    noise: Positive = 0.1  # of the signal's rms


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
    response = cascade_response(chain_sections(config), hz, config.tick_hz)[0] * sensor_response(config, hz)[0]
    return float(abs(response)), float((-np.angle(response) % (2.0 * pi)) / (2.0 * pi * hz[0]))


def horizons(config: TremorConfig) -> tuple[int, int]:
    """Return the ticks to predict over the filters' lag, and over lag and loop delay."""
    _, lag_s = chain_gain_and_lag(config)
    return round(lag_s * config.tick_hz), round((lag_s + config.loop_delay_s) * config.tick_hz)


def ar_numbers(config: TremorConfig) -> Array:
    """Return order, ring, two horizons, spacing (ticks), scale, walk^2, noise^2, smoothing; then the sections."""
    ar = validate_table(ArConfig, config.own, "[firmware.tremor.own]")
    ring = round(RING_S * config.tick_hz)
    if ar.order * ar.spacing_s > 0.25 or FIXED + ar.order * (2 + OUTPUTS * (1 + ar.order)) + ring > MEMORY:
        raise BenchError("ar: order times spacing_s must be below 0.25 s, and the ring must fit into the memory")
    gain, _ = chain_gain_and_lag(config)
    scalars = [
        ar.order, ring, *horizons(config), max(1, round(ar.spacing_s * config.tick_hz)), 1.0 / gain, ar.walk**2,
        ar.noise**2, 1.0 / (config.wflc.power_s * config.tick_hz),
    ]  # fmt: skip
    return np.concatenate([scalars, chain_sections(config).ravel()])


class Memory(NamedTuple):
    """An axis' memory as the kernels read it (``_axis``)."""

    steady: Array  # (2,): ticks so far, power in m^2
    filter: Array  # (SECTIONS, 2)
    gain: Array  # (order,)
    regressor: Array  # (order,)
    weights: Array  # (OUTPUTS, order)
    covariance: Array  # (OUTPUTS, order, order)
    past: Array  # (ring,) band-passed, m


@kernel
def _axis(memory: Array, order: int, ring: int) -> Memory:
    """Cut the memory of an axis; at its first tick set it: the first guess of each predictor is zero."""
    a, b = FIXED + 2 * order, FIXED + (2 + OUTPUTS) * order
    c = b + OUTPUTS * order * order
    weights = memory[a:b].reshape(OUTPUTS, order)
    covariance = memory[b:c].reshape(OUTPUTS, order, order)
    if memory[0] == 0.0:
        for o in range(OUTPUTS):
            for i in range(order):
                covariance[o, i, i] = 1.0
    return Memory(
        memory[:2], memory[2:FIXED].reshape(SECTIONS, 2), memory[FIXED : FIXED + order], memory[FIXED + order : a],
        weights, covariance, memory[c : c + ring],
    )  # fmt: skip


@kernel
def _correct(sample: float, m: Memory, n: Array) -> None:
    """Process the present tick's sample: run the filters, then let both predictors learn."""
    at = int(m.steady[0]) % len(m.past)
    x = cascade_step(sample, m.filter, n[SCALARS : SCALARS + 5 * SECTIONS].reshape(SECTIONS, 5))
    m.past[at] = x
    m.steady[1] += n[8] * (x * x - m.steady[1])
    if m.steady[1] <= 0.0:
        return
    unit = 1.0 / sqrt(m.steady[1])
    r, k = m.regressor, m.gain
    p = len(r)
    for o in range(OUTPUTS):
        _regressor(int(n[2 + o]), int(n[4]), m)
        w, c = m.weights[o], m.covariance[o]
        error, spread = x * unit, n[7]
        for i in range(p):
            r[i] *= unit
            error -= w[i] * r[i]
        for i in range(p):
            c[i, i] += n[6]
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
def _regressor(back: int, spacing: int, m: Memory) -> None:
    for i in range(len(m.regressor)):
        m.regressor[i] = m.past[(int(m.steady[0]) - back - i * spacing) % len(m.past)]


@kernel
def ar_step(memory: Array, numbers: Array, sample: float, have: bool, out: Array) -> None:
    """Compute one tick of one axis; see ``OwnEstimator``. Without a sample the last band-passed value stands in."""
    m = _axis(memory, int(numbers[0]), int(numbers[1]))
    ring = len(m.past)
    m.steady[0] += 1.0
    at = int(m.steady[0])
    m.past[at % ring] = m.past[(at - 1) % ring]
    if have:
        _correct(sample, m, numbers)
    _regressor(0, int(numbers[4]), m)
    for o in range(OUTPUTS):
        total = 0.0
        for i in range(len(m.regressor)):
            total += m.weights[o, i] * m.regressor[i]
        out[o] = total * numbers[5]


AUTOREGRESSIVE = OwnEstimator(ar_numbers, ar_step, MEMORY, NUMBERS)
