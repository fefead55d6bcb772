"""The bound on drifts, against closed forms and a simulated matched filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from tools.research.faults import drift_bound as db


def test_in_white_noise_it_is_the_sum_of_squares():
    """d^2 = sum (rate k dt)^2 / sigma^2 for k = 1..n; the other axes say nothing."""
    sigma = 2.5e-3
    white = db.Whitener(np.zeros((db.ORDER, 6, 6)), np.eye(6) * sigma**2)
    expected = np.sqrt(np.sum((0.05e-3 * np.arange(1, 41)) ** 2)) / sigma
    assert white.signal_to_noise(0.05, 2, 40.9) == pytest.approx(expected, rel=1e-12)


def test_a_known_autoregression_is_found_again():
    rng = np.random.default_rng(3)
    mixing = np.eye(6) + 0.1 * rng.normal(size=(6, 6))
    covariance = mixing @ mixing.T * 1e-6
    first = 0.6 * np.eye(6) + 0.1 * np.eye(6, k=1)
    noise = rng.multivariate_normal(np.zeros(6), covariance, size=20_000)
    x = np.zeros_like(noise)
    for k in range(1, len(x)):
        x[k] = first @ x[k - 1] + noise[k]
    found = db.whitener(x)
    np.testing.assert_allclose(found.coefficients[0], first, atol=0.04)
    five_deviations = 5.0 * np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)) / len(x))
    assert np.all(
        np.abs(found.covariance - covariance) < 2.0**0.5 * five_deviations
    )  # variances have twice the variance


def test_the_power_is_that_of_a_matched_filter_on_drawn_noise():
    d, per_hour = 3.0, 1e4
    limit = norm.isf(db.FALSE_PER_HOUR / per_hour)
    draws = np.random.default_rng(5).normal(d, 1.0, 200_000)
    assert db.seen(d, per_hour) == pytest.approx(np.mean(draws > limit), abs=0.003)
    assert db.seen(0.0, per_hour) == pytest.approx(db.FALSE_PER_HOUR / per_hour, rel=1e-6)
