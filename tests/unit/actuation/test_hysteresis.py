"""Prandtl-Ishlinskii forward and inverse: exact round trips, also from a state that is not zero."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.actuation.config import ActuationConfig, StackConfig
from firmware_py.actuation.hysteresis import (
    drive,
    extension,
    follow_drive,
    inverse_states,
    inverse_weights,
    operator_params,
    plays_after_rise,
)
from firmware_py.records import attributes
from hal.errors import BenchError
from tests.unit.actuation.truth import Plays

STACK = StackConfig(dead_zone_thresholds_um=(0.0, 6.0, 9.0), dead_zone_weights=(1.0, 0.1, -0.2), offset_um=0.3)


def wandering(n: int = 3000) -> np.ndarray:
    t = np.arange(n) / 1000.0
    return 50 + 25 * np.sin(2 * np.pi * 3.1 * t) + 15 * np.sin(2 * np.pi * 10.3 * t + 1) * np.sin(2 * np.pi * 0.4 * t)


def test_forward_is_the_definition() -> None:
    params = operator_params(STACK)
    stack = attributes(params)[0]
    states = plays_after_rise(stack.r, 50.0)
    truth = Plays(stack.r.copy(), stack.w.copy(), states)
    for x in wandering(500):
        y = truth.step(x)
        z = y + 0.1 * max(y - 6e-6, 0.0) - 0.2 * max(y - 9e-6, 0.0) + 0.3e-6
        assert extension(x, states, params[0]) == pytest.approx(z, abs=1e-18)


@pytest.mark.parametrize("start_V", [0.0, 50.0, 80.0])
def test_round_trip_is_exact_from_any_start(start_V: float) -> None:
    params = operator_params(STACK)
    stack = attributes(params)[0]
    forward = plays_after_rise(stack.r, start_V)
    backward = inverse_states(stack.w, forward)
    wanted = np.interp(wandering(), [0, 100], [1e-6, 12e-6])
    for z in wanted:
        u = drive(z, backward, params[0])
        assert extension(u, forward, params[0]) == pytest.approx(z, abs=1e-12 * 15e-6 + 1e-17)
    np.testing.assert_allclose(backward, inverse_states(stack.w, forward), atol=1e-17)


def test_a_wrong_start_is_not_harmless() -> None:
    """The test above would not pass by luck: without the initial state the loop is off."""
    params = operator_params(STACK)
    stack = attributes(params)[0]
    forward = plays_after_rise(stack.r, 80.0)
    backward = inverse_states(stack.w, plays_after_rise(stack.r, 0.0))
    error = [extension(drive(z, backward, params[0]), forward, params[0]) - z for z in np.linspace(5e-6, 6e-6, 50)]
    assert np.max(np.abs(error)) > 1e-7


def test_a_limited_drive_is_followed() -> None:
    """After clipping the inverse knows where the stack really is: the next free step is exact again."""
    params = operator_params(STACK)
    stack = attributes(params)[0]
    forward = plays_after_rise(stack.r, 50.0)
    backward = inverse_states(stack.w, forward)
    for z in np.interp(wandering(), [0, 100], [-2e-6, 14e-6]):
        trial = backward.copy()
        u = drive(z, trial, params[0])
        limited = min(70.0, max(40.0, u))
        if limited == u:
            backward[:] = trial
        else:
            follow_drive(limited, backward, params[0])
        reached = extension(limited, forward, params[0])
        np.testing.assert_allclose(backward, inverse_states(stack.w, forward), atol=1e-16)
        if limited == u:
            assert reached == pytest.approx(z, abs=1e-16)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(0.01, 1.0), min_size=2, max_size=6), st.lists(st.floats(-0.2, 1.0), min_size=1, max_size=5))
def test_inverse_weights_invert_the_loading_curve(first: list[float], more: list[float]) -> None:
    """Slopes of the inverse are the reciprocals of the slopes W_i, negative single weights included."""
    w = np.array([first[0], *more]) * 0.1
    sums = np.cumsum(w)
    if np.any(sums <= 1e-3):
        return
    np.testing.assert_allclose(np.cumsum(inverse_weights(w)), 1.0 / sums, rtol=1e-9)


def test_weights_without_an_inverse_are_refused() -> None:
    with pytest.raises(BenchError, match="partial sum"):
        ActuationConfig.from_dict(
            {"stacks": [{"play_thresholds_V": [0.0, 5.0], "play_weights_um_per_V": [0.1, -0.2]}] * 3}
        )


def test_kernels_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    from firmware_py.actuation import hysteresis
    from tests.unit.pure_python import without_compiler

    params = operator_params(STACK)
    stack = attributes(params)[0]
    mine = inverse_states(stack.w, plays_after_rise(stack.r, 50.0))
    twin = mine.copy()
    z = np.linspace(3e-6, 9e-6, 20)
    ours = [drive(v, mine, params[0]) for v in z]
    follow_drive(61.0, mine, params[0])
    without_compiler(monkeypatch)
    np.testing.assert_allclose([hysteresis.drive(v, twin, stack) for v in z], ours, rtol=1e-12)
    hysteresis.follow_drive(61.0, twin, stack)
    np.testing.assert_allclose(twin, mine, rtol=1e-12)
