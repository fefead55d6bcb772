"""Sensor places from a swing about the tip: a body moved through space, and the emulated instrument."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.sensing.config import SensingConfig
from sim_devices.config import EmulationConfig
from sim_devices.plant.lab_motion import measure_motion
from sim_devices.plant.sensors import sensor_unit
from tests.command import micron
from tests.unit.sensing.rigid_body import AXES, TIP, FIELD_uT, Motion, rc_filter
from tools.calibrate.pivot_spline import uniform_basis
from tools.calibrate.positions import fit_positions
from tools.errors import InputError

EVERY = 5
RATE_HZ = 200.0
"""Bodies move at 1 kHz; every fifth sample is recorded."""
CONFIG = SensingConfig()
TRUE = np.array(CONFIG.positions_m) + 1e-3 * np.array([[0.8, -0.5, 0.4], [-0.3, 0.6, -0.7], [0.2, -0.4, 0.9]])


def swing(seconds: float = 14.0, size: float = 1.0, tip_path: np.ndarray | None = None) -> Motion:
    t = np.arange(round(seconds * 1000.0)) / 1000.0
    tones = [(0.25, 0.30, 0.0), (0.10, 0.9, 1.0), (0.07, 1.7, 2.0)]
    angles = size * np.stack(
        [sum(a * np.sin(2.0 * np.pi * f * (1.0 + 0.11 * k) * t + p + 2.0 * k) for a, f, p in tones) for k in range(3)],
        axis=1,
    )
    attitude = Rotation.from_euler("y", 140.0, degrees=True) * Rotation.from_rotvec(angles)
    path = np.zeros((len(t), 3)) if tip_path is None else tip_path
    return Motion(path - attitude.apply(TIP), attitude)


def measured(motion: Motion, places: np.ndarray = TRUE, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    readings = motion.readings(places[[0, 0, 1, 1, 2, 2]], AXES)
    readings = rc_filter(readings + noise * rng.standard_normal(readings.shape))
    return readings[::EVERY], motion.attitude.inv().apply(FIELD_uT)[::EVERY]


def test_a_spline_and_its_derivatives() -> None:
    t = np.linspace(0.0, 2.0, 201)
    basis = uniform_basis(t, 0.05)
    values = np.stack([np.sin(3.0 * t), np.cos(2.0 * t), t**3], axis=1)
    curves = basis.curves(basis.fit(values))
    middle = slice(20, -20)
    np.testing.assert_allclose(curves[0][middle], values[middle], atol=1e-6)
    np.testing.assert_allclose(curves[1][middle, 0], 3.0 * np.cos(3.0 * t)[middle], atol=1e-4)
    np.testing.assert_allclose(curves[2][middle, 2], 6.0 * t[middle], atol=5e-3)


def test_places_of_a_body_moved_through_space() -> None:
    fit = fit_positions(*measured(swing()), RATE_HZ, CONFIG)
    np.testing.assert_allclose(fit.places, TRUE, atol=1e-5)
    assert np.max(np.abs(TRUE - np.array(CONFIG.positions_m))) > 8e-4


def test_noise_stays_inside_the_intervals() -> None:
    fit = fit_positions(*measured(swing(), noise=7.6e-4 * np.sqrt(1000.0)), RATE_HZ, CONFIG)
    inside = np.abs(fit.places - TRUE) < fit.reach
    assert np.sum(inside) >= 8
    assert np.max(fit.reach) < 1e-3


@pytest.mark.parametrize("what", ["short", "quiet", "moving", "no field"])
def test_a_bad_swing_is_refused(what: str) -> None:
    motion = swing()
    if what == "moving":
        t = np.arange(len(motion.position)) / 1000.0
        path = 0.02 * np.sin(2.0 * np.pi * 1.3 * t)[:, None] * np.array([1.0, 0.5, 0.0])
        motion = swing(tip_path=path)
    elif what == "short":
        motion = swing(5.0)
    elif what == "quiet":
        motion = swing(size=0.05)
    readings, field = measured(motion, noise=0.1 if what == "quiet" else 0.0)
    if what == "no field":
        field[:] = 0.0
    message = {"short": "minute", "quiet": "wider", "moving": "tip", "no field": "heading"}[what]
    with pytest.raises(InputError, match=message):
        fit_positions(readings, field, RATE_HZ, CONFIG)


def test_the_emulated_instrument_end_to_end(tmp_path: Path) -> None:
    config = EmulationConfig(unit=1, seed=1)
    true = sensor_unit(config.sensors, config.instrument, 1, 1e-3).positions_m
    np.savez(tmp_path / "data.npz", **measure_motion(config, "pivot", 40.0)[0])  # pyright: ignore[reportArgumentType]
    bench = Path(__file__).parents[3] / "benches" / "micron.toml"
    out = tmp_path / "positions.toml"
    arguments = ["calibrate", "positions", str(tmp_path / "data.npz"), "--bench", str(bench), "--rate-hz", "1000"]
    arguments += ["--out", str(out), "--json", str(tmp_path / "fit.json")]
    result = micron(*arguments)
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "fit.json").read_text())
    error = np.sqrt(np.mean((np.array(found["positions_m"]) - true) ** 2))
    drawn = np.sqrt(np.mean((np.array(found["believed_m"]) - true) ** 2))
    assert error < 0.5 * drawn
    assert "positions_m" in out.read_text()


def test_a_recording_of_something_else_ends_with_2(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", gyro_x=np.zeros(100))
    bench = Path(__file__).parents[3] / "benches" / "micron.toml"
    arguments = ["calibrate", "positions", str(tmp_path / "other.npz"), "--bench", str(bench), "--rate-hz", "100"]
    result = micron(*arguments)
    assert result.exit_code == 2
    assert "gyro_x" in result.output
