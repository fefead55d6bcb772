"""Implements the sequential test: an e-detector per channel, causal, block by block.

Principle: Shin, Ramdas and Rinaldo, E-detectors, New England Journal of Statistics in Data Science 2(2), 2024. Where
the factor ``e`` of a block has expectation at most 1 given the past, ``M <- (1 + M) e`` (the recursion of Shiryaev and
Roberts) has expectation at most the number of blocks, so stopping at ``M >= A`` has an average run length of at least
``A`` blocks without further assumptions; the mean of several ``M`` does, too. Each channel has one ``M`` per figure,
side and tilt (``reference``) and alarms where their mean reaches its Bonferroni share of the stated rate. Page's CUSUM
of the same factors runs beside each and dates the onset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tools.mismatch.watch.reference import CLIP, FIGURES, TILTS, Array, Reference

SIDES = (1.0, -1.0)
MEMBERS = len(FIGURES) * len(SIDES) * len(TILTS)

NAMES_SHARE = 0.7
"""Share of the largest CUSUM from which a member may name a change."""


@dataclass(frozen=True)
class Alarm:
    """Reports that a channel departed from its twin.

    ``t_s``: end of the block that raised the alarm; ``onset_s``: estimated onset of the change; both since the first
    sample. ``figure``: level or power of the whitened residual; ``rises``: its direction; ``size``: its mean since the
    onset, in deviations of a block.
    """

    channel: str
    t_s: float
    onset_s: float
    figure: str
    rises: bool
    size: float


@dataclass(frozen=True)
class State:
    """Holds the state of the test.

    It consists of the last samples (n, channels), the number of samples and blocks seen, and per channel and member the
    logarithm of M, the CUSUM of its log factors and the block at which that was last zero.
    """

    recent: Array
    samples: int
    blocks: int
    log_m: Array
    cusum: Array
    since: NDArray[np.int64]
    sums: Array
    """Sum of the figures since ``since``, by channel and member."""


def begin(reference: Reference) -> State:
    """Return the state before the first sample."""
    shape = (len(reference.channels), MEMBERS)
    return State(
        np.zeros((0, shape[0])), 0, 0, np.full(shape, -np.inf), np.zeros(shape), np.zeros(shape, np.int64),
        np.zeros(shape),
    )  # fmt: skip


def interrupt(state: State) -> State:
    """Return the state at the start of a new run: the memory of the whitening is dropped, the evidence is kept."""
    return replace(state, recent=state.recent[:0])


def follow(reference: Reference, state: State, residual: Array) -> tuple[State, list[Alarm]]:
    """Process further residuals (n, channels), any number of samples. A channel restarts after its alarm."""
    data = np.concatenate([state.recent, residual])
    samples = state.samples + residual.shape[0]
    figures = reference.figures(data)
    first_s = (samples - data.shape[0] + reference.warm_up) * reference.dt
    block_s = reference.block * reference.dt
    log_m, cusum = state.log_m.copy(), state.cusum.copy()
    since, sums = state.since.copy(), state.sums.copy()
    bounds = np.stack([c.bounds.reshape(-1) for c in reference.channels])
    steps = np.outer(SIDES, TILTS)
    limit = math.log(reference.run_length * MEMBERS)
    alarms: list[Alarm] = []
    for k in range(figures.shape[0]):
        block = state.blocks + k
        z = figures[k]
        gains = (np.clip(z, -CLIP, CLIP)[:, :, None, None] * steps).reshape(log_m.shape) - bounds
        spread = np.repeat(z, MEMBERS // 2, axis=1)
        if np.isnan(z).any():
            lost = np.isnan(gains)
            gains[lost], spread[lost] = 0.0, 0.0
            log_m = np.where(lost, log_m, np.logaddexp(0.0, log_m) + gains)
        else:
            log_m = np.logaddexp(0.0, log_m) + gains
        cusum = cusum + gains
        sums += spread
        fresh = cusum <= 0.0
        cusum[fresh], sums[fresh], since[fresh] = 0.0, 0.0, block + 1
        total = np.logaddexp.reduce(log_m, axis=1)
        for i in np.flatnonzero(total >= limit).tolist():
            at_s = first_s + (k + 1) * block_s
            alarms.append(_alarm(reference, i, cusum[i], at_s=at_s, block=block, since=since[i], sums=sums[i]))
            log_m[i], cusum[i], sums[i], since[i] = -np.inf, 0.0, 0.0, block + 1
    kept = data[figures.shape[0] * reference.block :]
    return State(kept, samples, state.blocks + figures.shape[0], log_m, cusum, since, sums), alarms


def _alarm(
    reference: Reference, i: int, cusum: Array, *, at_s: float, block: int, since: NDArray[np.int64], sums: Array
) -> Alarm:
    counts = np.maximum(block + 1 - since, 1)
    # clipped figures are alike: among the members with the evidence, the one that moved most names the change
    member = int(np.argmax(np.where(cusum >= NAMES_SHARE * cusum.max(), np.abs(sums) / counts, -1.0)))
    count = int(counts[member])
    per = len(SIDES) * len(TILTS)
    return Alarm(
        channel=reference.channels[i].name,
        t_s=at_s,
        onset_s=max(0.0, at_s - count * reference.block * reference.dt),
        figure=FIGURES[member // per],
        rises=SIDES[member % per // len(TILTS)] > 0,
        size=float(sums[member]) / count,
    )
