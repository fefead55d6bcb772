"""Held-out parts never touch what is fitted; windows of a burst are found."""

import numpy as np
import pytest

from tools.mismatch.engine.split import given_split, own_split
from tools.mismatch.engine.windows import bad_windows, change_points


@pytest.mark.parametrize("seed", range(5))
def test_own_split_is_blocked_guarded_and_fine_enough(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2000, 9000))
    signals = np.cumsum(rng.standard_normal((n, 2)), axis=0)
    split = own_split(signals, held_out=0.3, seed=seed, guard=10)
    fit, held = split.fit_mask(), split.held_out_mask()
    assert not np.any(fit & held)
    assert 0.25 < held.mean() < 0.35
    edges = np.nonzero(np.diff(held.astype(int)))[0]
    for e in edges:
        assert not fit[max(0, e - 8) : e + 9].any()
    assert len(split.blocks) >= 24
    assert all(held[a:b].all() for a, b in split.blocks)
    assert sum(b - a for a, b in split.blocks) == held.sum()
    assert split == own_split(signals, held_out=0.3, seed=seed, guard=10)


def test_own_split_leaves_the_beginning_out() -> None:
    split = own_split(np.random.default_rng(1).standard_normal((3000, 1)), begin=90)
    assert not (split.fit_mask() | split.held_out_mask())[:90].any()
    assert split.fit[0][0] == 90


def test_what_a_slow_output_did_once_is_fitted() -> None:
    """A decay from a start far away: without it the held-out part would ask how the physics extrapolates."""
    rng = np.random.default_rng(2)
    inputs, decay = rng.standard_normal((600, 1)), np.exp(-np.arange(600) / 60)[:, None]
    for seed in range(20):
        held = own_split(inputs, decay, seed=seed, begin=18).held_out_mask()
        assert decay[held].max() < decay[18:][~held[18:]].max()
    (a, _) = own_split(inputs, seed=0, guard=4, begin=18).held_out[0]
    assert a - 4 >= 18 + (100 - 30 - 22) // 4


def test_given_split_is_honoured() -> None:
    split = given_split(1000, (0, 600), (600, 1000), initialization=20)
    assert split.fit == ((0, 600),)
    assert split.held_out == ((620, 1000),)


def test_change_points_of_steps() -> None:
    rng = np.random.default_rng(0)
    x = np.concatenate([np.zeros(40), np.full(30, 2.0), np.full(50, -1.0)]) + 0.3 * rng.standard_normal(120)
    assert change_points(x) == [0, 40, 70, 120]
    assert change_points(0.3 * rng.standard_normal(120)) == [0, 120]


def test_window_of_a_burst() -> None:
    rng = np.random.default_rng(1)
    e = rng.standard_normal(9600)
    e[3000:4000] += 6 * np.sin(np.arange(1000) / 5)
    ((start, stop),) = bad_windows(e, 1.0, 1e-3)
    assert start == pytest.approx(3.0, abs=0.15)
    assert stop == pytest.approx(4.0, abs=0.15)
    assert bad_windows(rng.standard_normal(9600), 1.0, 1e-3) == []
