"""The adaptive filter: the causal linear filter that would have served this hand best, worked out as it moves.

Some 0.4 s after the fact the tremor is known well, from samples before and after (``adaptive_design``). Regressing it
on the filter bank's states of then gives the filter that predicts it from the past alone: least squares with
exponential forgetting, in normal equations, started from the prior hand and scaled to the tremor's own size. Nothing
recursive is inverted, the matrix is positive definite by construction, and the learned filter is a weighted sum of
stable filters, so it cannot run away. What sensor noise adds to the regression is known and taken out.

Learning is on signals that pass a filter which lifts the tremor band: an error there costs more.
"""

from __future__ import annotations

from math import exp, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, new_record
from firmware_py.tremor.adaptive_design import OUTPUTS, AdaptiveDesign, design_adaptive
from firmware_py.tremor.config import TremorConfig
from hal.compiled import kernel

Array = NDArray[np.float64]
AXES = 3


def adaptive_dtype(design: AdaptiveDesign) -> np.dtype[Any]:
    m, n, slow, taps = design.bank.size, len(design.bank.pole), len(design.bank.slow), design.taps.shape[1]
    return np.dtype(
        [
            ("pole_re", "f8", (n,)),
            ("pole_im", "f8", (n,)),
            ("pole_gain", "f8", (n,)),
            ("slow", "f8", (slow,)),
            ("taps", "f8", (OUTPUTS, taps)),
            ("weight", "f8", (5,)),
            ("tremor", "f8", (m, m)),
            ("rest", "f8", (m, m)),
            ("cross", "f8", (OUTPUTS, m)),
            ("noise_cross", "f8", (OUTPUTS, m)),
            ("noise_power", "f8"),
            ("weighted_power", "f8"),
            ("least_power", "f8"),
            ("start", "f8", (OUTPUTS, m)),
            ("onward", "f8", (m,)),
            ("block_ticks", "i8"),
            ("keep", "f8"),
            ("prior_blocks", "f8"),
            ("share", "f8"),
            ("outlier", "f8"),
        ]
    )


