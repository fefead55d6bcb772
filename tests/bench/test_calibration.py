"""Poses turned by hand against sensors that are known, and a calibration laid over a bench file."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from hal.bench import load_bench
from tests.conftest import DEFAULT_BENCH
from tools.bench.bench_copy import with_calibration
from tools.bench.poses import TRIADS, at_nominal_supply, identify
from tools.bench.recorder import check_name
from tools.errors import InputError

GRAVITY = 9.80131
BIAS_V = np.array([2.5027, 2.5528, 2.5061, 2.4776, 2.4701, 2.4583])
SCALE_V_PER_G = np.array([0.9872, 0.9904, 1.0056, 0.9866, 0.9973, 0.9879])
DIRECTIONS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (abs(x) + abs(y) + abs(z)) in (1, 3)],
    dtype=float,
)


def volts(directions: np.ndarray) -> np.ndarray:
    """What the six axes say at rest with gravity's reaction along each direction."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.zeros((len(unit), 6))
    for triad in TRIADS:
        for axis, column in enumerate(triad):
            rows[:, column] = BIAS_V[column] + SCALE_V_PER_G[column] * unit[:, axis]
    return rows


def test_poses_give_back_bias_and_scale():
    found = identify(volts(DIRECTIONS), GRAVITY)
    np.testing.assert_allclose(found["table"]["bias_V"], BIAS_V, atol=1e-8)
    np.testing.assert_allclose(found["table"]["scale_V_per_g"], SCALE_V_PER_G, atol=1e-8)
    assert max(found["residual_m_s2"]) < 1e-7


def test_poses_off_by_twenty_degrees_and_noise_do_little():
    rng = np.random.default_rng(4)
    means = volts(DIRECTIONS + 0.2 * rng.standard_normal(DIRECTIONS.shape)) + 2e-4 * rng.standard_normal((14, 6))
    found = identify(means, GRAVITY)
    np.testing.assert_allclose(found["table"]["bias_V"], BIAS_V, atol=2e-3)
    np.testing.assert_allclose(found["table"]["scale_V_per_g"], SCALE_V_PER_G, atol=2e-3)


def test_poses_at_another_supply_are_the_same_poses():
    wired = (5, 4, 3, 2, 1, 0)
    rows = np.zeros((14, 9))
    rows[:, 8] = np.linspace(4.9, 5.1, 14)
    rows[:, wired] = volts(DIRECTIONS) * rows[:, 8:] / 5.0
    found = at_nominal_supply(rows, {"channels": list(wired), "nominal_supply_V": 5.0})
    np.testing.assert_allclose(found, volts(DIRECTIONS), atol=1e-12)
    unsupplied = rows * np.array([1.0] * 8 + [0.0])
    for wrong, sensing in ((rows[:, :6], {}), (rows, {"channels": list(range(8))}), (unsupplied, {})):
        with pytest.raises(InputError):
            at_nominal_supply(wrong, sensing)


@pytest.mark.parametrize("means", [np.ones((3, 6)), np.full((14, 6), np.nan), np.ones((14, 6)), np.ones((14, 5))])
def test_poses_without_sense_are_bad_input(means: np.ndarray):
    with pytest.raises(InputError):
        identify(means, GRAVITY)


@pytest.mark.parametrize("firmware", ["kept", "removed"])
def test_a_calibration_is_laid_over_a_copy_of_the_bench(tmp_path: Path, firmware: str):
    source = DEFAULT_BENCH
    if firmware == "removed":
        source = tmp_path / "plain.toml"
        source.write_text(DEFAULT_BENCH.read_text().partition("[firmware]")[0])
    found = tmp_path / "poses.toml"
    found.write_text("format = 1\n[sensing]\nrange_g = 1.6\n")
    out = with_calibration(load_bench(source), found, tmp_path / "copy.toml")
    again = with_calibration(load_bench(out), found, tmp_path / "again.toml")
    before = tomllib.loads(source.read_text()).get("firmware", {}).get("calibration", [])
    files = tomllib.loads(again.read_text())["firmware"]["calibration"]
    assert files[-1] == str(found)
    assert len(files) == len(before) + 1
    assert all(Path(name).is_file() for name in files)


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".hidden", "x" * 81, "run.mcap", "new\nline"])
def test_a_recording_is_named_like_a_file_and_nothing_else(name: str):
    with pytest.raises(InputError):
        check_name(name)
