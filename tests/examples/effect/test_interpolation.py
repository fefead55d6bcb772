"""Signals with unequal offsets, as an encoder makes them (no sine is added): the effect is named and measured."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load

HERE = Path(__file__).parent

PERIOD_UM, OFFSET = 0.8, 0.5  # of the cosine signal, in its amplitude
RIVALS = ("static_nonlinearity", "saturation", "backlash", "first_order_lag")


def encoder_um(x: np.ndarray) -> np.ndarray:
    """What arctangent makes of sin and cos + OFFSET."""
    phase = 2 * np.pi * x / PERIOD_UM
    wrong = np.angle(np.exp(-1j * phase) * (np.cos(phase) + OFFSET + 1j * np.sin(phase)))
    return x + PERIOD_UM / (2 * np.pi) * wrong


def test_it_is_found_among_its_rivals(tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(2000) / 100.0
    u = 50 + 25 * np.sin(2 * np.pi * 0.11 * t) + 8 * np.sin(2 * np.pi * 0.37 * t + 1)
    np.savez(tmp_path / "data.npz", u=u, z=encoder_um(0.125 * u - 1.0) + rng.normal(0, 0.01, t.size))
    shutil.copy(HERE / "recording.toml", tmp_path)
    effects = [EFFECTS[name] for name in ("interpolation_error", *RIVALS)]
    report = diagnose(load(tmp_path), jobs=1, effects=effects)
    assert report.physics[0].name == "interpolation_error"
    found = report.physics[0].parameters
    assert found["period"].value == pytest.approx(PERIOD_UM, rel=0.005)
    first_harmonic_um = PERIOD_UM / (2 * np.pi) * OFFSET  # of the arctangent's series
    assert found["amplitude"].value == pytest.approx(first_harmonic_um, rel=0.02)


def test_it_stands_in_the_vocabulary_after_ours():
    assert list(EFFECTS)[-1] == "interpolation_error"
    assert "interpolation_err" not in EFFECTS
