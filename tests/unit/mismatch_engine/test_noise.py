"""The noise floor against noise of known size, whatever rides on it."""

import numpy as np
import pytest
from scipy.signal import lfilter

from tools.mismatch.engine.noise import clip_spikes, lattice_step, noise_floor, repeat_floor, spectral_floor

RATE = 1000.0
N = 20000


def slow_physics(rng: np.random.Generator) -> np.ndarray:
    t = np.arange(N) / RATE
    return 5 * np.sin(2 * np.pi * 3 * t) + 2 * np.abs(np.sin(2 * np.pi * 0.7 * t)) + 0.5 * t + rng.normal()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["plain", "physics", "line", "spikes"])
def test_white_floor_is_found_under_anything(kind: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    e = 0.3 * rng.standard_normal(N)
    if kind == "physics":
        e += slow_physics(rng)
    if kind == "line":
        e += 2 * np.sin(2 * np.pi * 50.03 * np.arange(N) / RATE)
    if kind == "spikes":
        e[rng.integers(0, N, 30)] += 40.0
    floor = noise_floor(e, e, RATE)
    assert floor.rms == pytest.approx(0.3, rel=0.05)
    assert abs(floor.rms - 0.3) < 5 * floor.standard_error
    assert not floor.coloured


def test_declared_wins_and_keeps_the_white_part() -> None:
    e = np.random.default_rng(1).standard_normal(N)
    floor = noise_floor(e, e, RATE, declared=1.4)
    assert floor.method == "declared"
    assert floor.rms == 1.4
    assert floor.white_rms == pytest.approx(1.0, rel=0.05)


def test_coloured_noise_is_recognised() -> None:
    e = lfilter([1.0], [1.0, -0.9], np.random.default_rng(2).standard_normal(N))
    assert noise_floor(e, e, RATE).coloured


def test_quantised_output_keeps_its_lattice() -> None:
    rng = np.random.default_rng(3)
    y = np.round((np.sin(np.arange(N) / 300) + 0.02 * rng.standard_normal(N)) / 0.01) * 0.01
    floor = noise_floor(y, y - np.sin(np.arange(N) / 300), RATE)
    assert floor.step == pytest.approx(0.01, rel=1e-6)
    assert floor.rms == pytest.approx(np.hypot(0.02, 0.01 / np.sqrt(12)), rel=0.05)
    assert lattice_step(rng.standard_normal(500)) == 0.0


def test_repeats_see_coloured_noise_whole() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(N) / RATE
    u = np.sin(2 * np.pi * 2 * t) + 0.3 * np.sin(2 * np.pi * 6 * t)
    e = lfilter([1.0], [1.0, -0.9], rng.standard_normal(N))
    e /= e.std()
    found = repeat_floor(np.abs(u) + u + e, u[:, None])
    assert found is not None
    assert found[0] == pytest.approx(1.0, rel=0.1)
    assert repeat_floor(e, rng.standard_normal((N, 1))) is None


def test_steep_signal_is_not_a_spike() -> None:
    e = 3 * np.sin(np.arange(5000) / 3) + 0.05 * np.random.default_rng(5).standard_normal(5000)
    assert np.array_equal(clip_spikes(e), e)


def test_silence_has_no_noise() -> None:
    assert spectral_floor(np.zeros(1000), RATE)[0] == 0.0


def test_repeats_under_a_warm_up() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(N) / RATE
    u = np.sin(2 * np.pi * 4 * t)
    drift = 5 * (1 - np.exp(-t / (0.2 * t[-1])))
    found = repeat_floor(u + drift + rng.standard_normal(N), u[:, None])
    assert found is not None
    assert found[0] == pytest.approx(1.0, rel=0.05)


def test_peaks_of_a_mode_that_swells_are_no_spikes() -> None:
    rng = np.random.default_rng(8)
    t = np.arange(N) / RATE
    swell = np.exp(6.0 * np.sin(2 * np.pi * 0.31 * t))
    mode = swell * np.sin(2 * np.pi * 115.0 * t)  # few samples to a period: a running median cuts its peaks
    e = mode + 0.01 * rng.standard_normal(N)
    assert np.count_nonzero(clip_spikes(e) != e) > 20
    assert spectral_floor(e, RATE)[0] == pytest.approx(0.01, rel=0.1)
