"""Models the colour of a residual by a long autoregression that whitens it.

Ordinary lags model the fast part, block means over the last 4, 16, ... samples the slow part (the heterogeneous
autoregression of Corsi, J. Financial Econometrics 7(2), 2009, equation 8): a dozen coefficients follow white noise plus
a slow wander, where a plain autoregression would need hundreds.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.compiled import kernel

AT_ONCE = 2048  # number of samples that stay in the processor's first cache while all coefficients are applied


@kernel
def whiten_stretch(x, lags, scales, weights, warm):
    """Return the innovations (k, n - warm) of a stretch x (k, n), a signal per row.

    From each sample ``lags[i]`` times the sample i + 1 before it and ``weights[j]`` times the mean of the ``scales[j]``
    samples before it are subtracted.
    """
    k, n = x.shape
    out = np.empty((k, n - warm))
    sums = np.zeros(n + 1)
    for c in range(k):
        for i in range(n):
            sums[i + 1] = sums[i] + x[c, i]
        for first in range(warm, n, AT_ONCE):
            last = min(first + AT_ONCE, n)
            here = out[c, first - warm : last - warm]
            here[:] = x[c, first:last]
            # each coefficient is applied to many samples at once, so that the loops run in vector registers
            for a in range(lags.size):
                gain = lags[a]
                before = x[c, first - 1 - a : last - 1 - a]
                for i in range(here.size):
                    here[i] -= gain * before[i]
            for j in range(scales.size):
                gain = weights[j] / scales[j]
                until = sums[first:last]
                since = sums[first - scales[j] : last - scales[j]]
                for i in range(here.size):
                    here[i] -= gain * (until[i] - since[i])
    return out


@dataclass(frozen=True)
class Whitener:
    """Whitens a residual by coefficients on the last samples (``lags``) and on the means of the last ``scales[j]``
    samples (``weights``).
    """

    innovation_rms: float
    lags: Array = field(default_factory=lambda: np.zeros(0))
    scales: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    weights: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def warm_up(self) -> int:
        """Return the number of samples at the start of a stretch that cannot be whitened."""
        return int(max(self.lags.size, self.scales.max(initial=0)))

    def spectrum(self, cycles: Array) -> Array:
        """Return the power (k,) of the residual at ``cycles`` (k,) per sample; its mean over -1/2..1/2 is its power."""
        back = -2j * np.pi * np.asarray(cycles)
        answer = np.ones(back.size, complex)
        for i, a in enumerate(self.lags):
            answer -= a * np.exp(back * (i + 1))
        for s, w in zip(self.scales, self.weights, strict=True):
            at = np.exp(back)
            with np.errstate(all="ignore"):
                mean = np.where(np.abs(1 - at) > 1e-9, at * (1 - at**s) / (s * (1 - at)), 1.0)
            answer -= w * mean
        return self.innovation_rms**2 / np.maximum(np.abs(answer) ** 2, 1e-4)

    def apply(self, x: Array) -> Array:
        """Return a whitened copy of a stretch ``x`` (n,) or (n, k) without its first ``warm_up`` samples."""
        warm = self.warm_up
        if x.shape[0] <= warm:
            return x[:0]
        if warm == 0:
            return x
        signals = np.ascontiguousarray(x.T if x.ndim == 2 else x[None, :], np.float64)
        out = whiten_stretch(signals, self.lags, self.scales, self.weights, warm)
        return out.T if x.ndim == 2 else out[0]


def _scales(n: int, lags: int) -> list[int]:
    scales: list[int] = []
    s = 4
    while s <= min(1024, n // 24):
        if s > lags:
            scales.append(s)
        s *= 4
    return scales


def fit_whitener(e: Array, *, lags: int = 6, stretches: list[tuple[int, int]] | None = None) -> Whitener:
    """Estimate the whitening filter of the residual ``e`` (n,) by least squares over ``stretches``.

    Outliers are clipped at six robust standard deviations for the estimate, so that a spike does not dominate it.
    """
    stretches = stretches or [(0, e.size)]
    longest = max(b - a for a, b in stretches)
    total = sum(b - a for a, b in stretches)
    centre = float(np.median(e))
    scale = 1.4826 * float(np.median(np.abs(e - centre))) or float(np.std(e))
    if scale == 0.0 or total < 40:
        return Whitener(scale or 1.0)
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
        return Whitener(scale)
    ridge = 1e-9 * np.trace(gram) / gram.shape[0]
    solution = np.linalg.solve(gram + ridge * np.eye(gram.shape[0]), cross)
    found = (solution[:lags].copy(), np.array(scales, np.int64), solution[lags:].copy())
    model = Whitener(scale, *found)
    white = np.concatenate([model.apply(e[a:b]) for a, b in stretches])
    return Whitener(float(np.std(white)) if white.size else scale, *found)


def whiten(model: Whitener, x: Array, stretches: list[tuple[int, int]]) -> Array:
    """Return ``x`` (n,) or (n, k), whitened stretch by stretch and joined."""
    return np.concatenate([model.apply(x[a:b]) for a, b in stretches])


def autocovariance(e: Array, lags: int) -> Array:
    """Return the biased autocovariance at 0..``lags`` (by FFT)."""
    x = e - e.mean()
    n = x.size
    size = 1 << int(np.ceil(np.log2(2 * n)))
    spectrum = np.abs(np.fft.rfft(x, size)) ** 2
    return np.fft.irfft(spectrum, size)[: min(lags, n - 1) + 1] / n


def ljung_box(e: Array, lags: int = 25) -> float:
    """Return the p-value of whiteness (Ljung and Box, Biometrika 65, 1978)."""
    from scipy.stats import chi2

    n = e.size
    lags = min(lags, n // 5)
    gamma = autocovariance(e, lags)
    if gamma[0] <= 0 or lags < 1:
        return 1.0
    rho = gamma[1:] / gamma[0]
    q = n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, rho.size + 1)))
    return float(chi2.sf(q, rho.size))
