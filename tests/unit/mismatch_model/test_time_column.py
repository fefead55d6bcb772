"""Time columns that are not quite uniform: short gaps and wandering clocks are brought to a grid, with a note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import stack_channels
from tools.errors import RecordingError
from tools.mismatch.recording_load import load, on_grid

TEXT = """format = 1
data = "data.npz"
time_column = "t_s"
[twin]
kind = "piezo_stack"
"""


def write(folder: Path, t: np.ndarray) -> Path:
    np.savez(folder / "data.npz", t_s=t, u=np.sin(3 * t), z=np.cos(3 * t))
    (folder / "recording.toml").write_text(TEXT + stack_channels("u", "z"))
    return folder


def test_a_short_gap_is_bridged_and_said(tmp_path: Path) -> None:
    t = np.delete(np.arange(1000) * 0.01, slice(400, 404))
    found = load(write(tmp_path, t))
    assert found.n == 1000
    assert found.dt == pytest.approx(0.01)
    assert found.inputs["command"] == pytest.approx(np.sin(3 * found.t), abs=2e-3)
    assert any("1 gaps, 0.04 s" in w for w in found.warnings)


def test_a_clock_that_wanders_keeps_every_sample_in_time(tmp_path: Path) -> None:
    k = np.arange(2000)
    t = 0.01 * k + 0.03 * np.sin(2 * np.pi * k / 2000)
    found = load(write(tmp_path, t))
    assert found.inputs["command"] == pytest.approx(np.sin(3 * found.t), abs=3 * 0.0052)
    assert any("no gaps" in w for w in found.warnings)


def test_a_long_gap_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="jumps by 2"):
        load(write(tmp_path, np.delete(np.arange(1000) * 0.01, slice(400, 600))))


def test_noise_is_not_smoothed() -> None:
    rng = np.random.default_rng(1)
    stamps = np.sort(np.arange(4000) + rng.uniform(-0.3, 0.3, 4000))
    noise = rng.standard_normal(4000)
    assert np.std(on_grid(np.arange(4000.0), 1.0, stamps, noise)) == pytest.approx(np.std(noise), rel=0.01)
