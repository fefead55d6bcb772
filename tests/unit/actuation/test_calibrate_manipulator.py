"""Geometry from a scan: known geometry comes back, poor scans are named, the firmware loads the file."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.actuation.config import ActuationConfig
from tests.unit.actuation.truth import tip_from_strokes
from tools.calibrate.manipulator import identify_manipulator, load_scan, manipulator_calibration
from tools.errors import InputError
from tools.research.manipulator.workspace import analyse

BUILT = ActuationConfig(
    ball_circle_m=0.00507, shaft_m=0.0396, lever_gain=(8.15, 7.9, 8.02), rest_heights_m=(6e-6, -7e-6, 1e-6)
)
TURN = np.array([0.3, -0.2, 0.6])  # deg


def scan(levels: tuple[float, ...] = (-6.0, 0.0, 6.0)) -> dict[str, np.ndarray]:
    """Tip by solving the mechanism's constraints, turned into the body frame."""
    stroke = np.array(list(itertools.product(levels, repeat=3)))
    tip = np.array([tip_from_strokes(e * 1e-6, BUILT) for e in stroke])
    turn = Rotation.from_rotvec(TURN, degrees=True)
    return {"stroke_um": stroke, "tip_um": 1e6 * turn.apply(tip)}


def test_the_geometry_comes_back() -> None:
    fit = identify_manipulator(scan())
    values = {name: e.value for name, e in fit.parameters.items()}
    assert values["ball_circle_mm"] == pytest.approx(5.07, abs=1e-6)
    assert values["shaft_mm"] == pytest.approx(39.6, abs=1e-5)
    assert [values[f"lever_{i}"] for i in (1, 2, 3)] == pytest.approx(BUILT.lever_gain, abs=1e-7)
    assert [values[f"mount_{axis}_deg"] for axis in "xyz"] == pytest.approx(TURN, abs=1e-5)
    config = ActuationConfig.from_dict(tomllib.loads(manipulator_calibration(fit, "t"))["actuation"])
    # heights differ by a common one, which does not move the tip
    np.testing.assert_allclose(np.diff(config.rest_heights_m), np.diff(BUILT.rest_heights_m), atol=1e-10)
    assert max(fit.residual_um) < 1e-4
    assert max(fit.before_um) > 1.0


def test_noise_is_in_the_intervals() -> None:
    data = scan((-6.0, -2.0, 2.0, 6.0))
    data["tip_um"] = data["tip_um"] + 0.05 * np.random.default_rng(0).standard_normal(data["tip_um"].shape)
    fit = identify_manipulator(data)
    truth = {"lever_1": 8.15, "mount_z_deg": 0.6, "shaft_mm": 39.6}
    for name, value in truth.items():
        e = fit.parameters[name]
        width = e.high - e.low
        assert e.low - 0.5 * width < value < e.high + 0.5 * width


def test_poor_scans_are_named(tmp_path: Path) -> None:
    few = {name: rows[:8] for name, rows in scan().items()}
    with pytest.raises(InputError, match="8 positions"):
        identify_manipulator(few)
    line = np.linspace(-6, 6, 20)[:, None] * np.ones(3)
    with pytest.raises(InputError, match="does not fix"):
        identify_manipulator({"stroke_um": line, "tip_um": line * [0.0, 0.0, 8.0]})
    np.savez(tmp_path / "data.npz", tip_um=np.zeros((5, 3)))
    with pytest.raises(InputError, match="stroke_um"):
        load_scan(tmp_path)


def test_workspace_holds_the_published_extents_and_sphere() -> None:
    """Ang 2004, Table 6.1 and 6.1.1. Width of the box of strokes along its own normal: 8 range / sqrt(1 + (r/l)^2)."""
    config = ActuationConfig()
    found = analyse(config, grid=5)
    assert np.all(found.extent_m * 1e6 > [1000.0, 1000.0, 100.0])
    span = float(np.ptp(found.strokes_m[0]))
    assert found.sphere_m == pytest.approx(8.0 * span / np.sqrt(1.0 + (1.0 / 8.0) ** 2), rel=0.02)
    assert found.sphere_m > 100e-6
    assert found.neutral_sphere_m > 50e-6
    assert found.identity_m < 1e-9
    assert found.newton <= 3
    assert found.determinant > 0.9
    assert found.singular_deg > 20.0 * found.tilt_deg
