"""Decimation loses nothing: against a plain loop over all samples, at every zoom."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.frame import Layout
from tools.bench.history import BLOCK, History, rows_per_bucket
from tools.bench.wire import HEADER, encode
from tools.diagnose.extremes import extremes


def layout(columns: int) -> Layout:
    """The frame of an instrument with a time and ``columns - 1`` values."""
    values = tuple(str(i) for i in range(columns - 1))
    return Layout("test", [("t", "s", (), ""), ("x", "1", values, "")], plotted=("x",), held=("x_0", 1))


def filled(
    n: int, *, fine: int = 4096, coarse: int = 8192, chunk: int = 17, seed: int = 0
) -> tuple[History, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((n, 3)).astype(np.float32).astype(np.float64)
    rows[:, 0] = np.arange(n) * 1e-3
    history = History(layout(3), fine, coarse)
    for start in range(0, n, chunk):
        history.append(rows[start : start + chunk])
    return history, rows


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 3000), k=st.integers(1, 200), chunk=st.integers(1, 400))
def test_every_bucket_holds_the_extremes_of_its_rows(n: int, k: int, chunk: int):
    k = rows_per_bucket(k * 10, 10)
    history, rows = filled(n, chunk=chunk)
    found = history.buckets(np.array([1, 2]), k, 0)
    complete = n if k < BLOCK else n // BLOCK * BLOCK
    parts = [rows[i : min(i + k, complete)] for i in range(0, complete, k)]
    assert found.t_s.tolist() == [part[0, 0] for part in parts]
    expected = [[*part[:, 1:].min(axis=0), *part[:, 1:].max(axis=0)] for part in parts]
    np.testing.assert_array_equal(np.vstack([found.low, found.high]).T, np.reshape(expected, (len(parts), 4)))


@pytest.mark.parametrize("pixels", [40, 400, 1300])
@pytest.mark.parametrize("rows", [500, 5000, 60_000])
def test_a_spike_of_two_samples_is_in_every_zoom(rows: int, pixels: int):
    data = np.zeros((rows, 2))
    data[rows // 3 : rows // 3 + 2, 1] = 5.0
    history = History(layout(2), 1 << 16, 1 << 17)
    history.append(data)
    found = history.buckets(np.array([1]), rows_per_bucket(rows, pixels), 0)
    assert found.high.max() == 5.0
    assert found.t_s.size <= max(2 * pixels, BLOCK * pixels)


def test_what_was_overwritten_is_left_out_and_the_rest_is_right():
    history, rows = filled(10_000, fine=1024, coarse=4096)
    fine = history.buckets(np.array([1]), 1, 0)
    assert fine.first == 10_000 - 1024
    np.testing.assert_array_equal(fine.low[0], rows[-1024:, 1].astype(np.float32))
    coarse = history.buckets(np.array([1]), 32, 0)
    whole = rows[coarse.first * 32 : 10_000 // BLOCK * BLOCK, 1]
    assert coarse.low.min() == whole.min().astype(np.float32)
    assert coarse.high.max() == whole.max().astype(np.float32)


def test_buckets_do_not_depend_on_when_they_are_asked_for():
    early, _ = filled(1600)
    late, _ = filled(2400)
    for k in (4, 16, 48):
        a = early.buckets(np.array([1]), k, 3, 20)
        b = late.buckets(np.array([1]), k, 3, 20)
        np.testing.assert_array_equal(a.low, b.low)
        np.testing.assert_array_equal(a.high, b.high)


def test_not_a_number_hides_nothing():
    data = np.array([[np.nan, 1.0, 3.0, np.nan]], dtype=np.float32)
    low, high = extremes(data, data, 2)
    np.testing.assert_array_equal(low, [[1.0, 3.0]])
    np.testing.assert_array_equal(high, [[1.0, 3.0]])


def test_a_message_holds_what_was_encoded():
    history, _ = filled(100)
    buckets = history.buckets(np.array([1, 2]), 3, 0)
    message = encode(buckets, 7)
    kind, subscription, channels, n, k, flags, first = HEADER.unpack_from(message)
    assert (kind, subscription, channels, n, k, flags, first) == (1, 7, 2, 34, 3, 0, 0.0)
    t_s = np.frombuffer(message, "<f8", n, HEADER.size)
    values = np.frombuffer(message, "<f4", 2 * channels * n, HEADER.size + 8 * n).reshape(2, channels, n)
    np.testing.assert_array_equal(t_s, buckets.t_s)
    np.testing.assert_array_equal(values[0], buckets.low)
    np.testing.assert_array_equal(values[1], buckets.high)
