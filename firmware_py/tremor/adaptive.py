"""Learns the causal linear filter that predicts this hand's tremor best, while the hand moves.

A tremor is known well some 0.4 s later, from the samples before and after it (``adaptive_design``). Regressing it on
the filter bank's states at that time gives the filter that predicts it from the past alone: least squares with
exponential forgetting, in normal equations, which start from the prior hand scaled to the tremor's own power. The
learned filter is a weighted sum of stable filters, so it is stable. What sensor noise adds to the regression is known
and subtracted.

The normal equations are positive definite by construction. A solution that fails nevertheless, by rounding or because
a number is not finite, leaves the filter in use unchanged (``_solve``); there is no error.

Learning uses signals that pass a filter which amplifies the tremor band, so that an error there costs more.

Near the sensor's noise the best filter has a small gain, far above it a large one, and hands change from one to the
other within a tenth of a second. So two filters are learned, for the levels calm and burst, and mixed by a gate: the
power of the samples in a wide band, over that of what is no tremor. Each row of the regression counts for the two
levels as its own gate says.
"""

from __future__ import annotations

from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from firmware_py.biquads import biquad_step
from firmware_py.records import Records, field, new, record
from firmware_py.tremor.adaptive_design import AXES, LEVELS, OUTPUTS, design_adaptive
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.family import EstimatorParams, EstimatorState, Family, Samples
from hal.arrays import Array
from hal.compiled import kernel

STARTED, FED, LEARNED = range(3)
"""Values of ``AdaptiveState.running``: no tick yet; the last tick's data are not learned from yet; they are."""


@record
class AdaptiveParams:
    """Holds the numbers of the design (``AdaptiveDesign`` describes them).

    ``m`` is the number of states of an axis' filter bank: for each channel the real and imaginary part of each of the
    ``poles``, the ``slows`` low-passes, then the sample itself. ``channels`` are the tip's acceleration and the lever's
    signals, ``LEVELS`` calm and burst, ``OUTPUTS`` tremor now, tremor a loop delay later, and the core of the latter.
    Fields that begin with ``core_`` are the same through the tremor band's filter.
    """

    pole_re: Array = field("1", "poles")
    pole_im: Array = field("1", "poles")
    pole_gain: Array = field("1", "poles")
    slow: Array = field("1", "slows")
    taps: Array = field("1", OUTPUTS, "taps")
    weight: Array = field("1", 5)
    gate: Array = field("1", 5)
    gate_power: Array = field("sample^2", AXES)
    gate_smoothing: float = field("1")
    tremor: Array = field("sample^2/m^2", LEVELS, "m", "m")
    rest: Array = field("sample^2", AXES, "m", "m")
    quiet: Array = field("sample^2", AXES, "m", "m")
    cross: Array = field("sample/m", LEVELS, OUTPUTS, "m")
    noise_cross: Array = field("sample m", AXES, OUTPUTS, "m")
    noise_power: Array = field("m^2", AXES)
    lean_by_up: Array = field("1", AXES, "channels", 3)
    lean_by_square: Array = field("1", AXES, 3, 3)
    lean_cross: Array = field("sample m", 2, OUTPUTS, "one")
    lean_power: Array = field("m^2", 2)
    weighted_power: Array = field("m^2", LEVELS)
    least_power: float = field("m^2")
    start: Array = field("m/sample", AXES, LEVELS, OUTPUTS, "m")
    onward: Array = field("1", AXES, "channels", "m")
    block_ticks: int = field("1")
    keep: float = field("1")  # factor of all sums at each block
    prior_blocks: Array = field("1", LEVELS)  # number of blocks that the prior counts for
    share: Array = field("1", AXES, AXES)  # weight of the second axis' rows in the first axis' regression
    outlier: float = field("1")  # a row counts fully up to so many times the typical power
    ease: float = field("1")  # share of the way to the solved filter in one tick
    relative: float = field("1")
    relative_power: float = field("1")
    relative_beyond: float = field("1")
    quiet_power: float = field("1")
    core_weight: Array = field("1", 5)
    core_tremor: Array = field("sample^2/m^2", LEVELS, "m", "m")
    core_rest: Array = field("sample^2", AXES, "m", "m")
    core_cross: Array = field("sample/m", LEVELS, OUTPUTS, "m")
    core_noise_cross: Array = field("sample m", AXES, OUTPUTS, "m")
    core_noise_power: Array = field("m^2", AXES)
    core_lean_cross: Array = field("sample m", 2, OUTPUTS, "one")
    core_lean_power: Array = field("m^2", 2)
    core_weighted_power: Array = field("m^2", LEVELS)
    core_least_power: float = field("m^2")


