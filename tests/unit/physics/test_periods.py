"""Periods of inputs, and events that keep to their phase."""

import numpy as np
import pytest

from sim_devices.physics.effect import Context
from sim_devices.physics.periods import locked_p_value, period_of
from sim_devices.physics.spikes import SPIKES

N = 6000


@pytest.mark.parametrize("samples", [200.0, 333.3, 41.7])
def test_the_period_of_a_sine_is_found_to_a_fraction_of_a_sample(samples: float) -> None:
    found = period_of(np.sin(2 * np.pi * np.arange(N) / samples + 1.0))
    assert found is not None
    assert found.samples == pytest.approx(samples, rel=2e-3)


def test_a_multisine_repeats_as_a_whole_and_a_measured_one_up_to_its_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(N)
    x = np.sum([np.cos(2 * np.pi * k * t / 1000 + rng.uniform(0, 6)) for k in range(1, 40)], axis=0)
    assert period_of(x) is not None
    found = period_of(x + 0.02 * x.std() * rng.standard_normal(N))
    assert found is not None
    assert found.samples == pytest.approx(1000, abs=1)
    assert found.lag % 1000 == 0


@pytest.mark.parametrize("seed", range(3))
def test_what_does_not_repeat_has_no_period(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(N) / N
    noise = np.convolve(rng.standard_normal(N), np.ones(20), mode="same")
    assert period_of(noise) is None
    assert period_of(np.sin(2 * np.pi * 20 * t**2)) is None  # a chirp
    assert period_of(t * np.sin(2 * np.pi * 20 * t)) is None  # a swelling sine


def test_events_once_per_period_are_locked_and_those_at_random_are_not() -> None:
    rng = np.random.default_rng(2)
    assert locked_p_value(np.arange(12) * 333.3 + 40 + rng.normal(0, 5, 12), 333.3) < 1e-4
    assert locked_p_value(np.arange(12) * 166.65 + 40, 333.3) < 1e-4  # at both reversals
    far = [locked_p_value(rng.uniform(0, N, 12), 333.3) for _ in range(200)]
    assert np.mean(np.array(far) < 0.05) < 0.08


@pytest.mark.parametrize("locked", [True, False])
def test_bursts_that_come_once_per_period_are_no_spikes(locked: bool) -> None:
    rng = np.random.default_rng(3)
    t = np.arange(N) / 500.0
    u = np.sin(2 * np.pi * np.arange(N) / 400.0)
    at = np.arange(150, N - 50, 400) if locked else rng.integers(100, N - 100, 15)
    residual = 0.02 * rng.standard_normal(N)
    for a in at:
        residual[a : a + 8] += np.hanning(8)
    ctx = Context(t, 1 / 500.0, {"command": u}, "displacement", "displacement", "command")
    test = SPIKES.test
    assert test is not None
    found = test(u, residual, ctx)
    assert (found.p_value < 1e-7) is not locked
