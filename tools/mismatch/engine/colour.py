"""The colour of a residual: a long autoregression that whitens it, and what correlation costs in samples.

Ordinary lags see the fast part, block means over the last 4, 16, ... samples the slow part (the heterogeneous
autoregression of Corsi, J. Financial Econometrics 7(2), 2009, equation 8): a dozen coefficients follow white noise plus
a slow wander, where a plain autoregression would need hundreds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import oaconvolve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Whitener:
    """``taps`` (k,): convolving a residual with them leaves innovations; ``taps[0] == 1``."""

    taps: Array
    innovation_rms: float

    @property
    def warm_up(self) -> int:
        """Samples at the start of a stretch that the filter spoils."""
        return self.taps.size - 1

    def apply(self, x: Array) -> Array:
        """Whitened copy of one stretch ``x`` (n,) or (n, k) without its spoilt start."""
        if x.shape[0] <= self.warm_up:
            return x[:0]
        taps = self.taps if x.ndim == 1 else self.taps[:, None]
        full = oaconvolve(x, taps, mode="full", axes=0) if self.taps.size > 1 else x
        return full[self.warm_up : x.shape[0]]


def _scales(n: int, lags: int) -> list[int]:
    scales: list[int] = []
    s = 4
    while s <= min(1024, n // 24):
        if s > lags:
            scales.append(s)
        s *= 4
    return scales


def fit_whitener(e: Array, *, lags: int = 6, stretches: list[tuple[int, int]] | None = None) -> Whitener:
    """Whitening filter of the residual ``e`` (n,), estimated by least squares over ``stretches``.

    Outliers are clipped at six robust standard deviations for the estimate, so that a spike does not own it.
    """
    stretches = stretches or [(0, e.size)]
    longest = max(b - a for a, b in stretches)
    total = sum(b - a for a, b in stretches)
    centre = float(np.median(e))
    scale = 1.4826 * float(np.median(np.abs(e - centre))) or float(np.std(e))
    if scale == 0.0 or total < 40:
        return Whitener(np.ones(1), scale or 1.0)
    e = np.clip(e - centre, -6 * scale, 6 * scale)
    lags = min(lags, total // 20, longest // 4)
    scales = [s for s in _scales(total, lags) if s < longest // 2]
    warm = max([lags, *scales])
    gram = np.zeros((lags + len(scales),) * 2)
    cross = np.zeros(lags + len(scales))
    for a, b in stretches:
        if b - a <= warm + 8:
            continue
        x = e[a:b]
        m = x.size - warm
        columns = np.empty((m, lags + len(scales)))
        for i in range(lags):
            columns[:, i] = x[warm - 1 - i : warm - 1 - i + m]
        sums = np.concatenate(([0.0], np.cumsum(x)))
        for j, s in enumerate(scales):
            columns[:, lags + j] = (sums[warm : warm + m] - sums[warm - s : warm - s + m]) / s
        gram += columns.T @ columns
        cross += columns.T @ x[warm:]
    if not np.any(gram):
        return Whitener(np.ones(1), scale)
    ridge = 1e-9 * np.trace(gram) / gram.shape[0]
    solution = np.linalg.solve(gram + ridge * np.eye(gram.shape[0]), cross)
    taps = np.zeros(warm + 1)
    taps[0] = 1.0
    taps[1 : lags + 1] -= solution[:lags]
    for j, s in enumerate(scales):
        taps[1 : s + 1] -= solution[lags + j] / s
    model = Whitener(taps, scale)
    white = np.concatenate([model.apply(e[a:b]) for a, b in stretches])
    return Whitener(taps, float(np.std(white)) if white.size else scale)


def whiten(model: Whitener, x: Array, stretches: list[tuple[int, int]]) -> Array:
    """``x`` (n,) or (n, k) whitened stretch by stretch and joined."""
    return np.concatenate([model.apply(x[a:b]) for a, b in stretches])


def autocovariance(e: Array, lags: int) -> Array:
    """Biased autocovariance at 0..``lags`` (FFT)."""
    x = e - e.mean()
    n = x.size
    size = 1 << int(np.ceil(np.log2(2 * n)))
    spectrum = np.abs(np.fft.rfft(x, size)) ** 2
    return np.fft.irfft(spectrum, size)[: min(lags, n - 1) + 1] / n


def effective_samples(e: Array) -> float:
    """How many independent samples the mean of ``e`` is worth.

    Long-run variance by Sokal's automatic window (Sokal 1996, section 3): summed until the lag exceeds six
    integrated correlation times.
    """
    gamma = autocovariance(e, e.size // 3)
    if gamma[0] <= 0:
        return float(e.size)
    time = 0.5 + np.cumsum(gamma[1:] / gamma[0])
    window = np.nonzero(np.arange(1, time.size + 1) >= 6 * time)[0]
    tau = time[window[0]] if window.size else time[-1]
    return float(np.clip(e.size / (2 * max(tau, 0.5)), 2.0, e.size))


def ljung_box(e: Array, lags: int = 25) -> float:
    """p-value of whiteness (Ljung and Box, Biometrika 65, 1978)."""
    from scipy.stats import chi2

    n = e.size
    lags = min(lags, n // 5)
    gamma = autocovariance(e, lags)
    if gamma[0] <= 0 or lags < 1:
        return 1.0
    rho = gamma[1:] / gamma[0]
    q = n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, rho.size + 1)))
    return float(chi2.sf(q, rho.size))
