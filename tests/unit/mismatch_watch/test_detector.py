"""The sequential test of a watching twin against closed forms, and that it is causal."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.unit.mismatch_watch.bounds import cusum_run_length, shiryaev_roberts_run_length, shortest_delay
from tools.errors import InputError
from tools.mismatch.watch.detector import State, begin, follow, interrupt
from tools.mismatch.watch.reference import Reference, block_figures, learn, long_run_variance

DT = 0.005


def white(n: int, channels: int = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, channels))


def reference_of(x: np.ndarray, per_hour: float = 1.0) -> Reference:
    return learn({f"c{i}": x[:, i] for i in range(x.shape[1])}, DT, per_hour)


def run_lengths(shift: float, limit: float, *, cusum: bool) -> np.ndarray:
    """Run lengths of 2000 tests on white noise whose factor is the known likelihood ratio."""
    rng = np.random.default_rng(5)
    s, at = np.zeros(2000), np.zeros(2000)
    alive = np.ones(2000, bool)
    for step in range(1, 6000):
        z = rng.standard_normal(2000)
        gain = shift * z - shift**2 / 2
        s = np.maximum(0.0, s + gain) if cusum else (1.0 + s) * np.exp(gain)
        at[alive & (s >= limit)] = step
        alive &= s < limit
    assert not alive.any()
    return at


def test_the_run_length_of_pages_cusum_is_siegmunds():
    # steps of shift * z - shift^2 / 2 are steps of standard deviation `shift`
    found = float(run_lengths(1.0, 3.0, cusum=True).mean())
    assert found == pytest.approx(cusum_run_length(3.0, -0.5), rel=0.08)
    assert cusum_run_length(3.0, 1e-9) == pytest.approx(cusum_run_length(3.0, 1e-4), rel=1e-2)


def test_the_run_length_of_the_recursion_is_pollaks_and_at_least_the_threshold():
    found = float(run_lengths(0.5, 100.0, cusum=False).mean())
    assert found == pytest.approx(shiryaev_roberts_run_length(100.0, 0.5), rel=0.08)
    assert found > 100.0


def test_alarms_on_white_noise_are_rarer_than_stated():
    reference = reference_of(white(12_000, 10, 1), per_hour=20.0)
    x = white(720_000, 10, 2)  # an hour
    _, alarms = follow(reference, begin(reference), x)
    assert len(alarms) <= 20 + 3 * math.sqrt(20)


def test_a_known_shift_is_found_near_lordens_bound_and_not_before_it():
    reference = reference_of(white(60_000, 10, 3))
    shift = 0.3
    delays: list[float] = []
    for seed in range(4, 8):
        x = white(12_000, 10, seed)
        x[6000:] += shift
        alarms = follow(reference, begin(reference), x)[1]
        first = {a.channel: a for a in reversed(alarms) if a.t_s > 30.0}
        assert len(first) == 10
        delays += [a.t_s - 30.0 for a in first.values()]
        assert all(a.figure == "level" and a.rises and abs(a.onset_s - 30.0) < 3.0 for a in first.values())
    samples = reference.run_length * reference.block
    optimum_s = shortest_delay(samples, shift**2 / 2) * DT
    assert 0.7 * optimum_s < float(np.mean(delays)) < 3.0 * optimum_s


def test_a_channel_that_goes_dead_loses_power():
    reference = reference_of(white(30_000, 2, 9))
    x = white(6000, 2, 10)
    x[3000:, 1] = x[2999, 1]
    alarms = follow(reference, begin(reference), x)[1]
    assert {(a.channel, a.figure, a.rises) for a in alarms[:1]} == {("c1", "power", False)}
    assert 15.0 < alarms[0].t_s < 16.5


def test_pieces_of_any_size_give_the_same_answer():
    reference = reference_of(white(20_000, 2, 11))
    x = white(9000, 2, 12)
    x[5000:, 0] *= 2.0
    whole, alarms = follow(reference, begin(reference), x)
    state, found = begin(reference), []
    for piece in np.split(x, [1, 40, 41, 700, 5001, 8999]):
        state, more = follow(reference, state, piece)
        found += more
    assert [(a.channel, a.figure) for a in found] == [(a.channel, a.figure) for a in alarms] != []
    assert [a.t_s for a in found] == pytest.approx([a.t_s for a in alarms])
    np.testing.assert_allclose(state.log_m, whole.log_m, rtol=1e-9, atol=1e-9)


def test_lost_samples_and_new_runs_raise_nothing():
    reference = reference_of(white(20_000, 1, 13))
    x = white(9000, 1, 14)
    x[3000:3100] = np.nan
    state, alarms = follow(reference, begin(reference), x)
    assert not alarms
    assert np.isfinite(state.log_m).all()
    empty: State = interrupt(state)
    assert empty.recent.shape == (0, 1)


def test_a_wander_slower_than_the_reference_takes_the_level_out():
    slow = lfilter([1.0], [1.0, -0.9995], white(12_000, 1, 15), axis=0)
    reference = reference_of(slow + white(12_000, 1, 16))
    assert "level of c0" in reference.left_out
    assert np.isinf(reference.channels[0].bounds[0]).all()


def test_the_long_run_variance_of_an_autoregression():
    x = lfilter([1.0], [1.0, -0.5], np.random.default_rng(17).standard_normal(40_000))
    truth = 1.0 / 0.5**2
    assert truth * 0.95 < long_run_variance(x) < truth * 1.3


def test_figures_of_a_block():
    np.testing.assert_allclose(block_figures(np.array([[2.0, -2.0, 2.0, -2.0]])), [[0.0, math.log(4.0)]])


def test_what_cannot_be_watched_is_said():
    with pytest.raises(InputError, match="constant in the reference"):
        learn({"a": np.ones(20_000)}, DT, 1.0)
    with pytest.raises(InputError, match="at least 100 are needed"):
        learn({"a": white(2000)[:, 0]}, DT, 1.0)
