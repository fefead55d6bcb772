"""The log2 histogram against numpy's percentiles of the same values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.scheduler.histogram import DurationHistogram, bucket_bounds_ns, bucket_of


@given(st.integers(0, 2**36 - 1))
def test_a_value_lies_in_its_bucket_and_the_bucket_is_narrow(value: int) -> None:
    lo, width = bucket_bounds_ns(bucket_of(value))
    assert lo <= value < lo + width
    assert width == 1 or width <= lo / 16


def test_buckets_are_contiguous() -> None:
    last, _ = bucket_bounds_ns(bucket_of(2**36 - 1))
    end = 0
    for index in range(bucket_of(last) + 1):
        lo, width = bucket_bounds_ns(index)
        assert lo == end
        end = lo + width
    assert end == 2**36


@given(st.integers(0, 2**40))
def test_add_uses_the_bucket_of_the_value(value: int) -> None:
    histogram = DurationHistogram()
    histogram.add(value, 0)
    assert np.flatnonzero(histogram.counts()).tolist() == [bucket_of(value)]


@pytest.mark.parametrize("shape", ["lognormal", "uniform", "two peaks", "exponential"])
def test_quantiles_are_good_to_five_percent(shape: str) -> None:
    rng = np.random.default_rng(7)
    values = {
        "lognormal": rng.lognormal(11, 1.2, 20_000),
        "uniform": rng.uniform(100, 1e6, 20_000),
        "two peaks": np.concatenate([rng.normal(12_000, 300, 19_900), rng.normal(4e6, 1e5, 100)]),
        "exponential": rng.exponential(50_000, 20_000),
    }[shape].astype(np.int64)
    histogram = DurationHistogram()
    for k, value in enumerate(values.tolist()):
        histogram.add(value, k)
    for q in (0.01, 0.5, 0.9, 0.99, 0.999):
        truth = np.quantile(values, q, method="inverted_cdf")
        assert histogram.quantile_ns(q) == pytest.approx(truth, rel=0.033)
    summary = histogram.distribution()
    assert summary.n == 20_000
    assert summary.max_us == values.max() * 1e-3
    assert summary.min_us == values.min() * 1e-3
    assert summary.max_tick == int(np.argmax(values))
    assert summary.mean_us == pytest.approx(values.mean() * 1e-3)


def test_extremes_are_exact_and_a_negative_lateness_is_zero() -> None:
    histogram = DurationHistogram()
    for tick, value in enumerate((1_000_003, -5, 77)):
        histogram.add(value, tick)
    summary = histogram.distribution()
    assert (summary.min_us, summary.max_us, summary.max_tick) == (0.0, 1000.003, 0)
    assert summary.p99_9_us == 1000.003 or summary.p99_9_us == pytest.approx(1000.003, rel=0.033)
    assert summary.p99_9_us <= summary.max_us


def test_empty_and_cleared_histograms_say_zero() -> None:
    histogram = DurationHistogram()
    empty = histogram.distribution()
    assert (empty.n, empty.p99_us, empty.max_tick) == (0, 0.0, -1)
    histogram.add(123_456, 9)
    histogram.clear()
    assert histogram.distribution() == empty
    assert not histogram.counts().any()
