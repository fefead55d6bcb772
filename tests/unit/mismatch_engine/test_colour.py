"""Whitening: the compiled recursion is the filter it says, and leaves white what it was fitted to."""

import numpy as np
from scipy.signal import lfilter

from tools.mismatch.engine.colour import Whitener, fit_whitener, whiten, whiten_stretch


def test_recursion_equals_a_plain_convolution() -> None:
    rng = np.random.default_rng(0)
    x = 3.0 + rng.standard_normal((400, 2))
    model = Whitener(1.0, np.array([0.4, -0.1]), np.array([4, 16]), np.array([0.3, 0.2]))
    taps = np.zeros(17)
    taps[:3] = 1.0, -0.4, 0.1
    taps[1:5] -= 0.3 / 4
    taps[1:17] -= 0.2 / 16
    for columns in (x, x[:, 0]):
        np.testing.assert_allclose(model.apply(columns), lfilter(taps, 1.0, columns, axis=0)[16:], atol=1e-12)
    args = (np.ascontiguousarray(x[:60].T), model.lags, model.scales, model.weights, 16)
    np.testing.assert_allclose(whiten_stretch(*args), whiten_stretch.py_func(*args), atol=1e-13)


def test_whitens_white_noise_plus_slow_wander() -> None:
    rng = np.random.default_rng(1)
    e = rng.standard_normal(20_000) + lfilter([0.02], [1.0, -0.999], rng.standard_normal(20_000))
    spans = [(0, 9000), (9500, 20_000)]
    model = fit_whitener(e, stretches=spans)
    white = whiten(model, e, spans)
    assert white.size == sum(b - a - model.warm_up for a, b in spans)
    assert abs(np.corrcoef(white[:-1], white[1:])[0, 1]) < 0.03
    means = white[: white.size // 200 * 200].reshape(-1, 200).mean(axis=1)
    assert means.std() * np.sqrt(200) < 1.35 * white.std()
    assert Whitener(1.0).apply(e) is e
