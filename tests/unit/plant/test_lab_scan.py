"""The lab's scan of the manipulator against the mechanism's constraints, solved on their own."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from firmware_py.actuation.config import ActuationConfig
from sim_devices.config import EmulationConfig
from sim_devices.plant.lab import main
from sim_devices.plant.lab_scan import INTERFEROMETER_RMS_UM, SAMPLES, TRACKER_RMS_UM, measure_scan, scan_grid
from sim_devices.plant.unit import build_unit
from tests.unit.actuation.truth import tip_from_strokes

CONFIG = EmulationConfig(unit=3, seed=3)


class Quiet:
    def standard_normal(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.zeros(shape)


@pytest.fixture(scope="module")
def quiet() -> tuple[dict[str, np.ndarray], str]:
    return measure_scan(CONFIG, 3, Quiet())  # type: ignore[arg-type]


def test_the_grid_visits_every_corner_in_small_steps() -> None:
    grid = scan_grid(4)
    assert grid.shape == (64, 3)
    assert len({tuple(row) for row in grid}) == 64
    assert {(a, b, c) for a in (5.0, 95.0) for b in (5.0, 95.0) for c in (5.0, 95.0)} <= {tuple(row) for row in grid}
    # the last stack never jumps back over its whole range
    assert np.max(np.abs(np.diff(grid[:, 2]))) <= 30.0 + 1e-9


def test_the_tip_is_where_the_mechanism_puts_it(quiet: tuple[dict[str, np.ndarray], str]) -> None:
    columns, descriptor = quiet
    m = build_unit(CONFIG, 3).manipulator
    built = ActuationConfig(
        ball_circle_m=m.circle_m,
        shaft_m=m.shaft_m,
        lever_gain=tuple(m.lever),
        rest_heights_m=tuple(m.rest_m),
    )
    for k in (0, 7, 13, 26):
        truth = m.mount @ tip_from_strokes(columns["stroke_um"][k] * 1e-6, built)
        np.testing.assert_allclose(columns["tip_um"][k], truth * 1e6, atol=1e-6)
    assert tomllib.loads(descriptor)["format"] == 1
    # voltages up, strokes up
    assert np.all(columns["stroke_um"][-1] > columns["stroke_um"][0] + 10.0)


def test_the_instruments_noise_is_that_of_a_mean(quiet: tuple[dict[str, np.ndarray], str]) -> None:
    noisy, _ = measure_scan(CONFIG, 3, np.random.default_rng(0))
    for name, rms_um in (("stroke_um", INTERFEROMETER_RMS_UM), ("tip_um", TRACKER_RMS_UM)):
        assert np.std(noisy[name] - quiet[0][name]) == pytest.approx(rms_um / np.sqrt(SAMPLES), rel=0.25)


def test_a_scan_of_too_few_voltages_is_refused(tmp_path, capsys) -> None:
    assert main(["manipulator", "--per-axis", "2", "--out", str(tmp_path / "scan")]) == 2
    assert "give 3 to 12" in capsys.readouterr().err
    assert not (tmp_path / "scan").exists()
