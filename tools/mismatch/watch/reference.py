"""Calibrates the test on a reference part of the residual: a whitening filter and confidence bounds.

A residual of a good twin is coloured, heavy-tailed and known from a finite part only. The long autoregression of
``engine.colour`` whitens it; two figures are kept of each block of innovations: ``level`` (their sum) and ``power``
(the logarithm of their mean square), centred and scaled on the reference and clipped at ``CLIP`` deviations, so that
no single block decides. For each figure, side and tilt the reference gives an upper bound of the cumulant function
``log E exp(tilt * figure)``: the empirical one of a block or the Gaussian one with the long-run variance over blocks,
whichever is larger, each at the end of a one-sided confidence interval. With ``exp(tilt * figure - bound)`` as the
factor of a block, the expectation of a factor is at most 1: for independent blocks up to the confidence of the bound,
asymptotically (Gaertner and Ellis) for blocks with a memory much shorter than the reference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.linalg import toeplitz

from hal.arrays import Array
from tools.errors import InputError
from tools.mismatch.engine.colour import Whitener, fit_whitener

FIGURES = ("level", "power")
TILTS = (0.25, 0.5, 1.0, 1.5)
CLIP = 4.0
BLOCK_S = 0.1
LEAST_BLOCK = 32
"""Least number of samples of a block: the logarithm of the power of fewer is far from normal."""
LEAST_BLOCKS = 100
CONFIDENCE = 0.99
"""One-sided confidence of each bound that is taken from the reference."""
MEMORY_LAGS = 4
"""Order of the autoregression over blocks that gives the long-run variance."""
LEAST_PIECES = 10
"""Least number of independent values of the level in a reference; with fewer its mean is unknown and not watched."""
LEAST_LEFT = 0.02
"""Least value of one minus the sum of the autoregression's coefficients; a longer memory looks like a drift."""
BATCHES = 20
"""Number of batches whose means give a second estimate of the long-run variance."""


@dataclass(frozen=True)
class Channel:
    """Holds a channel of the reference.

    ``rms`` of its residual; ``wander_s``: the time that gives one independent value of its level; ``centre``, ``scale``
    (2,) of the figures of a block; ``bounds`` (2, 2, tilts) of the cumulant function, by figure, side (up, down) and
    tilt, infinite where the figure is not watched.
    """

    name: str
    rms: float
    wander_s: float
    whitener: Whitener
    offset: float
    centre: Array
    scale: Array
    bounds: Array


