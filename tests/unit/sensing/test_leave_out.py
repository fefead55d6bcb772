"""Sensing without one of eight axes: what is left says the same, nothing jumps, and which axis it was can be told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.control.parity import LIMIT, Parity, Verdict
from firmware_py.control.plan import load_plan
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import observation_matrix
from firmware_py.sensing.leave_out import tip_noise
from firmware_py.sensing.stage import Sensing
from hal.bench import load_bench
from hal.types import STANDARD_GRAVITY

BENCH = Path(__file__).parents[3] / "benches" / "micron-eight.toml"
MOTION = np.array([0.3, -0.2, 9.7, 1.0, -2.0, 0.5])  # f m/s^2, alpha rad/s^2


@pytest.fixture(scope="module")
def config() -> SensingConfig:
    return load_plan(load_bench(BENCH)).stages.sensing


def observe(config: SensingConfig) -> np.ndarray:
    return observation_matrix(config.axis_positions(), np.array(config.axes))


def noise(config: SensingConfig) -> np.ndarray:
    """110 ug per root hertz behind a corner of 15 Hz (noise bandwidth: the corner in rad/s, quartered)."""
    return 110e-6 * STANDARD_GRAVITY * np.sqrt(0.25 * config.cutoff_rad_s) * np.ones(8)


@pytest.mark.parametrize("axis", range(8))
def test_seven_axes_give_the_same_motion_whatever_the_eighth_reads(config: SensingConfig, axis: int):
    stage = Sensing(config)
    louder = stage.leave_out(axis, np.zeros(2))
    readings = observe(config) @ MOTION
    readings[axis] = 1e3
    np.testing.assert_allclose(stage.params["kinematics"]["solve"][0] @ readings, MOTION, atol=1e-9)
    assert stage.params["parities"][0] == 1
    parity = stage.params["null"][0] @ readings
    np.testing.assert_allclose(parity, 0.0, atol=1e-6)
    assert 1.0 < louder < 3.0


def test_the_loss_is_that_of_independent_least_squares(config: SensingConfig):
    stage = Sensing(config)
    louder = stage.leave_out(4, np.zeros(2))
    rows, tip = observe(config), np.array(config.tip_m)
    arm = np.hstack([np.eye(3), -np.array([[0, -tip[2], tip[1]], [tip[2], 0, -tip[0]], [-tip[1], tip[0], 0]])])

    def rms(use: list[int]) -> float:
        inverse = np.linalg.inv(rows[use].T @ rows[use])
        return float(np.sqrt(np.trace(arm @ inverse @ arm.T)))

    assert louder == pytest.approx(rms([0, 1, 2, 3, 5, 6, 7]) / rms(list(range(8))), rel=1e-9)
    assert tip_noise(np.linalg.pinv(rows), np.ones(8), tip) == pytest.approx(rms(list(range(8))), rel=1e-9)


def test_what_calibration_leaves_does_not_make_the_motion_jump(config: SensingConfig):
    stage = Sensing(config)
    errors = 0.01 * np.random.default_rng(3).standard_normal(8)  # 1 mg
    readings = observe(config) @ MOTION + errors
    before = stage.params["kinematics"]["solve"][0] @ readings
    bias_V = stage.params["calibration"]["bias_V"][0].copy()
    scale_V = stage.params["calibration"]["scale_V"][0].copy()
    stage.leave_out(2, stage.params["null"][0] @ readings)
    readings -= (stage.params["calibration"]["bias_V"][0] - bias_V) / scale_V
    np.testing.assert_allclose(stage.params["kinematics"]["solve"][0] @ readings, before, atol=1e-9)


def test_neighbours_take_their_cross_terms_from_a_parallel_axis(config: SensingConfig):
    stage = Sensing(config)
    stage.leave_out(1, np.zeros(2))  # 1z; 2z is parallel
    calibration = stage.params["calibration"][0]
    assert 1 not in calibration["in_plane"]
    assert calibration["in_plane"][0] == 3  # 1x had 1z
    assert abs(calibration["bias_in_plane"][0]).max() > 0.0


def test_each_axis_is_told_from_the_others_and_noise_from_a_fault(config: SensingConfig):
    null = Sensing(config).params["null"][0]
    random = np.random.default_rng(5)
    for axis in range(8):
        parity = Parity(null)
        hiss = noise(config)
        usual = 0.005 * random.standard_normal(8)
        verdicts = [parity.step(null @ (usual + hiss * random.standard_normal(8))) for _ in range(3000)]
        assert set(verdicts) == {Verdict.AGREED}
        fault = np.zeros(8)
        for k in range(200):  # 5 mg more every tick
            fault[axis] = 0.05 * k
            verdict = parity.step(null @ (usual + fault + hiss * random.standard_normal(8)))
            if verdict is not Verdict.AGREED and verdict is not Verdict.DOUBT:
                break
        assert verdict is Verdict.FOUND
        assert parity.axis == axis
        assert k < 30


def test_one_parity_tells_that_but_not_which(config: SensingConfig):
    stage = Sensing(config)
    stage.leave_out(0, np.zeros(2))
    parity = Parity(stage.params["null"][0])
    verdicts = [parity.step(np.zeros(2)) for _ in range(200)]
    verdicts += [parity.step(np.array([2.0 * LIMIT, 0.0])) for _ in range(30)]
    assert verdicts[-1] is Verdict.UNCLEAR
    assert Verdict.FOUND not in verdicts


def test_what_the_second_combination_said_last_is_no_contradiction_when_there_is_one_left(config: SensingConfig):
    """The stage does not fill it any more: the frame kept what had found the axis, and a quiet run was ended by it."""
    stage = Sensing(config)
    parity = Parity(stage.params["null"][0])
    verdicts = [parity.step(np.zeros(2)) for _ in range(200)]
    stage.leave_out(1, parity.usual)
    parity.restart(stage.params["null"][0])
    verdicts += [parity.step(np.array([0.6 * LIMIT, 0.95 * LIMIT])) for _ in range(30)]
    assert set(verdicts) == {Verdict.AGREED}


def test_what_contradicts_from_the_beginning_is_not_usual(config: SensingConfig):
    null = Sensing(config).params["null"][0]
    wrong = np.zeros(8)
    wrong[3] = 1.0  # 0.1 g
    parity = Parity(null)
    verdicts = [parity.step(null @ wrong) for _ in range(150)]
    assert verdicts[-1] is Verdict.UNCLEAR