def adaptive_state_dtype(design: AdaptiveDesign) -> np.dtype[Any]:
    m, taps = design.bank.size, design.taps.shape[1]
    return np.dtype(
        [
            ("bank", "f8", (AXES, m)),
            ("pending", "f8", (AXES,)),  # the sample that the bank holds for this tick, measured or predicted
            ("running", "i8"),
            ("weigh", "f8", (AXES, 2)),
            ("weighted", "f8", (AXES, m)),
            ("sum", "f8", (AXES,)),
            ("in_block", "i8"),
            ("blocks", "f8", (AXES, taps)),  # ring of block means
            ("snapshots", "f8", (AXES, taps // 2 + 1, m)),  # ring of bank states at the ends of blocks
            ("n_blocks", "i8"),
            ("normal", "f8", (AXES, m, m)),  # lower triangles
            ("right", "f8", (AXES, OUTPUTS, m)),
            ("power", "f8", (AXES,)),
            ("count", "f8", (AXES,)),
            ("filter", "f8", (AXES, OUTPUTS, m)),
            ("work", "f8", (m, m)),
            ("scale", "f8", (m,)),
            ("solution", "f8", (OUTPUTS, m)),
        ]
    )


def adaptive_params(config: TremorConfig, design: AdaptiveDesign | None = None) -> Record:
    """The kernels' numbers."""
    d = design or design_adaptive(config)
    a = config.adaptive
    block_s = d.block_ticks / config.tick_hz
    return new_record(
        adaptive_dtype(d),
        pole_re=d.bank.pole.real,
        pole_im=d.bank.pole.imag,
        pole_gain=1.0 - np.abs(d.bank.pole),
        slow=d.bank.slow,
        taps=d.taps,
        weight=d.weight,
        tremor=d.tremor,
        rest=d.rest,
        cross=d.cross,
        noise_cross=d.noise_cross,
        noise_power=d.noise_power,
        weighted_power=d.weighted_power,
        least_power=d.least_power,
        start=d.start,
        onward=d.onward,
        block_ticks=d.block_ticks,
        keep=exp(-block_s / a.memory_s),
        prior_blocks=a.prior_s / block_s,
        share=a.share,
        outlier=a.outlier,
    )


def adaptive_state(design: AdaptiveDesign) -> Record:
    """The prior hand's filter, nothing seen."""
    return new_record(adaptive_state_dtype(design), filter=np.tile(design.start, (AXES, 1, 1)))


@kernel
def bank_turn(bank: Array, params: Record) -> None:
    """One tick of the bank without its input; ``bank`` (m,)."""
    n = len(params.pole_re)
    for r in range(n):
        re, im = bank[2 * r], bank[2 * r + 1]
        bank[2 * r] = params.pole_re[r] * re - params.pole_im[r] * im
        bank[2 * r + 1] = params.pole_re[r] * im + params.pole_im[r] * re
    for r in range(len(params.slow)):
        bank[2 * n + r] *= params.slow[r]
    bank[len(bank) - 1] = 0.0


@kernel
def bank_add(bank: Array, sample: float, params: Record) -> None:
    """Input of one tick, after ``bank_turn``."""
    n = len(params.pole_re)
    for r in range(n):
        bank[2 * r] += params.pole_gain[r] * sample
    for r in range(len(params.slow)):
        bank[2 * n + r] += (1.0 - params.slow[r]) * sample
    bank[len(bank) - 1] += sample


@kernel
def adaptive_predict(state: Record, params: Record) -> None:
    """To the next tick: what the last one brought is learned from, the bank runs on with a predicted sample."""
    if state.running:
        _learn(state, params)
    state.running = 1
    m = len(params.onward)
    for i in range(AXES):
        bank = state.bank[i]
        sample = 0.0
        for j in range(m):
            sample += params.onward[j] * bank[j]
        bank_turn(bank, params)
        bank_add(bank, sample, params)
        state.pending[i] = sample


@kernel
def adaptive_correct(state: Record, axis: int, sample: float, params: Record) -> None:
    """The tick's own sample in place of the predicted one."""
    bank_add(state.bank[axis], sample - state.pending[axis], params)
    state.pending[axis] = sample


@kernel
def adaptive_output(state: Record, axis: int, output: int) -> float:
    """Tremor m: ``output`` 0 now, 1 over the loop's delay."""
    total = 0.0
    for j in range(state.bank.shape[1]):
        total += state.filter[axis, output, j] * state.bank[axis, j]
    return total


@kernel
def _learn(state: Record, params: Record) -> None:
    """Weighted bank and block sums take the last sample; at the end of a block the regression takes its row."""
    w = params.weight
    for i in range(AXES):
        sample = state.pending[i]
        lifted = w[0] * sample + state.weigh[i, 0]
        state.weigh[i, 0] = w[1] * sample - w[3] * lifted + state.weigh[i, 1]
        state.weigh[i, 1] = w[2] * sample - w[4] * lifted
        bank_turn(state.weighted[i], params)
        bank_add(state.weighted[i], lifted, params)
        state.sum[i] += lifted
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
        state.snapshots[i, at % (lag + 1), :] = state.weighted[i]
        # the bank must have forgotten its start: a target's length more than the target itself
        if at >= 2 * n_taps:
            _regress(state, i, at, params)
    axis = at % AXES  # one axis a block, so that no tick has to solve more than one system
    if state.count[axis] > 0.0:
        _solve(state, axis, params)


@kernel
def _regress(state: Record, axis: int, at: int, params: Record) -> None:
    """One row: bank of ``lag`` blocks ago, tremor of then and of a loop delay later."""
    n_taps = state.blocks.shape[1]
    lag = n_taps // 2
    now, ahead = 0.0, 0.0
    for j in range(n_taps):
        block = state.blocks[axis, (at - j) % n_taps]
        now += params.taps[0, j] * block
        ahead += params.taps[1, j] * block
    known = params.prior_blocks * params.weighted_power + state.power[axis]
    typical = known / (params.prior_blocks + state.count[axis])
    weight = min(1.0, params.outlier * typical / max(now * now, 1e-300))  # a jerk must not outvote the tremor
    phi = state.snapshots[axis, (at - lag) % (lag + 1)]
    keep = params.keep
    state.count[axis] = keep * state.count[axis] + weight
    state.power[axis] = keep * state.power[axis] + weight * now * now
    normal = state.normal[axis]
    right = state.right[axis]
    for i in range(len(phi)):
        scaled = weight * phi[i]
        for j in range(i + 1):
            normal[i, j] = keep * normal[i, j] + scaled * phi[j]
        right[0, i] = keep * right[0, i] + scaled * now
        right[1, i] = keep * right[1, i] + scaled * ahead


@kernel
def _solve(state: Record, axis: int, params: Record) -> None:
    """(data + prior) filter = (data + prior) cross: Cholesky of the scaled matrix, in place."""
    a = state.work
    m = len(a)
    count = state.count[axis]
    n0 = params.prior_blocks
    power = (state.power[axis] + n0 * params.weighted_power) / (count + n0) - params.noise_power * count / (count + n0)
    power = max(power, params.least_power)
    for i in range(m):
        for j in range(i + 1):
            a[i, j] = state.normal[axis, i, j] + n0 * (power * params.tremor[i, j] + params.rest[i, j])
    right = state.solution
    for i in range(m):
        for o in range(OUTPUTS):
            from_data = state.right[axis, o, i] - count * params.noise_cross[o, i]
            right[o, i] = from_data + n0 * power * params.cross[o, i]
    for other in range(AXES):
        if other == axis or state.power[other] <= 0.0:
            continue
        share = params.share * min(1.0, state.power[axis] / state.power[other])
        for i in range(m):
            for j in range(i + 1):
                a[i, j] += share * state.normal[other, i, j]
            for o in range(OUTPUTS):
                right[o, i] += share * (state.right[other, o, i] - state.count[other] * params.noise_cross[o, i])
    scale = state.scale
    for i in range(m):
        scale[i] = 1.0 / sqrt(a[i, i])
    for i in range(m):
        for j in range(i + 1):
            total = a[i, j] * scale[i] * scale[j]
            if i == j:
                total += 1e-9
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i > j:
                a[i, j] = total / a[j, j]
            elif total > 0.0:
                a[i, i] = sqrt(total)
            else:
                return  # not positive definite to rounding (or not a number): the last filter stays
    for o in range(OUTPUTS):
        x = right[o]
        for i in range(m):
            total = x[i] * scale[i]
            for k in range(i):
                total -= a[i, k] * x[k]
            x[i] = total / a[i, i]
        for r in range(m):
            i = m - 1 - r
            total = x[i]
            for k in range(i + 1, m):
                total -= a[k, i] * x[k]
            x[i] = total / a[i, i]
        for i in range(m):
            state.filter[axis, o, i] = x[i] * scale[i]
