"""Noise with a law of its own is weighed by what each sample says of the next."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm

from sim_devices.physics.drift import local_level, local_slope, predict_walk
from tools.mismatch.infer.density import predictable


def _walk(n: int, dt: float, per_root_s: float, noise: float, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(per_root_s * np.sqrt(dt) * rng.standard_normal(n)) + noise * rng.standard_normal(n)


def test_one_step_predictions_have_the_likelihood_of_the_joint_normal_distribution() -> None:
    n, ratio = 12, 0.7
    gap_s = np.array([0.0, 0.1, 0.1, 0.5, *([0.1] * 8)])
    y = _walk(n, 0.1, 1.0, 1.0)
    error, deviation = local_level(y, gap_s, np.ones(n, np.bool_), ratio, 0.0)
    t = np.cumsum(gap_s)
    # given the first sample, the level there is normal about it with the noise's variance
    cov = ratio * np.minimum.outer(t[1:], t[1:]) + np.eye(n - 1) + 1.0
    _, logdet = np.linalg.slogdet(cov)
    d = y[1:] - y[0]
    joint = -0.5 * (d @ np.linalg.solve(cov, d) + logdet + (n - 1) * np.log(2 * np.pi))
    assert norm.logpdf(error[1:], scale=deviation[1:]).sum() == pytest.approx(joint, rel=1e-12)


def test_a_sample_that_is_not_believed_moves_no_later_prediction() -> None:
    y, gap_s = _walk(50, 0.1, 1.0, 0.3), np.full(50, 0.1)
    believed = np.arange(50) != 20
    spoiled = y.copy()
    spoiled[20] += 100.0
    a, b = (local_level(v, gap_s, believed, 5.0, 0.0) for v in (y, spoiled))
    assert np.array_equal(np.delete(a[0], 20), np.delete(b[0], 20))
    assert np.array_equal(a[1], b[1])


def test_the_ratio_of_walk_and_noise_is_found() -> None:
    n, dt = 6000, 0.01
    y, every = _walk(n, dt, 0.8, 0.2), np.ones(n, np.bool_)
    error, deviation = predict_walk(y, np.full(n, dt), every, every, 0.0)
    normal = (error / deviation)[50:]
    assert np.std(normal) == pytest.approx(0.2, rel=0.05)
    assert abs(np.corrcoef(normal[1:], normal[:-1])[0, 1]) < 0.04


@pytest.mark.parametrize("what", ["smooth", "forgets"])
def test_what_is_smooth_or_forgets_is_no_walk(what: str) -> None:
    n, dt = 4000, 0.01
    rng, every = np.random.default_rng(8), np.ones(n, np.bool_)
    t = dt * np.arange(n)
    drift = 2.0 * np.exp(-t / 9.0) if what == "smooth" else 0.4 * lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))
    y = drift + 0.2 * rng.standard_normal(n)
    error, deviation = predict_walk(y, np.full(n, dt), every, every, 0.2)
    assert np.array_equal(error, y)
    assert np.all(deviation == 1.0)


def test_a_smooth_trend_has_the_likelihood_of_its_joint_normal_distribution() -> None:
    n, ratio, dt = 9, 0.3, 0.2
    y = np.random.default_rng(1).standard_normal(n).cumsum()
    error, deviation = local_slope(y, np.full(n, dt), np.ones(n, np.bool_), ratio)
    t = dt * np.arange(1, n)
    slope = 1e6 * ratio + 1e-12
    s, u = np.minimum.outer(t, t), np.maximum.outer(t, t)
    cov = ratio * (s**2 * u / 2 - s**3 / 6) + slope * np.outer(t, t) + np.eye(n - 1) + 1.0
    _, logdet = np.linalg.slogdet(cov)
    d = y[1:] - y[0]
    joint = -0.5 * (d @ np.linalg.solve(cov, d) + logdet + (n - 1) * np.log(2 * np.pi))
    assert norm.logpdf(error[1:], scale=deviation[1:]).sum() == pytest.approx(joint, rel=1e-6)


def test_a_model_that_diverges_where_it_is_scored_follows_no_law_of_noise() -> None:
    e = np.random.default_rng(1).standard_normal(600)
    rows: Any = SimpleNamespace(fit_rows=np.arange(0, 300), held_rows=np.arange(310, 600))
    white = predictable(rows, e)
    assert 0.0 <= white < 0.02
    for outside in (np.nan, np.inf):
        assert predictable(rows, np.where(np.arange(600) == 305, outside, e)) == pytest.approx(white, abs=0.01)
        assert predictable(rows, np.where(np.arange(600) == 400, outside, e)) == math.inf
        assert predictable(rows, np.where(np.arange(600) == 20, outside, e)) == math.inf
