"""Prandtl-Ishlinskii forward and inverse: exact round trips at any rate, with creep, from a state that is not zero."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.actuation.config import ActuationConfig, StackConfig
from firmware_py.actuation.hysteresis import (
    drive,
    inverse_weights,
    operator_params,
    plays_at,
    slopes_at,
    stack_stroke,
)
from firmware_py.records import Record, attributes
from hal.errors import BenchError
from tests.unit.actuation.truth import Plays

ZONES = StackConfig(dead_zone_thresholds_um=(0.0, 6.0, 9.0), dead_zone_weights=(1.0, 0.1, -0.2), offset_um=0.3)
# the first slopes fall, the later ones rise with the rate; creep over three decades
FULL = ZONES.model_copy(
    update={
        "centre_V": 50.0,
        "slope_per_rate_s_per_V": (-3e-5, -2e-5, -1e-5, 0.0, 0.0, 1e-5, 1e-5, 2e-5, 2e-5, 2e-5),
        "rate_high_um_per_s": (200.0, 200.0, *[2000.0] * 8),
        "rate_low_um_per_s": 20.0,
        "creep_times_s": (0.1, 1.0, 10.0),
        "creep_shares": (0.012, 0.01, 0.015),
    }
)


class Stack:
    """Operator with its states."""

    def __init__(self, config: StackConfig, start_V: float) -> None:
        self.params: Record = operator_params(config)
        self.at = attributes(self.params)[0]
        self.plays = plays_at(self.at, start_V, 100.0)
        self.creep = np.zeros(len(self.at.creep_share))
        self.slopes = np.empty(len(self.at.r))

    def forward(self, volts: float, rate: float = 0.0) -> float:
        slopes_at(rate, self.params[0], self.slopes)
        return stack_stroke(volts, self.slopes, self.plays, self.creep, self.params[0])

    def inverse(self, z: float, rate: float = 0.0) -> float:
        slopes_at(rate, self.params[0], self.slopes)
        return drive(z, self.slopes, self.plays, self.creep, self.params[0])


def wandering(n: int = 3000) -> np.ndarray:
    t = np.arange(n) / 1000.0
    return 50 + 25 * np.sin(2 * np.pi * 3.1 * t) + 15 * np.sin(2 * np.pi * 10.3 * t + 1) * np.sin(2 * np.pi * 0.4 * t)


def test_forward_is_the_definition() -> None:
    stack = Stack(ZONES, 50.0)
    truth = Plays(stack.at.r[:10].copy(), np.array(ZONES.play_weights_um_per_V) * 1e-6, stack.plays[:10])
    for x in wandering(500):
        y = truth.step(x)
        z = y + 0.1 * max(y - 6e-6, 0.0) - 0.2 * max(y - 9e-6, 0.0) + 0.3e-6
        assert stack.forward(x) == pytest.approx(z, abs=1e-18)


def test_a_centre_changes_nothing_without_a_rate() -> None:
    plain, centred = Stack(ZONES, 50.0), Stack(ZONES.model_copy(update={"centre_V": 50.0}), 50.0)
    for x in wandering(300):
        assert centred.forward(x) == pytest.approx(plain.forward(x), abs=1e-18)


def test_plays_after_conditioning_are_what_the_operators_do() -> None:
    """0, 100, 0, then up to the drive: stepped through with the definition."""
    stack = Stack(StackConfig(), 37.0)
    truth = Plays(stack.at.r.copy(), np.ones(len(stack.at.r)), np.zeros(len(stack.at.r)))
    for x in (*range(101), *range(100, -1, -1), *range(38)):
        truth.step(float(x))
    np.testing.assert_allclose(stack.plays, truth.y, atol=1e-12)


@pytest.mark.parametrize("start_V", [0.0, 50.0, 80.0])
@pytest.mark.parametrize("config", [ZONES, FULL])
def test_round_trip_is_exact_from_any_start_at_any_rate(start_V: float, config: StackConfig) -> None:
    """The slopes change in every step; carried along untransformed the states would leave 2.9 % (erratum 78)."""
    stack = Stack(config, start_V)
    wanted = np.interp(wandering(), [0, 100], [1e-6, 12e-6])
    rates = np.abs(np.gradient(wanted)) * 1000.0
    for z, rate in zip(wanted, rates, strict=True):
        u = stack.inverse(z, rate)
        assert stack.forward(u, rate) == pytest.approx(z, abs=1e-17)


def test_a_wrong_start_is_not_harmless() -> None:
    """The test above would not pass by luck: with another past the loop is off."""
    here, there = Stack(ZONES, 80.0), Stack(ZONES, 20.0)
    error = []
    for z in np.linspace(5e-6, 6e-6, 50):
        u = there.inverse(z)
        there.forward(u)
        error.append(here.forward(u) - z)
    assert np.max(np.abs(error)) > 1e-7


def test_a_limited_drive_is_followed() -> None:
    """After clipping the model knows where the stack really is: the next free step is exact again."""
    model, real = Stack(FULL, 50.0), Stack(FULL, 50.0)
    free = 0
    for z in np.interp(wandering(), [0, 100], [-2e-6, 14e-6]):
        u = model.inverse(z)
        limited = min(70.0, max(40.0, u))
        model.forward(limited)
        if limited == u:
            assert real.forward(limited) == pytest.approx(z, abs=1e-17)
            free += 1
        else:
            real.forward(limited)
    assert 500 < free < 2500


def test_the_rate_law_is_linear_between_its_ends() -> None:
    stack = Stack(FULL, 50.0)
    sums = np.cumsum(FULL.play_weights_um_per_V)
    law = np.array(FULL.slope_per_rate_s_per_V)
    for rate, used in (
        (0.0, 20.0),
        (10e-6, 20.0),
        (100e-6, 100.0),
        (1000e-6, np.minimum(1000.0, [200.0] * 2 + [2e3] * 8)),
    ):
        assert not slopes_at(rate, stack.params[0], stack.slopes)
        np.testing.assert_allclose(stack.slopes[:10] * 1e6, sums + law * used, rtol=1e-12)


def test_a_slope_that_would_vanish_is_held_and_reported() -> None:
    config = StackConfig(slope_per_rate_s_per_V=(-1e-4, *[0.0] * 9), least_slope_um_per_V=0.01)
    stack = Stack(config, 50.0)
    assert not slopes_at(940e-6, stack.params[0], stack.slopes)
    assert slopes_at(960e-6, stack.params[0], stack.slopes)
    assert stack.slopes[0] == pytest.approx(0.01e-6)
    assert slopes_at(float("nan"), stack.params[0], stack.slopes)
    # still an inverse, and still monotonic
    for rate in (960e-6, 5e-3):
        u = [stack.inverse(z, rate) for z in np.linspace(4e-6, 9e-6, 200)]
        assert np.all(np.diff(u) > 0.0)
        assert stack.forward(u[77], rate) == pytest.approx(4e-6 + 77 * 5e-6 / 199, abs=1e-17)


def test_creep_is_the_krejci_kuhnen_chain() -> None:
    """Step of the drive: x (1 + sum p_j (1 - exp(-t / tau_j)))."""
    config = StackConfig(creep_times_s=(0.05, 0.5), creep_shares=(0.02, 0.03))
    stack = Stack(config, 50.0)
    x = Stack(StackConfig(), 50.0).forward(70.0)
    t = np.arange(1, 2001) * 1e-3
    closed = x * (1.0 - 0.02 * np.expm1(-t / 0.05) - 0.03 * np.expm1(-t / 0.5))
    np.testing.assert_allclose([stack.forward(70.0) for _ in t], closed, rtol=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(0.01, 1.0), min_size=2, max_size=6), st.lists(st.floats(-0.2, 1.0), min_size=1, max_size=5))
def test_inverse_weights_invert_the_loading_curve(first: list[float], more: list[float]) -> None:
    """Slopes of the inverse are the reciprocals of the slopes W_i, negative single weights included."""
    w = np.array([first[0], *more]) * 0.1
    sums = np.cumsum(w)
    if np.any(sums <= 1e-3):
        return
    np.testing.assert_allclose(np.cumsum(inverse_weights(w)), 1.0 / sums, rtol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"play_thresholds_V": [0.0, 5.0], "play_weights_um_per_V": [0.1, -0.2]}, "partial sum"),
        ({"slope_per_rate_s_per_V": [0.1]}, "one value per play"),
        ({"creep_times_s": [1.0]}, "creep"),
        ({"least_slope_um_per_V": 0.2}, "least_slope"),
    ],
)
def test_numbers_without_an_inverse_are_refused(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(BenchError, match=named):
        ActuationConfig.from_dict({"stacks": [wrong] * 3})


def test_kernels_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    from firmware_py.actuation import hysteresis
    from tests.unit.pure_python import without_compiler

    stack, twin = Stack(FULL, 50.0), Stack(FULL, 50.0)
    wanted = np.linspace(3e-6, 9e-6, 20)
    ours = []
    for z in wanted:
        ours.append(stack.inverse(z, 300e-6))
        stack.forward(ours[-1], 300e-6)
    without_compiler(monkeypatch)
    for z, u in zip(wanted, ours, strict=True):
        hysteresis.slopes_at(300e-6, twin.at, twin.slopes)
        v = hysteresis.drive(z, twin.slopes, twin.plays, twin.creep, twin.at)
        assert v == pytest.approx(u, rel=1e-12)
        hysteresis.stack_stroke(v, twin.slopes, twin.plays, twin.creep, twin.at)
    np.testing.assert_allclose(twin.plays, stack.plays, rtol=1e-12)
    np.testing.assert_allclose(twin.creep, stack.creep, rtol=1e-12)
