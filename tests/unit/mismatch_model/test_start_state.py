"""Start states that recorded samples set: exact where the samples determine them, zero where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from tools.mismatch.twins.base import Run
from tools.mismatch.twins.linear import StartState, free_response, response_shape, start_state

N = 600


def plant() -> tuple[np.ndarray, np.ndarray]:
    """A slow mode, a swing and a mode that has decayed after ten samples; each adds to the output."""
    w, z = 0.11, 0.03
    swing = np.exp(-z * w) * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
    a = np.zeros((4, 4))
    a[0, 0], a[1:3, 1:3], a[3, 3] = 0.995, swing, 0.1
    return a, np.array([1.0, 1.0, 0.0, 1.0])


def run_of(y: np.ndarray, setting: np.ndarray | None = None) -> Run:
    return Run(np.arange(float(N)), 1.0, {}, (), {"y": y}, (0,), 40, {}, setting)


def solved(a: np.ndarray, c: np.ndarray, y: np.ndarray, begin: int) -> StartState:
    return start_state(a, {"y": c}, run_of(y, np.arange(begin, N)))


def test_a_start_that_the_samples_show_is_met_exactly() -> None:
    a, c = plant()
    x0 = np.array([0.7, -0.4, 0.2, 0.3])
    y = free_response(a, c, N) @ x0
    found = solved(a, c, y, 0).states({"y": y})[0]
    np.testing.assert_allclose(found, x0, rtol=1e-5)


def test_a_mode_that_has_decayed_before_the_first_sample_adds_nothing_large_and_the_others_do_not_notice() -> None:
    a, c = plant()
    x0 = np.array([0.7, -0.4, 0.2, 0.3])
    y = free_response(a, c, N) @ x0 + 1e-3 * np.random.default_rng(3).standard_normal(N)
    ss = solved(a, c, y, 15)
    found = ss.states({"y": y})
    np.testing.assert_allclose(found[0, :3], x0[:3], atol=1e-3)
    # plain least squares puts 1e-3 * 10^15 there
    assert np.max(np.abs(ss.response(found, "y", N))) <= 2 * np.max(np.abs(y))


def test_the_response_does_not_depend_on_the_coordinates_of_the_state() -> None:
    a, c = plant()
    rng = np.random.default_rng(4)
    y = free_response(a, c, N) @ rng.standard_normal(4) + 0.1 * rng.standard_normal(N)
    turn = rng.standard_normal((4, 4)) * np.array([1.0, 1e3, 1e-4, 10.0])
    other = np.linalg.solve(turn, a @ turn)
    runs: list[np.ndarray] = []
    for m, row in ((a, c), (other, c @ turn)):
        ss = solved(m, row, y, 15)
        runs.append(ss.response(ss.states({"y": y}), "y", N))
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-6)


def test_two_modes_that_a_short_window_cannot_tell_apart_do_not_run_away_behind_it() -> None:
    """A misfit of the size of the record in forty samples, carried on over fifteen times as many."""
    rates = np.array([0.001, 0.0012, 0.0015, 0.002])
    a, c = np.diag(np.exp(-rates)), np.ones(4)
    y = np.random.default_rng(5).standard_normal(N)
    ss = start_state(a, {"y": c}, run_of(y))
    response = ss.response(ss.states({"y": y}), "y", N)
    assert np.max(np.abs(response)) < 2 * np.ptp(y)


def test_an_integrator_keeps_the_speed_that_its_window_shows() -> None:
    """Its own response runs out of every range, and the forced one brings it back: it is not held."""
    a, c = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([1.0, 0.0])
    y = 3.0 + 0.5 * np.arange(N)
    ss = start_state(a, {"y": c}, run_of(np.where(np.arange(N) < 40, y, y[39])))
    np.testing.assert_allclose(ss.states({"y": y})[0], [3.0, 0.5], rtol=1e-6)


@pytest.mark.parametrize("length", [5, 256, 257, 5000])
def test_the_shape_of_a_response_holds_its_beginning_and_later_samples(length: int) -> None:
    a, c = plant()
    free, shape = free_response(a, c, length), response_shape(a, c, length)
    np.testing.assert_allclose(shape[: min(length, 256)], free[:256])
    last = 1
    while 256 * last < length:
        last *= 2
    at = np.arange(-(-length // last)) * last
    np.testing.assert_allclose(shape[-1], free[at[min(255, at.size - 1)]], atol=1e-12)