@dataclass(frozen=True)
class Reference:
    """Holds the calibration of the test on a good twin.

    It has the ``channels``, the time step (s), samples of a ``block``, false alarms per hour of all channels together,
    and the channels or levels that are not watched (``left_out``), with the reason.
    """

    channels: tuple[Channel, ...]
    dt: float
    block: int
    false_alarms_per_hour: float
    left_out: Mapping[str, str]

    @property
    def warm_up(self) -> int:
        """Return the number of samples before a block that whitening needs."""
        return max(c.whitener.warm_up for c in self.channels)

    @property
    def run_length(self) -> float:
        """Return the required average run length (blocks) of each channel: its Bonferroni share of the rate."""
        return len(self.channels) * 3600.0 / (self.false_alarms_per_hour * self.block * self.dt)

    def figures(self, residual: Array) -> Array:
        """Return the figures (blocks, channels, 2) of all whole blocks of ``residual`` (n, channels), in deviations.

        Blocks start after the warm-up. A figure is NaN where a sample of the block or of its warm-up is not finite.
        """
        warm, block = self.warm_up, self.block
        count = max(0, (residual.shape[0] - warm) // block)
        out = np.empty((count, len(self.channels), 2))
        used = residual[: warm + count * block]
        good = np.isfinite(used)
        for i, c in enumerate(self.channels):
            x = np.where(good[:, i], used[:, i], 0.0) - c.offset
            raw = block_figures(c.whitener.apply(x[warm - c.whitener.warm_up :]).reshape(count, block))
            out[:, i] = (raw - c.centre) / c.scale
            if not good[:, i].all():
                bad = np.concatenate(([0], np.cumsum(~good[:, i])))
                first = np.arange(count) * block
                out[bad[first + warm + block] > bad[first], i] = np.nan
        return out


def block_figures(innovations: Array) -> Array:
    """Return ``level`` and ``power`` (blocks, 2) of innovations (blocks, samples)."""
    n = innovations.shape[1]
    power = np.mean(innovations * innovations, axis=1)
    return np.stack([innovations.sum(axis=1) / math.sqrt(n), np.log(power + np.finfo(np.float64).tiny)], axis=1)


def learn(
    residuals: Mapping[str, Array], dt: float, false_alarms_per_hour: float, restarts: tuple[int, ...] = ()
) -> Reference:
    """Learn the reference from residuals (n,) of a part in which the twin is good.

    ``restarts``: samples at which a new run begins. Raises InputError if the part is too short or no channel can be
    watched.
    """
    block = max(LEAST_BLOCK, round(BLOCK_S / dt))
    n = next(iter(residuals.values())).size
    stretches = [(a, b) for a, b in zip((0, *restarts), (*restarts, n), strict=True) if b > a]
    _check_length(sum((b - a) // block for a, b in stretches), block, dt)
    channels: list[Channel] = []
    left_out: dict[str, str] = {}
    for name, residual in residuals.items():
        if not np.all(np.isfinite(residual)):
            left_out[name] = "its residual is not finite in the reference"
        elif float(np.ptp(residual)) <= 1e-12 * float(np.max(np.abs(residual))):
            left_out[name] = "its residual is constant in the reference, which gives no scale"
        else:
            channels.append(_channel(name, residual, stretches, block, dt))
    for c in channels:
        if np.isinf(c.bounds[0]).all():
            left_out[f"level of {c.name}"] = (
                f"it wanders within about {c.wander_s:.2g} s; a reference of {LEAST_PIECES * c.wander_s:.0f} s shows it"
            )
    if not channels:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise InputError(f"no channel can be watched ({reasons}); take another reference part")
    return Reference(tuple(channels), dt, block, false_alarms_per_hour, left_out)


def _channel(name: str, residual: Array, stretches: list[tuple[int, int]], block: int, dt: float) -> Channel:
    whitener = fit_whitener(residual, stretches=stretches)
    offset = float(np.mean(residual))
    parts: list[Array] = []
    for a, b in stretches:
        white = whitener.apply(residual[a:b] - offset)
        count = white.size // block
        parts.append(block_figures(white[: count * block].reshape(count, block)))
    raw = np.concatenate(parts)
    means = [residual[a : b - (b - a) % block].reshape(-1, block).mean(axis=1) for a, b in stretches]
    wander_s = correlation_blocks(np.concatenate(means)) * block * dt
    _check_length(raw.shape[0], block, dt, whitener.warm_up)
    centre, scale = raw.mean(axis=0), np.maximum(raw.std(axis=0, ddof=1), 1e-12)
    figures = np.clip((raw - centre) / scale, -CLIP, CLIP)
    bounds = np.stack([np.stack([_bound(s * figures[:, f]) for s in (1, -1)]) for f in range(2)])
    if residual.size * dt < LEAST_PIECES * wander_s:
        bounds[0] = np.inf
    return Channel(name, float(np.sqrt(np.mean(residual**2))), wander_s, whitener, offset, centre, scale, bounds)


def _check_length(blocks: int, block: int, dt: float, warm_up: int = 0) -> None:
    """Raise InputError if a reference has fewer ``blocks`` of ``block`` samples than the test needs."""
    if blocks < LEAST_BLOCKS:
        need = (LEAST_BLOCKS * block + warm_up) * dt
        raise InputError(
            f"the reference gives {blocks} blocks of {block * dt:g} s, at least {LEAST_BLOCKS} are needed: "
            f"take a longer one (about {need:.0f} s with --reference)"
        )


def correlation_blocks(means: Array) -> float:
    """Return the number of blocks equivalent to an independent one in the mean of ``means`` (blocks,), at least 1."""
    variance, phi, innovation, _ = _autoregression(means - means.mean())
    return max(1.0, innovation / max(1.0 - float(phi.sum()), LEAST_LEFT) ** 2 / variance) if variance else 1.0


def _bound(x: Array) -> Array:
    """Return upper confidence bounds (tilts,) of the cumulant function of the figures ``x`` (blocks,)."""
    n = x.size
    memory = long_run_variance(x)
    quantile = float(stats.t.ppf(CONFIDENCE, n - 1))
    tilts = np.array(TILTS)
    factors = np.exp(tilts * x[:, None])
    error = factors.std(axis=0, ddof=1) * math.sqrt(memory / n)
    shape = np.log(factors.mean(axis=0) + quantile * error)
    gaussian = tilts * (x.mean() + quantile * math.sqrt(memory / n)) + 0.5 * tilts**2 * memory
    return np.maximum(shape, gaussian)


def long_run_variance(x: Array) -> float:
    """Return an upper confidence bound of the variance of a sum of ``x`` (n,) per term.

    It is the spectral density at zero of an autoregression (Yule-Walker), or the variance of batch means if larger.
    """
    n = x.size
    variance, phi, innovation, error = _autoregression(x - x.mean())
    if variance == 0.0:
        return 1.0
    quantile = float(stats.norm.ppf(CONFIDENCE))
    left = max(1.0 - float(phi.sum()) - quantile * error, LEAST_LEFT)
    by_model = innovation / left**2
    m = n // BATCHES
    by_batches = m * float(np.var(x[: m * BATCHES].reshape(BATCHES, m).mean(axis=1), ddof=1))
    return max(variance, by_model, by_batches)


def _autoregression(c: Array) -> tuple[float, Array, float, float]:
    """Fit an autoregression to ``c`` (n,) of mean 0.

    Returns the variance, the coefficients, the innovation variance and the standard error of the coefficients' sum.
    """
    n = c.size
    gamma = np.array([float(c[: n - k] @ c[k:]) / n for k in range(MEMORY_LAGS + 1)])
    if gamma[0] == 0.0:
        return 0.0, np.zeros(MEMORY_LAGS), 0.0, 0.0
    inverse = np.linalg.inv(toeplitz(gamma[:-1]) + 1e-9 * gamma[0] * np.eye(MEMORY_LAGS))
    phi = inverse @ gamma[1:]
    innovation = max(float(gamma[0] - phi @ gamma[1:]), 0.0)
    return float(gamma[0]), phi, innovation, math.sqrt(innovation * float(inverse.sum()) / n)