@record
class AdaptiveState:
    """Holds the filter banks, the sums of the regression, and the filters in use. ``AdaptiveParams`` names the indices.

    The tremor is the product of ``filter`` and ``bank``: (m/sample) (sample).
    """

    bank: Array = field("sample", AXES, "m")
    pending: Array = field("sample", AXES, "channels")  # input of the bank in this tick, measured or predicted
    running: int = field("1")  # STARTED, FED or LEARNED
    weigh: Array = field("sample", AXES, "channels", 2)  # memory of the filter of errors
    weighted: Array = field("sample", AXES, "m")  # bank of the signals behind that filter
    gate: Array = field("sample", AXES, 2)  # memory of the gate's band-pass
    gate_power: Array = field("sample^2", AXES)
    burst: Array = field("1", AXES)  # share of the burst's filter
    sum: Array = field("sample", AXES)  # of the block so far
    in_block: int = field("1")  # ticks of the block so far
    blocks: Array = field("sample", AXES, "taps")  # ring of block means
    snapshots: Array = field("sample", AXES, "lags", "m")  # ring of bank states at the ends of blocks
    bursts: Array = field("1", AXES, "lags")  # ring of ``burst`` at the ends of blocks
    n_blocks: int = field("1")
    normal: Array = field("sample^2", AXES, LEVELS, "m", "m")  # normal matrices, lower triangles
    right: Array = field("sample m", AXES, LEVELS, OUTPUTS, "m")  # right sides
    power: Array = field("m^2", AXES, LEVELS)  # weighted sum of the squared tremor
    count: Array = field("1", AXES, LEVELS)  # weighted number of rows
    filter: Array = field("m/sample", AXES, LEVELS, OUTPUTS, "m")  # in use
    solved: Array = field("m/sample", AXES, LEVELS, OUTPUTS, "m")  # last solution, which ``filter`` approaches
    work: Array = field("sample^2", "m", "m")
    scale: Array = field("1/sample", "m")
    up: Array = field("1", 3)  # body frame; the four below are the sensors' noise in learning at this attitude
    noise_cross: Array = field("sample m", AXES, OUTPUTS, "m")
    noise_power: Array = field("m^2", AXES)
    core_noise_cross: Array = field("sample m", AXES, OUTPUTS, "m")
    core_noise_power: Array = field("m^2", AXES)
    target: Array = field("m", OUTPUTS)
    solution: Array = field("sample m", OUTPUTS, "m")
    core_weigh: Array = field("sample", AXES, "channels", 2)  # from here on: through the tremor band's filter
    core_weighted: Array = field("sample", AXES, "m")
    core_sum: Array = field("sample", AXES)
    core_blocks: Array = field("sample", AXES, "taps")
    core_snapshots: Array = field("sample", AXES, "lags", "m")
    core_normal: Array = field("sample^2", AXES, LEVELS, "m", "m")
    core_right: Array = field("sample m", AXES, LEVELS, OUTPUTS, "m")
    core_power: Array = field("m^2", AXES, LEVELS)
    row_weight: Array = field("1", LEVELS)


@record
class AdaptiveEstimator(EstimatorState):
    """Holds the state of an estimator with the adaptive method."""

    adaptive: AdaptiveState = field("")


@record
class AdaptiveNumbers(EstimatorParams):
    """Holds the parameters of an estimator with the adaptive method."""

    adaptive: AdaptiveParams = field("")


