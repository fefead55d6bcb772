"""Delayed and stretched time: signals at other instants than their samples, and how late one is."""

from __future__ import annotations

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array


@kernel
def resample(x, first, step, bend):
    """Return x at ``first + step * k + bend * k^2`` (samples), k = 0..n-1, by cubic convolution; edges are held.

    R. Keys, IEEE Trans. ASSP 29 (1981) 1153, eq. 15 (a = -1/2).
    """
    n = x.size
    y = np.empty(n)
    for k in range(n):
        p = first + (step + bend * k) * k
        if p <= 0.0:
            y[k] = x[0]
            continue
        if p >= n - 1:
            y[k] = x[n - 1]
            continue
        i = int(p)
        s = p - i
        a = x[i - 1] if i > 0 else 2 * x[0] - x[1]
        b = x[i]
        c = x[i + 1]
        d = x[i + 2] if i + 2 < n else 2 * x[n - 1] - x[n - 2]
        y[k] = b + 0.5 * s * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a)))
    return y


@kernel
def resample_straight(x, first, step, bend):
    """Resample as ``resample`` does, on straight lines between samples, as a played-back signal runs."""
    n = x.size
    y = np.empty(n)
    for k in range(n):
        p = first + (step + bend * k) * k
        if p <= 0.0:
            y[k] = x[0]
        elif p >= n - 1:
            y[k] = x[n - 1]
        else:
            i = int(p)
            y[k] = x[i] + (p - i) * (x[i + 1] - x[i])
    return y


def delay_by_correlation(x: Array, y: Array, longest: int) -> float:
    """Return the samples by which y lags x, from the refined peak of the cross-correlation of their differences."""
    n = x.size
    a, b = np.diff(x - x.mean()), np.diff(y - y.mean())
    size = 1 << int(np.ceil(np.log2(2 * n)))
    c = np.fft.irfft(np.fft.rfft(b, size) * np.conj(np.fft.rfft(a, size)), size)
    longest = min(longest, n // 2)
    c = np.concatenate([c[-longest:], c[: longest + 1]])
    k = int(np.argmax(np.abs(c)))
    fine = 0.0
    if 0 < k < c.size - 1:
        left, peak, right = abs(c[k - 1]), abs(c[k]), abs(c[k + 1])
        bend = left - 2 * peak + right
        fine = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return k - longest + fine
