"""Calibration of three-axis sensors from made logs whose parameters are known, and from real ones if they are there."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tools.calibrate.ellipsoid import fit_ellipsoid
from tools.calibrate.multi_position import fit_poses, identify_poses, missing_poses
from tools.calibrate.quick import flat, free_fall, turn
from tools.calibrate.still import common_warm_up, remove_drift, warm_up
from tools.errors import InputError

G = 9.80665
TRUE_BIAS = np.array([300.0, -500.0, 900.0])
TRUE_SCALE = np.array([1600.0, 1650.0, 1580.0])  # counts per m/s^2
RATE_HZ = 100.0


def posed_log(poses: int, seed: int = 1) -> np.ndarray:
    """Still poses of 2 s with hand turns of 1 s between."""
    rng = np.random.default_rng(seed)
    attitudes = Rotation.random(poses, random_state=seed)  # type: ignore[call-arg]
    turn_in = np.array([[1.0, 0.01, -0.02], [0.0, 1.0, 0.015], [0.0, 0.0, 1.0]])
    parts = []
    for a, b in itertools.pairwise(attitudes):
        still = np.tile(a.inv().apply([0.0, 0.0, G]), (200, 1))
        step = (a.inv() * b).as_rotvec()
        moving = np.array([(a * Rotation.from_rotvec(step * s)).inv().apply([0, 0, G]) for s in np.linspace(0, 1, 100)])
        parts += [still, moving + 1.5 * rng.standard_normal((100, 3))]
    force = np.vstack(parts)
    return (force @ turn_in.T) * TRUE_SCALE + TRUE_BIAS + 8.0 * rng.standard_normal(force.shape)


def test_quick_methods_refuse_a_log_of_something_else() -> None:
    rng = np.random.default_rng(0)
    resting = np.tile([0, 0, 16384.0], (400, 1)) + TRUE_BIAS + 5.0 * rng.standard_normal((400, 3))
    with pytest.raises(InputError, match="does not turn"):
        turn(resting)
    slope = np.linspace(-1.0, 1.0, 400)[:, None] * [16000.0, 16000.0, 16000.0]
    with pytest.raises(InputError, match="no slow turn"):
        turn(slope + TRUE_BIAS)
    with pytest.raises(InputError, match="is -z the axis that points up"):
        flat(resting, 16384.0, "-z")
    with pytest.raises(InputError, match="it moves"):
        flat(resting + np.linspace(0.0, 8000.0, 400)[:, None], 16384.0, "z")


def test_poses_give_bias_and_scale_inside_their_intervals() -> None:
    result = identify_poses(posed_log(40), RATE_HZ, G)
    assert result.poses >= 35
    assert result.residual_m_s2 < 2e-3
    inside = 0
    for i, axis in enumerate("xyz"):
        bias = result.parameters[f"bias_{axis}"]
        inside += bias.low <= TRUE_BIAS[i] <= bias.high
        # misalignment in front of the scale changes a row's length by its square only
        assert 1.0 / result.parameters[f"scale_{axis}"].value == pytest.approx(TRUE_SCALE[i], rel=1e-3)
        assert bias.value == pytest.approx(TRUE_BIAS[i], abs=8.0)
    assert inside >= 2


def test_too_few_poses_are_refused() -> None:
    with pytest.raises(InputError, match="nine are needed"):
        identify_poses(posed_log(7), RATE_HZ, G)


def test_what_the_poses_do_not_tell_stays_within_what_a_maker_allows() -> None:
    """The ten poses of the MPU-6050's log: none is turned about z, so nothing tells the angle between x and y."""
    up = np.array([[0, 0, 1.0], [0.1, 0, -1], [-1, 0, -0.1], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    up = np.vstack([up, [[0, 0.8, 0.6], [0, -0.7, 0.7], [-0.9, 0, 0.4], [0.6, 0, 0.8]]])
    force = G * up / np.linalg.norm(up, axis=1)[:, None]
    rng = np.random.default_rng(1)
    off, inside = np.empty(20), 0
    for k in range(20):
        t = 0.02 * rng.standard_normal(3)
        turn_in = np.linalg.inv([[1.0, -t[0], t[1]], [0.0, 1.0, -t[2]], [0.0, 0.0, 1.0]])
        mean = (force @ turn_in.T) * TRUE_SCALE + TRUE_BIAS + 3.0 * rng.standard_normal((10, 3))
        held = fit_poses(mean, np.ones(10), G, pose_noise=3.0).parameters
        off[k] = held["misalignment_0"].value - t[0]
        true = [*t, *(1.0 / TRUE_SCALE), *TRUE_BIAS]
        inside += sum(e.low < v < e.high for e, v in zip(held.values(), true, strict=True))
    # without that some of them are radians off
    assert np.max(np.abs(off)) < 0.06
    assert inside >= 0.95 * 20 * 9


def test_missing_poses_are_named() -> None:
    assert missing_poses(np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0]])) == ("z down",)