def adaptive_params(config: TremorConfig) -> Records[AdaptiveParams]:
    """Return the kernels' parameters."""
    d = design_adaptive(config)
    a = config.adaptive
    block_s = d.block_ticks / config.tick_hz
    return new(
        AdaptiveParams,
        pole_re=d.bank.pole.real,
        pole_im=d.bank.pole.imag,
        pole_gain=1.0 - np.abs(d.bank.pole),
        slow=d.bank.slow,
        taps=d.taps,
        weight=d.weight,
        gate=d.gate,
        gate_power=d.gate_power,
        gate_smoothing=1.0 - exp(-1.0 / (a.gate_s * config.tick_hz)),
        tremor=d.tremor,
        rest=d.rest,
        quiet=d.quiet,
        cross=d.cross,
        noise_cross=d.noise_cross,
        noise_power=d.noise_power,
        lean_by_up=d.lean.by_up,
        lean_by_square=d.lean.by_square,
        lean_cross=d.lean_cross,
        lean_power=d.lean_power,
        weighted_power=d.weighted_power,
        least_power=d.least_power,
        start=d.start,
        onward=d.onward,
        block_ticks=d.block_ticks,
        keep=exp(-block_s / a.memory_s),
        prior_blocks=np.array([a.prior_s, a.burst_prior_s]) / block_s,
        share=_shares(config),
        outlier=a.outlier,
        ease=1.0 - exp(-1.0 / (a.ease_s * config.tick_hz)) if a.ease_s > 0.0 else 1.0,
        relative=a.relative,
        relative_power=a.relative_powers[0],
        relative_beyond=a.relative_beyond,
        quiet_power=a.relative_powers[1],
        **{f"core_{name}": value for name, value in vars(d.core).items()},
    )


def _shares(config: TremorConfig) -> Array:
    """Return (3, 3), the weight of one axis' rows for another: it falls with the ratio of their noise."""
    lever = config.lever
    noise = np.ones(AXES) if lever is None else np.square([lever.tip_noise(axis) for axis in range(AXES)])
    alike = np.minimum.outer(noise, noise) / np.maximum.outer(noise, noise)
    return config.adaptive.share * alike * (1.0 - np.eye(AXES)) + np.eye(AXES)


