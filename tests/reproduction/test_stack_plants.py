"""The plants that stand in for a stage: they fit what they did not make, and remember."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.actuation.config import StackConfig
from tools.calibrate.piezo_prediction import simulate
from tools.research.reproduce.stack_plants import Plant, hysterons, late, narx, preisach

RATE_HZ = 200.0


def driven() -> tuple[np.ndarray, np.ndarray]:
    """Drive V from 0 V in loops of several sizes, and the displacement um of a stack of plays behind a lag."""
    t = np.arange(1600) / RATE_HZ
    drive = 50.0 - 50.0 * np.cos(2.0 * np.pi * t) * np.repeat([1.0, 0.6, 0.3, 0.8], 400)
    return drive, late(simulate(StackConfig(), drive, RATE_HZ), 1, 2.0)


@pytest.mark.parametrize("make", [preisach, narx])
def test_a_plant_is_fitted_far_better_than_a_straight_line(make) -> None:
    drive, z = driven()
    plant: Plant = make(drive, z)
    line = np.std(z[200:] - np.polyval(np.polyfit(drive[200:], z[200:], 1), drive[200:]))
    assert plant.rms_um < 0.35 * line
    np.testing.assert_allclose(np.std((z - plant.run(drive))[200:]), plant.rms_um, rtol=1e-9)


def test_hysterons_rise_late_and_fall_early() -> None:
    alpha, beta = np.array([2.0]), np.array([1.0])
    drive = np.array([0.0, 1.5, 2.5, 3.0, 1.5, 1.0])
    np.testing.assert_allclose(hysterons(drive, alpha, beta, 1.0)[:, 0], [0.0, 0.0, 0.5, 1.0, 0.5, 0.0])


def test_a_lag_delays_and_smooths() -> None:
    step = late(np.array([0.0, 1.0, 1.0, 1.0]), 1, 2.0)
    keep = np.exp(-0.5)
    np.testing.assert_allclose(step, [0.0, 0.0, 1.0 - keep, 1.0 - keep**2])