def test_quick_methods() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 2.0 * np.pi, 2000)
    circles = np.vstack(
        [np.stack([np.cos(t), np.sin(t), 0 * t], axis=1), np.stack([0 * t, np.cos(t), np.sin(t)], axis=1)]
    )
    turned = turn(circles * 16000.0 + TRUE_BIAS + 5.0 * rng.standard_normal(circles.shape))
    assert turned.missing == ()
    for i, axis in enumerate("xyz"):
        assert turned.parameters[f"bias_{axis}"].value == pytest.approx(TRUE_BIAS[i], abs=10.0)
        assert turned.parameters[f"scale_{axis}"].value == pytest.approx(16000.0, abs=20.0)
    fall = np.vstack([np.tile([0, 0, 16384.0], (200, 1)), np.zeros((60, 3)), np.tile([0, 0, 16384.0], (200, 1))])
    dropped = free_fall(fall + TRUE_BIAS + 5.0 * rng.standard_normal(fall.shape), 200.0, 16384.0)
    lying = flat(np.tile([0, 0, -16384.0], (400, 1)) + TRUE_BIAS + 5.0 * rng.standard_normal((400, 3)), 16384.0, "-z")
    for i, axis in enumerate("xyz"):
        for result in (dropped, lying):
            bias = result.parameters[f"bias_{axis}"]
            assert bias.value == pytest.approx(TRUE_BIAS[i], abs=4.0)
            assert bias.low < bias.value < bias.high
    with pytest.raises(InputError, match="no free fall"):
        free_fall(np.tile([0, 0, 16384.0], (400, 1)), 200.0, 16384.0)


def test_a_warming_sensor_is_seen_and_a_warm_one_is_not_accused() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(6000) / 100.0
    noise = rng.standard_normal(len(t))
    assert warm_up(t, noise, 1.0).steady
    cold = warm_up(t, 50.0 * np.exp(-t / 40.0) + noise, 1.0)
    assert not cold.steady
    assert cold.remaining == pytest.approx(-50.0 * np.exp(-60.0 / 40.0), rel=0.15)


def test_a_cold_log_is_refused_or_its_drift_removed() -> None:
    rng = np.random.default_rng(0)
    rest = np.tile([300.0, -500.0, 16900.0], (6000, 1)) + 4.0 * rng.standard_normal((6000, 3))
    moved = posed_log(14)
    t = np.arange(len(rest) + len(moved)) / RATE_HZ
    drift = 400.0 * np.exp(-t / 30.0)[:, None]
    log = np.vstack([rest, moved])
    with pytest.raises(InputError, match="warming up"):
        remove_drift(log + drift, RATE_HZ, allowed=False)
    out, found = remove_drift(log + drift, RATE_HZ, allowed=True)
    assert not found.steady
    late = t > 60.0
    assert np.sqrt(np.mean((out - log)[late] ** 2)) < 0.2 * np.sqrt(np.mean(drift[late] ** 2))


def test_axes_warm_up_with_one_time_constant() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(6000) / 100.0
    amplitude = np.array([50.0, -30.0, 0.0])
    value = 7.0 + amplitude * np.exp(-t / 40.0)[:, None] + rng.standard_normal((len(t), 3))
    constant, to_come = common_warm_up(t, value)
    assert constant == pytest.approx(40.0, rel=0.1)
    np.testing.assert_allclose(to_come, -amplitude * np.exp(-t[-1] / 40.0), atol=1.0)


def test_poses_within_a_cone_are_refused_and_the_missing_ones_named() -> None:
    rng = np.random.default_rng(2)
    lean = 0.3 * rng.uniform(-1.0, 1.0, (14, 2))
    up = np.column_stack([lean, np.sqrt(1.0 - np.sum(lean**2, axis=1))])
    with pytest.raises(InputError, match="x up, x down, y up, y down, z down"):
        fit_poses(16384.0 * up + 2.0 * rng.standard_normal((14, 3)), np.ones(14), 9.81)


def test_an_ellipsoid_with_outliers_comes_back() -> None:
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    soft = np.array([[500.0, 20.0, -10.0], [20.0, 420.0, 15.0], [-10.0, 15.0, 610.0]])
    raw = directions @ soft + np.array([150.0, -90.0, 40.0]) + 2.0 * rng.standard_normal((4000, 3))
    raw[::40] += rng.normal(0.0, 800.0, (100, 3))
    result = fit_ellipsoid(raw)
    np.testing.assert_allclose(result.bias, [150.0, -90.0, 40.0], atol=0.5)
    np.testing.assert_allclose(result.matrix @ soft, np.eye(3), atol=2e-3)
    assert 80 <= result.outliers <= 140
    assert result.missing == ()


def test_half_a_sphere_is_said_to_be_half() -> None:
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    directions[:, 2] = np.abs(directions[:, 2])
    result = fit_ellipsoid(500.0 * directions + rng.standard_normal((2000, 3)))
    assert result.missing == ("z down",)


def test_the_xsens_log_reaches_its_reference(shared_data: Path) -> None:
    from tools.calibrate.logs import load_log

    log = load_log(shared_data / "imu_tk_xsens")
    result = identify_poses(log.matrix(("acc_x_raw", "acc_y_raw", "acc_z_raw")), log.need_rate(), 9.81744)
    assert result.residual_m_s2 <= 0.0135
    scale = [1.0 / result.parameters[f"scale_{a}"].value for a in "xyz"]
    np.testing.assert_allclose(scale, [414.43, 412.03, 414.62], atol=0.05)
