"""Priors of many weights: what maximises the evidence, what the data determine, and what stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from hal.arrays import Array
from tools.mismatch.engine.projected import evidence


def none(size: Array) -> Array:
    return np.zeros((size.size, size.size))


def drawn(rows: int, k: int, seed: int, deviation: float) -> tuple[Array, Array]:
    """Columns of unit norm that are much alike, and values of weights of this deviation in noise of 0.9."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(size=(rows, k)), axis=1) + 3.0 * rng.normal(size=(rows, 1))
    x /= np.linalg.norm(x, axis=0)
    return x, x @ rng.normal(0.0, deviation, k) + 0.9 * rng.normal(size=rows)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_prior_maximises_the_likelihood_of_the_data(seed: int) -> None:
    x, y = drawn(60, 8, seed, 6.0)
    precision, freedom = evidence(x.T @ x, x.T @ y, (float(y @ y), y.size), [np.arange(8)], none)

    def against(log_precision: float) -> float:
        cov = np.eye(60) + x @ x.T * np.exp(-log_precision)
        return -float(multivariate_normal.logpdf(y, cov=cov))

    best = minimize_scalar(against, bounds=(-12.0, 6.0), method="bounded").x
    assert np.ptp(precision) < 1e-9 * precision[0]
    # the steps end when they hardly matter
    assert against(float(np.log(precision[0]))) < against(float(best)) + 0.05
    hat = x @ np.linalg.inv(x.T @ x + np.diag(precision)) @ x.T
    assert float(np.sum(freedom)) == pytest.approx(float(np.trace(hat)), abs=0.1)


def test_weights_that_are_not_there_are_shrunk_away_and_others_are_left_alone() -> None:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(400, 9))
    x /= np.linalg.norm(x, axis=0)
    y = x[:, :4] @ np.full(4, 40.0) + 30.0 * x[:, 8] + rng.normal(size=400)
    families = [np.arange(4), np.arange(4, 8)]
    precision, freedom = evidence(x.T @ x, x.T @ y, (float(y @ y), 400), families, none)
    assert np.sum(freedom[:4]) > 3.9
    assert np.sum(freedom[4:8]) < 2.0
    assert (precision[8], freedom[8]) == (0.0, 1.0)
    w = np.linalg.solve(x.T @ x + np.diag(precision), x.T @ y)
    plain = np.linalg.lstsq(x, y, rcond=None)[0]
    assert np.sum(w[4:8] ** 2) < np.sum(plain[4:8] ** 2)
    assert w[8] == pytest.approx(plain[8], abs=0.5)
