"""The scan timeline against clocks that are known because the test made them."""

from __future__ import annotations

import numpy as np
import pytest

from hal.scan_time import ScanTimeline

MS = 1_000_000


def run(n: int, skew_ppm: float, jitter_us: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(error of every stamp in us, stamps): true scan times run ``skew_ppm`` slow, arrivals late by jitter."""
    rng = np.random.default_rng(seed)
    true_ns = (5 * MS + np.arange(n) * MS * (1 + skew_ppm * 1e-6)).astype(np.int64)
    arrival_ns = np.maximum.accumulate(true_ns + (rng.exponential(jitter_us, n) * 1000).astype(np.int64))
    line = ScanTimeline(float(MS))
    stamps = np.array([line.stamp(1, int(a))[0] for a in arrival_ns])
    assert (stamps <= arrival_ns).all()
    return (stamps - true_ns) / 1000.0, stamps


def test_exact_arrivals_give_exact_times():
    error_us, _ = run(2000, 0.0, 0.0)
    assert (error_us == 0.0).all()


@pytest.mark.parametrize("skew_ppm", [-100.0, 100.0])
def test_clocks_that_differ_are_tracked(skew_ppm: float):
    error_us, stamps = run(20_000, skew_ppm, 0.0)
    # 100 ppm untracked would be 2 ms at the end; one window at 100 ppm is 12.8 us
    assert np.abs(error_us[5000:]).max() < 2.0
    assert np.abs(error_us).max() < 60.0
    assert (np.diff(stamps) > 0).all()


def test_jitter_is_averaged_away():
    error_us, stamps = run(20_000, 30.0, 200.0)
    # arrivals scatter by 200 us rms; the stamps must not
    assert np.std(error_us[5000:]) < 10.0
    assert np.abs(np.diff(stamps)[5000:] - MS).max() < 50_000


def test_bunched_arrivals_keep_their_spacing():
    line = ScanTimeline(float(MS))
    assert line.stamp(1, 10 * MS) == (10 * MS, 0, 0)
    assert line.stamp(4, 14 * MS) == (11 * MS, 1, 0)
    assert line.next_seq == 5


def test_a_late_start_is_corrected_at_once():
    line = ScanTimeline(float(MS))
    line.stamp(1, 18 * MS)  # scan 0 was due at 10 ms, the host woke up late
    for k in range(1, 20):
        t_ns, seq, _ = line.stamp(1, max(18, 10 + k) * MS + k)
    assert (t_ns, seq) == (29 * MS + 8, 19)


@pytest.mark.parametrize("missing", [1, 5])
def test_missing_scans_are_counted_within_two_windows(missing: int):
    line = ScanTimeline(float(MS))
    lost_at = []
    for k in [k for k in range(1000) if not 300 <= k < 300 + missing]:
        t_ns, seq, lost = line.stamp(1, k * MS)
        if lost:
            lost_at.append((k, lost))
    assert [lost for _, lost in lost_at] == [missing]
    assert lost_at[0][0] < 300 + 2 * 128 + missing
    assert (t_ns, seq) == (999 * MS, 999)


def test_a_host_stall_is_not_a_gap():
    line = ScanTimeline(float(MS))
    k = 0
    total = 0
    while k < 2000:
        n = 50 if k % 500 == 250 else 1
        total += line.stamp(n, (k + n - 1) * MS)[2]
        k += n
    assert total == 0


def test_due_by_counts_what_has_not_come():
    line = ScanTimeline(float(MS))
    assert line.due_by(99 * MS) == 0
    line.stamp(1, 10 * MS)
    assert line.due_by(17 * MS + 1) == 7


@pytest.mark.parametrize("step_us", [-400, -200, 200, 400])
def test_a_clock_that_steps_is_told_within_twelve_arrivals(step_us: int):
    line, told = ScanTimeline(float(MS)), list[int]()
    for k in range(3000):
        line.stamp(1, (5 + k) * MS + (step_us * 1000 if k >= 2000 else 0))
        if line.shifted:
            told.append(k)
    assert told[0] == 2011


def test_a_host_that_is_busy_for_seconds_is_no_step():
    rng = np.random.default_rng(4)
    line, told = ScanTimeline(float(MS)), 0
    for k in range(20_000):
        late_us = 20.0 if k < 2000 else 200.0 + rng.exponential(300.0)
        line.stamp(1, 5 * MS + k * MS + round(late_us * 1000))
        told += line.shifted
    assert told < 20  # of 18 000: the line follows the host, and eight of twelve are seldom alike


def test_neither_jitter_nor_a_stall_nor_a_slow_crystal_is_a_step():
    rng = np.random.default_rng(2)
    line = ScanTimeline(float(MS))
    late_us = rng.exponential(50.0, 20_000)
    late_us[::7] = 2500.0  # some come with the next one but one
    arrival_ns = np.maximum.accumulate((np.arange(20_000) * MS * (1 + 100e-6) + late_us * 1000).astype(np.int64))
    told = 0
    for k in range(20_000):
        line.stamp(1, int(arrival_ns[k]))
        told += line.shifted
    assert told == 0
