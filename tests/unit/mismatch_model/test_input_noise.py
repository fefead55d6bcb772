"""A measured input: its noise is neither taken for physics nor for more noise than it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from tools.mismatch.infer import diagnose
from tools.mismatch.input_noise import conditional_mean, error_of_mean
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import from_table

RATE_HZ, N, NOISE = 250.0, 2000, 0.8


def lines(seed: int) -> np.ndarray:
    rng, t = np.random.default_rng(seed), np.arange(N) / RATE_HZ
    parts = zip(rng.uniform(2, 6, 4), rng.uniform(0.2, 12, 4), rng.uniform(0, 6, 4), strict=True)
    return np.asarray(sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in parts))


def motion(seed: int) -> np.ndarray:
    low: Any = butter(2, 8.0, fs=RATE_HZ, output="sos")
    x = np.asarray(sosfilt(low, np.random.default_rng(seed).standard_normal(N)))
    return 6.0 * x / np.std(x)


def measured(x: np.ndarray, seed: int) -> np.ndarray:
    return x + NOISE * np.random.default_rng([seed, 1]).standard_normal(N)


# a filter that knew which frequencies the courses have would leave 0.13 (lines) and 0.4 (motion)
@pytest.mark.parametrize(("course", "most"), [(lines, 0.3), (motion, 0.6)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_little_of_the_noise_is_left_and_its_size_is_known(course, most: float, seed: int):
    x = course(seed)
    mean = conditional_mean(measured(x, seed), NOISE)
    error = float(np.std(mean - x))
    assert error < most
    drawn = float(np.std(error_of_mean(mean, NOISE, np.random.default_rng(seed))))
    # the power is averaged over neighbours, so the gap beside a line counts as open
    assert 0.85 * error < drawn < 1.6 * error


def test_noise_alone_has_no_course():
    found = conditional_mean(measured(np.zeros(N), 4), NOISE)
    assert np.std(found) < 0.25 * NOISE


def test_runs_are_smoothed_apart():
    y = measured(motion(5), 5)
    apart = [conditional_mean(part, NOISE) for part in np.split(y, [700])]
    np.testing.assert_array_equal(conditional_mean(y, NOISE, (700,)), np.concatenate(apart))


def recording(seed: int, declared: dict[str, float]) -> Recording:
    """A healthy machine whose simulated course was computed from a noisy measurement."""
    x = motion(seed)
    text = {
        "format": 1, "rate_hz": RATE_HZ, "twin": {"kind": "columns"},
        "channels": [
            {"column": "u", "role": "input", "signal": "simulated_displacement", "unit": "um", **declared},
            {"column": "y", "role": "output", "signal": "displacement", "unit": "um"},
        ],
    }  # fmt: skip
    y = x + 0.05 * np.random.default_rng([seed, 2]).standard_normal(N)
    return from_table(Path("measured"), text, {"u": measured(x, seed), "y": y})


def test_the_noise_of_a_column_is_no_physics():
    undeclared, declared = (diagnose(recording(31, d), jobs=1) for d in ({}, {"noise_rms": NOISE}))
    assert undeclared.physics  # a resonance or a delay, each of which smooths or shifts the noise
    assert declared.physics == ()
    assert declared.verdict in ("agrees", "recalibrate")


def test_noise_of_an_input_is_read_in_its_unit():
    found = recording(6, {"noise_rms": NOISE})
    assert found.input_noise == {"simulated_displacement": NOISE}
    assert not found.warnings
