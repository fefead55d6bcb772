"""Seven and eight axes: weighted least squares over all of them, and parity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from firmware_py.frame import COUNTS, INVALID, LAYOUT, STATUS
from firmware_py.sensing import stage
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing
from tests.unit.pure_python import assert_kernel_is_python
from tests.unit.sensing.rigid_body import Motion, frames_of, hand_motion, rc_filter

PLACES = ((0.0101, -0.0101, 0.0), (-0.0101, 0.0101, 0.0), (0.0042, 0.0042, 0.116), (0.013, 0.0, 0.06))
AXES = np.eye(3)[[0, 2, 1, 2, 0, 1, 1, 2]]
EIGHT: dict[str, Any] = {
    "channels": tuple(range(8)),
    "supply_channel": None,
    "temperature_channel": None,
    "positions_m": PLACES,
    "axes": tuple(map(tuple, AXES)),
}
SEVEN = EIGHT | {
    "channels": tuple(range(7)),
    "positions_m": tuple(PLACES[i // 2] for i in range(7)),
    "axes": EIGHT["axes"][:7],
}


def frames(motion: Motion, config: SensingConfig, seed: int | None = None) -> np.ndarray:
    """Input columns of ideal sensors behind their filters; with a ``seed`` their noise as configured."""
    n = len(config.channels)
    volts = 2.5 + motion.readings(config.axis_positions(), np.array(config.axes)) / 9.80131
    if seed is not None:
        volts += 110e-6 * np.sqrt(500.0) * np.random.default_rng(seed).standard_normal(volts.shape)
    out = frames_of(np.zeros((len(volts), 6)), motion)
    out[:, COUNTS : COUNTS + 8] = 0.0
    out[:, COUNTS : COUNTS + n] = rc_filter(volts) * 6553.6
    return out


def trembling(seconds: float = 1.0) -> Motion:
    t = np.arange(round(1000.0 * seconds))[:, None] / 1000.0
    shake = np.sin(2.0 * np.pi * 10.0 * t)
    return hand_motion(3, seconds, 1e-5 * shake * [1.0, -1.0, 0.5], 1e-4 * shake * [1.0, 0.6, -0.8])


def run(rows: np.ndarray, config: SensingConfig) -> np.ndarray:
    sensing = Sensing(config)
    for row in rows:
        sensing.step(row)
    return rows


@pytest.mark.parametrize("table", [SEVEN, EIGHT])
def test_more_axes_solve_the_same_motion_and_leave_no_parity(table: dict[str, Any]) -> None:
    motion, config, six = trembling(0.5), SensingConfig.model_validate(table), SensingConfig(positions_m=PLACES[:3])
    more, fewer = Sensing(config), Sensing(six)
    rows = frames(motion, config)
    for row in rows:
        more.step(row)
    for row in frames_of(motion.readings(six.axis_positions(), np.array(six.axes)), motion):
        fewer.step(row)
        assert np.all(row[LAYOUT["parity"]] == 0.0)
    assert not np.any(rows[:, STATUS].astype(int) & INVALID)
    # specific force and angular acceleration before the filter takes its bias off; both know the rate to a mrad/s or so
    np.testing.assert_allclose(more.state["motion"], fewer.state["motion"], atol=1e-3)
    assert np.max(np.abs(fewer.state["motion"][0, 3:])) > 0.02
    assert np.max(np.abs(rows[:, LAYOUT["parity"]])) < 0.05


def test_parity_has_the_noise_of_a_sample_and_shows_a_sensor_that_lies() -> None:
    motion, config = trembling(4.0), SensingConfig.model_validate(EIGHT)
    rows = frames(motion, config, seed=4)
    rows[3000:, COUNTS + 3] += 6553.6 * 0.05  # one axis 50 mg off
    parity = run(rows, config)[:, LAYOUT["parity"]]
    # the filter's own first samples aside; 3 s hold some 140 independent ones: 12 % is two deviations
    np.testing.assert_allclose(parity[100:3000].std(axis=0), 1.0, atol=0.15)
    assert np.max(np.abs(parity[3100:].mean(axis=0))) > 20.0


def test_kernel_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SensingConfig.model_validate(EIGHT | {"align_s": 0.02})
    rows = frames(trembling(0.05), config, seed=1)
    twins = rows.copy()
    run(rows, config)
    assert_kernel_is_python(monkeypatch, stage, "sense_kernel", Sensing(config), twins, rows, atol=1e-12)
