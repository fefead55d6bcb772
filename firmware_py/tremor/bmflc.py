"""Implements the band-limited multiple Fourier linear combiner, a comb over the tremor band (Veluvolu, Ang 2011).

Three methods adapt the weights: LMS (BMFLC); LMS that forgets over a memory window while its band follows the tremor
(E-BMFLC); a Kalman filter with weights as random walk (BMFLC-KF), whose gain depends on the regressors alone and so is
the same for all axes. Each frequency's sensor factor is known, so the weights give displacement now and ahead.
"""

from __future__ import annotations

from cmath import exp as cexp
from math import exp, pi

import numpy as np

from firmware_py.records import Array, Complexes, Records, field, new, record
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.family import AXES, EstimatorParams, EstimatorState, Family, Samples
from firmware_py.tremor.prefilter import prefilter_gain, prefilter_sections, prefilter_step
from firmware_py.tremor.seen import Seen, seen_params, undo
from hal.compiled import kernel

FOLLOW_TICKS = 50  # the band of E-BMFLC moves this often


def comb_size(config: TremorConfig) -> int:
    """Return the number of frequencies in the comb."""
    return int((config.bmflc.high_hz - config.bmflc.low_hz) / config.bmflc.step_hz + 1.0 + 1e-9)


@record
class BmflcParams:
    """Numbers of the comb."""

    seen: Seen = field("")
    sections: Array = field("1", 3, 5)
    behind_prefilter: int = field("1")
    omega: Array = field("rad/sample", "size")
    gain: float = field("1")
    bias_gain: float = field("1")
    keep: float = field("1")
    follow: float = field("1")  # of the centroid, per FOLLOW_TICKS; 0: the band stays
    kalman: int = field("1")
    walk2: float = field("1")
    bias_walk2: float = field("1")


@record
class BmflcState:
    """Phasors and weights of each axis. ``weights``: sine, cosine of each frequency; bias."""

    memory: Array = field("sample", AXES, 3, 2)
    phasor: Complexes = field("1", AXES, "size")
    turn: Complexes = field("1", AXES, "size")  # of the phasor, per sample
    undo: Complexes = field("m/sample", AXES, 2, "size")  # now, ahead
    shift: Array = field("rad/sample", AXES)  # of the band
    weights: Array = field("sample", AXES, "n_weights")
    regressor: Array = field("1", "n_weights")
    covariance: Array = field("1", "n_weights", "n_weights")  # in units of the reading's noise
    kalman_gain: Array = field("1", "n_weights")
    ticks: int = field("1")


@record
class CombEstimator(EstimatorState):
    """The estimator's state with the comb's."""

    comb: BmflcState = field("")


@record
class CombNumbers(EstimatorParams):
    """The estimator's parameters with the comb's."""

    comb: BmflcParams = field("")


def bmflc_params(config: TremorConfig) -> Records[BmflcParams]:
    """Return the kernels' parameters for ``config.method``."""
    c = config.bmflc
    size = comb_size(config)
    moves = config.method == "ebmflc"
    return new(
        BmflcParams,
        seen=seen_params(config),
        sections=prefilter_sections(config.wflc, config.tick_hz),
        behind_prefilter=int(config.behind_prefilter),
        omega=2.0 * pi * (c.low_hz + c.step_hz * np.arange(size)) / config.tick_hz,
        gain=c.memory_gain if moves else c.gain,
        bias_gain=c.bias_gain,
        keep=exp(-1.0 / (c.memory_s * config.tick_hz)) if moves else 1.0,
        follow=c.band_gain * FOLLOW_TICKS / config.tick_hz if moves else 0.0,
        kalman=int(config.method == "bmflc_kalman"),
        walk2=c.walk**2,
        bias_walk2=c.bias_walk**2,
    )


def bmflc_state(config: TremorConfig) -> Records[BmflcState]:
    """Return the state before the first sample: no amplitude, the configured band, unknown weights."""
    size = comb_size(config)
    return new(BmflcState, {"size": size}, phasor=1.0, covariance=100.0 * np.eye(2 * size + 1))


@kernel
def _tune(state: BmflcState, axis: int, params: BmflcParams) -> None:
    """Turns and sensor factors of one axis for its present band."""
    rate = params.seen.tick_hz
    size = len(params.omega)
    middle = 0.5 * (params.omega[0] + params.omega[size - 1]) + state.shift[axis]
    for r in range(size):
        omega = params.omega[r] + state.shift[axis]
        state.turn[axis, r] = cexp(1j * omega)
        behind = 1.0 + 0.0j
        if params.behind_prefilter:
            # a short memory smears the tremor over the comb; the band's middle is where it is
            behind = prefilter_gain(params.sections, middle if params.follow > 0.0 else omega)
        state.undo[axis, 0, r] = undo(omega * rate, 0.0, params.seen) / behind
        state.undo[axis, 1, r] = undo(omega * rate, params.seen.delay_s, params.seen) / behind