def adaptive_state(config: TremorConfig) -> Records[AdaptiveState]:
    """Return the state before the first sample, whose filters are those of the prior hands."""
    design = design_adaptive(config)
    taps = design.taps.shape[1]
    sizes = {"channels": design.bank.channels, "taps": taps, "lags": taps // 2 + 1}
    return new(
        AdaptiveState,
        sizes,
        filter=design.start,
        solved=design.start,
        noise_cross=design.noise_cross,
        noise_power=design.noise_power,
        core_noise_cross=design.core.noise_cross,
        core_noise_power=design.core.noise_power,
    )


@kernel
def bank_turn(bank: Array, params: AdaptiveParams) -> None:
    """Advance ``bank`` (m,) by one tick without its inputs."""
    n = len(params.pole_re)
    slow = len(params.slow)
    for at in range(0, len(bank), 2 * n + slow + 1):
        for r in range(n):
            re, im = bank[at + 2 * r], bank[at + 2 * r + 1]
            bank[at + 2 * r] = params.pole_re[r] * re - params.pole_im[r] * im
            bank[at + 2 * r + 1] = params.pole_re[r] * im + params.pole_im[r] * re
        for r in range(slow):
            bank[at + 2 * n + r] *= params.slow[r]
        bank[at + 2 * n + slow] = 0.0


@kernel
def bank_add(bank: Array, channel: int, sample: float, params: AdaptiveParams) -> None:
    """Add a channel's input of one tick to the bank, after ``bank_turn``."""
    n = len(params.pole_re)
    slow = len(params.slow)
    at = channel * (2 * n + slow + 1)
    for r in range(n):
        bank[at + 2 * r] += params.pole_gain[r] * sample
    for r in range(slow):
        bank[at + 2 * n + r] += (1.0 - params.slow[r]) * sample
    bank[at + 2 * n + slow] += sample


@kernel
def adaptive_tick(coasts: bool, states: AdaptiveEstimator, param: AdaptiveNumbers) -> None:
    """Advance to the next tick: learn from the last tick's data unless ``adaptive_learn`` has, and advance the bank
    with predicted samples, which ``adaptive_sample`` replaces. ``coasts`` is not used."""
    state, params = states.adaptive, param.adaptive
    adaptive_learn(0, states, param)
    if state.running != STARTED:
        _approach_solution(state, params)
    state.running = FED
    _, channels, m = params.onward.shape
    for i in range(AXES):
        bank = state.bank[i]
        for c in range(channels):
            sample = 0.0
            for j in range(m):
                sample += params.onward[i, c, j] * bank[j]
            state.pending[i, c] = sample
        bank_turn(bank, params)
        for c in range(channels):
            bank_add(bank, c, state.pending[i, c], params)


@kernel
def adaptive_learn(_given: int, states: AdaptiveEstimator, param: AdaptiveNumbers) -> None:
    """Learn from the tick's data, once. The next tick needs this, the output of this tick does not."""
    if states.adaptive.running == FED:
        _learn(states.adaptive, param.adaptive)
        states.adaptive.running = LEARNED


@kernel
def adaptive_sample(samples: Samples, states: AdaptiveEstimator, param: AdaptiveNumbers) -> None:
    """Replace the predicted samples by the measured ones: of the tip, and of the lever (``LeverConfig``)."""
    state, params = states.adaptive, param.adaptive
    for i in range(3):
        state.up[i] = samples.up[i]
    for axis in range(AXES):
        for c in range(params.onward.shape[1]):
            own = samples.turned[axis, c - 1] if c else samples.tip[axis]
            bank_add(state.bank[axis], c, own - state.pending[axis, c], params)
            state.pending[axis, c] = own


@kernel
def adaptive_output(axis: int, states: AdaptiveEstimator, param: AdaptiveNumbers) -> tuple[float, float, float]:
    """Return the tremor now and over the loop's delay, and the core band's part of the latter, m."""
    state = states.adaptive
    return _filtered(state, axis, 0), _filtered(state, axis, 1), _filtered(state, axis, 2)


@kernel
def _filtered(state: AdaptiveState, axis: int, output: int) -> float:
    calm, burst = 0.0, 0.0
    bank = state.bank[axis]
    for j in range(len(bank)):
        calm += state.filter[axis, 0, output, j] * bank[j]
        burst += state.filter[axis, 1, output, j] * bank[j]
    return calm + state.burst[axis] * (burst - calm)


@kernel
def _learn(state: AdaptiveState, params: AdaptiveParams) -> None:
    """Add the last sample to the weighted bank and to the block's sum. At the end of a block, add a row to the
    regression and solve one of its systems."""
    for i in range(AXES):
        sample = state.pending[i, 0]
        bank_turn(state.weighted[i], params)
        for c in range(params.onward.shape[1]):
            lifted = biquad_step(state.pending[i, c], state.weigh[i, c], params.weight)
            bank_add(state.weighted[i], c, lifted, params)
            if c == 0:
                state.sum[i] += lifted
        if params.relative > 0.0:
            bank_turn(state.core_weighted[i], params)
            for c in range(params.onward.shape[1]):
                core = biquad_step(state.pending[i, c], state.core_weigh[i, c], params.core_weight)
                bank_add(state.core_weighted[i], c, core, params)
                if c == 0:
                    state.core_sum[i] += core
        gated = biquad_step(sample, state.gate[i], params.gate)
        state.gate_power[i] += params.gate_smoothing * (gated * gated - state.gate_power[i])
        state.burst[i] = state.gate_power[i] / (state.gate_power[i] + params.gate_power[i])
    state.in_block += 1
    if state.in_block < params.block_ticks:
        return
    state.in_block = 0
    at = state.n_blocks
    state.n_blocks += 1
    n_taps = state.blocks.shape[1]
    lag = n_taps // 2
    for i in range(AXES):
        state.blocks[i, at % n_taps] = state.sum[i] / params.block_ticks
        state.sum[i] = 0.0
        snapshot = state.snapshots[i, at % (lag + 1)]
        for j in range(len(snapshot)):
            snapshot[j] = state.weighted[i, j]
        state.bursts[i, at % (lag + 1)] = state.burst[i]
        if params.relative > 0.0:
            state.core_blocks[i, at % n_taps] = state.core_sum[i] / params.block_ticks
            state.core_sum[i] = 0.0
            snapshot = state.core_snapshots[i, at % (lag + 1)]
            for j in range(len(snapshot)):
                snapshot[j] = state.core_weighted[i, j]
        # twice the target's length: the bank's transient at the start has decayed by then
        if at >= 2 * n_taps:
            _add_row_of_block(state, i, at, params)
    if at >= 2 * n_taps:
        _update_noise(state, params)
    axis = at % AXES  # one system per block, so that no tick solves more than one
    if at >= 2 * n_taps:
        _solve(state, axis, (at // AXES) % LEVELS, params)


@kernel
def _update_noise(state: AdaptiveState, params: AdaptiveParams) -> None:
    """Set the noise terms of the regression for the present attitude, by which gravity turns noise of the angular
    acceleration into noise of the tip's."""
    channels, one = params.onward.shape[1], params.lean_cross.shape[2]
    for i in range(AXES):
        square = 0.0
        for k in range(3):
            for n in range(3):
                square += state.up[k] * params.lean_by_square[i, k, n] * state.up[n]
        for c in range(channels):
            linear = 0.0
            for k in range(3):
                linear += params.lean_by_up[i, c, k] * state.up[k]
            if c > 0:
                square = 0.0
            else:
                more = linear * params.lean_power[0] + square * params.lean_power[1]
                state.noise_power[i] = params.noise_power[i] + more
                more = linear * params.core_lean_power[0] + square * params.core_lean_power[1]
                state.core_noise_power[i] = params.core_noise_power[i] + more
            for o in range(OUTPUTS):
                for j in range(one):
                    at = c * one + j
                    more = linear * params.lean_cross[0, o, j] + square * params.lean_cross[1, o, j]
                    state.noise_cross[i, o, at] = params.noise_cross[i, o, at] + more
                    more = linear * params.core_lean_cross[0, o, j] + square * params.core_lean_cross[1, o, j]
                    state.core_noise_cross[i, o, at] = params.core_noise_cross[i, o, at] + more


@kernel
def _approach_solution(state: AdaptiveState, params: AdaptiveParams) -> None:
    """Move the filters in use towards the solved ones by a share per tick, because a step would move the tip."""
    for axis in range(AXES):
        for level in range(LEVELS):
            used, solved = state.filter[axis, level], state.solved[axis, level]
            for o in range(OUTPUTS):
                for j in range(used.shape[1]):
                    used[o, j] += params.ease * (solved[o, j] - used[o, j])


@kernel
def _compute_target(blocks: Array, at: int, taps: Array, target: Array) -> None:
    """Set ``target`` (outputs,) to the tremor of ``lag`` blocks ago and of a loop delay later."""
    n_taps = len(blocks)
    for o in range(OUTPUTS):
        target[o] = 0.0
    for j in range(n_taps):
        block = blocks[(at - j) % n_taps]
        for o in range(OUTPUTS):
            target[o] += taps[o, j] * block


@kernel
def _add_row(normal: Array, right: Array, phi: Array, target: Array, weight: float, keep: float) -> None:
    """Add a row of features ``phi`` (m,) to one system, which forgets by ``keep``."""
    for i in range(len(phi)):
        scaled = weight * phi[i]
        for j in range(i + 1):
            normal[i, j] = keep * normal[i, j] + scaled * phi[j]
        for o in range(OUTPUTS):
            right[o, i] = keep * right[o, i] + scaled * target[o]


@kernel
def _add_row_of_block(state: AdaptiveState, axis: int, at: int, params: AdaptiveParams) -> None:
    """Add one row to an axis' systems: the bank of ``lag`` blocks ago, the tremor at that time and a loop delay
    later."""
    lag = state.blocks.shape[1] // 2
    target = state.target
    burst = state.bursts[axis, (at - lag) % (lag + 1)]
    keep = params.keep
    _compute_target(state.blocks[axis], at, params.taps, target)
    now2 = target[0] * target[0]
    phi = state.snapshots[axis, (at - lag) % (lag + 1)]
    for level in range(LEVELS):
        weight = _row_weight(state, axis, level, now2, burst, params)
        state.count[axis, level] = keep * state.count[axis, level] + weight
        state.power[axis, level] = keep * state.power[axis, level] + weight * now2
        _add_row(state.normal[axis, level], state.right[axis, level], phi, target, weight, keep)
        state.row_weight[level] = weight
    if params.relative > 0.0:
        _compute_target(state.core_blocks[axis], at, params.taps, target)
        phi = state.core_snapshots[axis, (at - lag) % (lag + 1)]
        for level in range(LEVELS):
            weight = state.row_weight[level]
            state.core_power[axis, level] = keep * state.core_power[axis, level] + weight * target[0] * target[0]
            _add_row(state.core_normal[axis, level], state.core_right[axis, level], phi, target, weight, keep)


@kernel
def _row_weight(
    state: AdaptiveState, axis: int, level: int, now2: float, burst: float, params: AdaptiveParams
) -> float:
    """Return the weight of a row for ``level``. A jerk, whose power is above the typical one, is weighted down."""
    n0 = params.prior_blocks[level]
    known = n0 * params.weighted_power[level] + state.power[axis, level]
    typical = known / (n0 + state.count[axis, level])
    weight = burst if level else 1.0 - burst
    return weight * min(1.0, params.outlier * typical / max(now2, 1e-300))


class _Rows(NamedTuple):
    """Holds the sums of an axis' regression, with the rest and the noise of its prior."""

    normal: Array
    right: Array
    rest: Array
    noise: Array
    weight: float
    power: float


@kernel
def _add_rows(rows: _Rows, share: float, own: float, state: AdaptiveState) -> None:
    """Add ``share`` of an axis' rows to the system, scaled down to the power ``own`` (m^2) a row.

    Rows that are scaled down hold too little noise for the smaller tremor, so the prior's rest makes up for it.
    """
    normal, right, rest, noise, count, power = rows
    if count <= 0.0 or power <= 0.0:
        return
    ratio = min(1.0, own * count / power)
    factor, back = share * ratio, share * (1.0 - ratio) * count
    for i in range(state.work.shape[0]):
        for j in range(i + 1):
            state.work[i, j] += factor * normal[i, j] + back * rest[i, j]
        for o in range(OUTPUTS):
            state.solution[o, i] += factor * (right[o, i] - count * noise[o, i])


@kernel
def _mean_power(state: AdaptiveState, axis: int, level: int, params: AdaptiveParams) -> float:
    """Return the mean square of the tremor (m^2) as the regression weighs it, less the noise."""
    count, n0 = state.count[axis, level], params.prior_blocks[level]
    known = state.power[axis, level] + n0 * params.weighted_power[level] - state.noise_power[axis] * count
    return max(known / (count + n0), params.least_power)


@kernel
def _mean_core_power(state: AdaptiveState, axis: int, level: int, params: AdaptiveParams) -> float:
    """Return the mean square of the tremor (m^2) behind the tremor band's filter, less the noise."""
    count, n0 = state.count[axis, level], params.prior_blocks[level]
    known = (
        state.core_power[axis, level] + n0 * params.core_weighted_power[level] - state.core_noise_power[axis] * count
    )
    return max(known / (count + n0), params.core_least_power)


@kernel
def _solve(state: AdaptiveState, axis: int, level: int, params: AdaptiveParams) -> None:
    """Solve (data + prior) filter = (data + prior) cross for an axis and level, by Cholesky of the scaled matrix, and
    put the filter (OUTPUTS, m), m/sample, into ``state.solved``. If the matrix is not positive definite to rounding or
    not finite, ``solved`` stays as it is: the filter in use goes on towards the last solution."""
    a, right = state.work, state.solution
    m = len(a)
    n0 = params.prior_blocks[level]
    rows = n0
    for other in range(AXES):
        rows += params.share[axis, other] * state.count[other, level]
    power = _mean_power(state, axis, level, params)
    wider = 1.0  # power of all motion over that of the tremor
    if params.relative > 0.0:
        whole, core = 0.0, 0.0
        for other in range(AXES):
            whole += _mean_power(state, other, level, params)
            core += _mean_core_power(state, other, level, params)
        wider = whole / core
        by = params.quiet_power
        rows *= sqrt(wider) if by == 0.5 else wider**by  # sqrt: recordings must replay bit for bit
    for i in range(m):
        for j in range(i + 1):
            a[i, j] = n0 * (power * params.tremor[level, i, j] + params.rest[axis, i, j])
            a[i, j] += rows * params.quiet[axis, i, j]
        for o in range(OUTPUTS):
            right[o, i] = n0 * power * params.cross[level, o, i]
    for other in range(AXES):
        share = params.share[axis, other]
        if share > 0.0:
            part = _Rows(
                state.normal[other, level], state.right[other, level], params.rest[other], state.noise_cross[other],
                state.count[other, level], state.power[other, level],
            )  # fmt: skip
            _add_rows(part, share, 1e300 if other == axis else power, state)
    if params.relative > 0.0:
        counts = params.relative * max(wider - params.relative_beyond, 0.0) ** params.relative_power
        power = _mean_core_power(state, axis, level, params)
        for i in range(m):
            for j in range(i + 1):
                a[i, j] += counts * n0 * (power * params.core_tremor[level, i, j] + params.core_rest[axis, i, j])
            for o in range(OUTPUTS):
                right[o, i] += counts * n0 * power * params.core_cross[level, o, i]
        for other in range(AXES):
            share = counts * params.share[axis, other]
            if share > 0.0:
                part = _Rows(
                    state.core_normal[other, level], state.core_right[other, level], params.core_rest[other],
                    state.core_noise_cross[other], state.count[other, level], state.core_power[other, level],
                )  # fmt: skip
                _add_rows(part, share, 1e300 if other == axis else power, state)
    scale = state.scale
    for i in range(m):
        scale[i] = 1.0 / sqrt(a[i, i])
    if not factorize(a, scale):
        return
    for o in range(OUTPUTS):
        x = right[o]
        for i in range(m):
            x[i] *= scale[i]
        for k in range(m):
            x[k] /= a[k, k]
            rest, above, value = x[k + 1 :], a[k, k + 1 :], x[k]
            for i in range(len(rest)):
                rest[i] -= above[i] * value
        for r in range(m):
            i = m - 1 - r
            total = x[i]
            for k in range(i + 1, m):
                total -= a[i, k] * x[k]
            x[i] = total / a[i, i]
        for i in range(m):
            state.solved[axis, level, o, i] = x[i] * scale[i]


@kernel
def factorize(a: Array, scale: Array) -> bool:
    """Replace ``a`` (m, m), given by its lower triangle and scaled by ``scale`` (m,), by its Cholesky factor and, above
    the diagonal, the factor's transpose. Return False, with ``a`` in an undefined state, if it is not positive definite
    or not finite.

    A column is subtracted from all columns after it before the next one begins, so the inner loops run along rows and
    no sum depends on its previous term."""
    m = len(a)
    for i in range(m):
        for j in range(i + 1):
            a[i, j] = a[i, j] * scale[i] * scale[j]
        a[i, i] += 1e-9
    for k in range(m):
        if not a[k, k] > 0.0:
            return False
        a[k, k] = sqrt(a[k, k])
        for i in range(k + 1, m):
            a[i, k] /= a[k, k]
            a[k, i] = a[i, k]
        for i in range(k + 1, m):
            row, above, factor = a[i, k + 1 : i + 1], a[k, k + 1 : i + 1], a[i, k]
            for j in range(len(row)):
                row[j] -= factor * above[j]
    return True


ADAPTIVE = Family(
    AdaptiveNumbers, AdaptiveEstimator, adaptive_params, adaptive_state, adaptive_tick, adaptive_sample,
    adaptive_output, adaptive_learn,
)  # fmt: skip
