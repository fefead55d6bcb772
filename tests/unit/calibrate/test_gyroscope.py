"""Gyroscope from turns between poses, turn of a magnetometer to the body, offset from the strap; made logs."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_devices.config import EmulationConfig
from sim_devices.plant.lab import measure_tumble
from sim_devices.plant.sensors import sensor_unit
from tests.command import micron
from tools.calibrate.ellipsoid import fit_ellipsoid
from tools.calibrate.field_axes import fit_turn, strap
from tools.calibrate.gyroscope import fit_gyroscope, rate_matrix, turned_gravity
from tools.calibrate.logs import load_log
from tools.errors import InputError

G = 9.80665
RATE_HZ = 100.0
PARAMETERS = np.array([0.01, -0.02, 0.015, 0.03, -0.01, 0.02, 2.0e-4, 2.1e-4, 1.9e-4])
BIAS = np.array([120.0, -300.0, 45.0])


def log(poses: int, seed: int = 2, limit: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Counts of both sensors: rests of 2 s, turns of 1 s with a smooth start and end about fixed axes."""
    rng = np.random.default_rng(seed)
    attitudes = Rotation.random(poses, random_state=seed)  # type: ignore[call-arg]
    force, rate = [], []
    for a, b in itertools.pairwise(attitudes):
        step = (a.inv() * b).as_rotvec()
        s = np.arange(100) / 100.0
        way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        force += [np.tile(a.inv().apply([0.0, 0.0, G]), (200, 1))]
        force += [np.array([(a * Rotation.from_rotvec(step * w)).inv().apply([0.0, 0.0, G]) for w in way])]
        rate += [np.zeros((200, 3)), np.outer(30.0 * s**2 * (1.0 - s) ** 2, step)]
    f, w = np.vstack(force), np.vstack(rate)
    moving = np.linalg.norm(w, axis=1) > 0.0
    f = f + np.where(moving[:, None], 0.3, 0.005) * rng.standard_normal(f.shape)
    raw = w @ np.linalg.inv(rate_matrix(PARAMETERS)).T + BIAS + 3.0 * rng.standard_normal(w.shape)
    return f / G * 16384.0, np.clip(raw, -limit, limit)


def test_scale_misalignment_and_bias_come_back() -> None:
    fit = fit_gyroscope(*log(30), RATE_HZ, G)
    assert fit.turns >= 25
    np.testing.assert_allclose(fit.values()[6:], PARAMETERS[6:], rtol=3e-3)
    np.testing.assert_allclose(fit.values()[:6], PARAMETERS[:6], atol=4e-3)
    np.testing.assert_allclose([fit.parameters[f"bias_{a}"].value for a in "xyz"], BIAS, atol=2.0)
    inside = [e.low <= t <= e.high for e, t in zip(fit.parameters.values(), PARAMETERS, strict=False)]
    assert sum(inside) >= 7


def test_turns_that_saturate_are_left_out() -> None:
    whole, cut = fit_gyroscope(*log(30), RATE_HZ, G), fit_gyroscope(*log(30, limit=20_000.0), RATE_HZ, G)
    assert whole.saturated == 0
    assert cut.saturated > 3
    assert cut.turns + cut.saturated == whole.turns
    np.testing.assert_allclose(cut.values()[6:], PARAMETERS[6:], rtol=1e-2)


def test_too_few_turns_are_refused() -> None:
    force, rate = log(12, limit=3000.0)
    with pytest.raises(InputError, match="turn more slowly"):
        fit_gyroscope(force, rate, RATE_HZ, G)


def test_the_integration_is_the_closed_form_for_a_steady_turn() -> None:
    rate = np.tile([0.3, -0.5, 0.8], (201, 1))
    up, out = np.array([[0.0, 0.6, 0.8]]), np.empty((1, 3))
    arguments = (np.array([[0, 201]]), np.zeros((1, 3)), (np.eye(3), 0.01), up, out)
    turned_gravity(rate, *arguments)
    np.testing.assert_allclose(out[0], Rotation.from_rotvec(2.0 * rate[0]).inv().apply(up[0]), atol=1e-12)
    compiled = out.copy()
    turned_gravity.py_func(rate, *arguments)
    np.testing.assert_allclose(out, compiled, atol=1e-14)


def test_the_turn_between_magnetometer_and_body() -> None:
    rng = np.random.default_rng(4)
    attitude = Rotation.random(80, random_state=4)  # type: ignore[call-arg]
    true = Rotation.from_rotvec(np.radians([1.5, -2.0, 3.0]))
    field = attitude.inv().apply([20.0, 0.0, -45.0])
    force = attitude.inv().apply([0.0, 0.0, G])
    seen = true.inv().apply(field) + 0.02 * rng.standard_normal(field.shape)
    found = fit_turn(seen, force)
    np.testing.assert_allclose(found.turn, true.as_matrix(), atol=1e-3)
    assert found.parameters["dip_deg"].value == pytest.approx(np.degrees(np.arctan2(45.0, 20.0)), abs=0.1)
    with pytest.raises(InputError, match="condition"):
        fit_turn(np.tile(field[:1], (80, 1)), np.tile(force[:1], (80, 1)))


def test_set_and_reset_part_the_offset_from_hard_iron() -> None:
    config = EmulationConfig(unit=1, seed=1)
    unit = sensor_unit(config.sensors, config.instrument, 1, 1e-3)
    data = measure_tumble(config, 100, 5.0)[0]
    free, offset = strap(data["magnetometer_V"], data["magnetometer_reset_V"])
    np.testing.assert_allclose([e.value - 2.5 for e in offset], unit.magnetometer_offset_V, atol=2e-5)
    # what is left of the ellipsoid's centre is hard iron, which turns with the body, in the sensor's own axes
    np.testing.assert_allclose(fit_ellipsoid(free).bias, unit.magnetometer @ unit.hard_iron_G, atol=1e-4)


@pytest.mark.parametrize("command", ["gyroscope", "magnetometer"])
def test_a_missing_column_ends_with_2(tmp_path: Path, command: str) -> None:
    np.savez(tmp_path / "log.npz", other=np.arange(100.0))
    result = micron("calibrate", command, tmp_path / "log.npz")
    assert result.exit_code == 2
    assert "other" in result.output


def test_real_xsens_gyroscope(shared_data: Path) -> None:
    recording = load_log(shared_data / "imu_tk_xsens")
    columns = [tuple(f"{kind}_{axis}_raw" for axis in "xyz") for kind in ("acc", "gyro")]
    fit = fit_gyroscope(recording.matrix(columns[0]), recording.matrix(columns[1]), recording.need_rate(), 9.81744)  # pyright: ignore[reportArgumentType]
    counts = [1.0 / fit.parameters[f"scale_{axis}"].value for axis in "xyz"]
    np.testing.assert_allclose(counts, [4778.0, 4758.0, 4766.0], rtol=1.5e-3)  # the maker's