@kernel
def bmflc_tick(coasts: bool, states: CombEstimator, param: CombNumbers) -> None:
    """Advance one tick: the phases run on, and the weights walk."""
    state, params = states.comb, param.comb
    size = len(params.omega)
    if state.ticks == 0:
        for i in range(AXES):
            _tune(state, i, params)
    for i in range(AXES):
        for r in range(size):
            z = state.phasor[i, r] * state.turn[i, r]
            state.phasor[i, r] = z * (1.5 - 0.5 * (z.real * z.real + z.imag * z.imag))  # back to length 1
    state.ticks += 1
    if params.follow > 0.0 and state.ticks % FOLLOW_TICKS == 0:
        for i in range(AXES):
            _follow(state, i, params)
    if params.kalman:
        for j in range(2 * size):
            state.covariance[j, j] += params.walk2
        state.covariance[2 * size, 2 * size] += params.bias_walk2


@kernel
def _follow(state: BmflcState, axis: int, params: BmflcParams) -> None:
    """Move the band's middle towards the centroid of the weights' power, within half its width."""
    size = len(params.omega)
    total, moment = 0.0, 0.0
    for r in range(size):
        power = state.weights[axis, 2 * r] ** 2 + state.weights[axis, 2 * r + 1] ** 2
        total += power
        moment += power * params.omega[r]
    if total <= 0.0:
        return
    middle = 0.5 * (params.omega[0] + params.omega[size - 1])
    limit = 0.25 * (params.omega[size - 1] - params.omega[0])
    shift = state.shift[axis] + params.follow * (moment / total - middle)
    state.shift[axis] = max(-limit, min(limit, shift))
    _tune(state, axis, params)


@kernel
def bmflc_sample(samples: Samples, states: CombEstimator, param: CombNumbers) -> None:
    """Process the samples of the present tick."""
    state, params = states.comb, param.comb
    size = len(params.omega)
    x = state.regressor
    for i in range(AXES):
        sample = samples.tip[i]
        if params.behind_prefilter:
            sample = prefilter_step(sample, state.memory[i], params.sections)
        w = state.weights[i]
        error = sample - w[2 * size]
        for r in range(size):
            x[2 * r], x[2 * r + 1] = state.phasor[i, r].imag, state.phasor[i, r].real
            error -= w[2 * r] * x[2 * r] + w[2 * r + 1] * x[2 * r + 1]
        x[2 * size] = 1.0
        if params.kalman:
            if i == 0:
                _kalman_gain(state)
            for j in range(2 * size + 1):
                w[j] += state.kalman_gain[j] * error
        else:
            for j in range(2 * size):
                w[j] = params.keep * w[j] + 2.0 * params.gain * x[j] * error
            w[2 * size] += 2.0 * params.bias_gain * error


@kernel
def _kalman_gain(state: BmflcState) -> None:
    """Gain for the present regressor and the covariance after it; reading noise is the unit."""
    p, x, gain = state.covariance, state.regressor, state.kalman_gain
    n = len(x)
    spread = 1.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * x[j]
        gain[i] = total
        spread += total * x[i]
    for i in range(n):
        for j in range(i + 1):
            p[i, j] -= gain[i] * gain[j] / spread
            p[j, i] = p[i, j]
    for i in range(n):
        gain[i] /= spread


@kernel
def bmflc_output(axis: int, states: CombEstimator, param: CombNumbers) -> tuple[float, float, float]:
    """Return the tremor now and over the loop's delay, twice, m."""
    ahead = _sum(states.comb, axis, 1)
    return _sum(states.comb, axis, 0), ahead, ahead


@kernel
def _sum(state: BmflcState, axis: int, output: int) -> float:
    total = 0.0
    for r in range(state.phasor.shape[1]):
        weight = state.weights[axis, 2 * r + 1] - 1j * state.weights[axis, 2 * r]
        total += (weight * state.phasor[axis, r] * state.undo[axis, output, r]).real
    return total


COMB = Family(CombNumbers, CombEstimator, bmflc_params, bmflc_state, bmflc_tick, bmflc_sample, bmflc_output)
