"""What must not turn the attitude: a hand that moves away, a magnet; and how soon the attitude is there."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from firmware_py.frame import ALIGNING, LAYOUT, MAGNETOMETER_RAW, STATUS
from firmware_py.sensing.attitude_params import motion_densities, quiet_point
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import observation_matrix
from firmware_py.sensing.stage import Sensing
from tests.unit.sensing.rigid_body import RATE_HZ, Motion, frames_of


def held(seconds: float, path: np.ndarray | None = None) -> Motion:
    n = round(seconds * RATE_HZ)
    attitude = Rotation.from_euler("zyx", [40.0, 0.0, 135.0], degrees=True)
    return Motion(np.zeros((n, 3)) if path is None else path, Rotation.from_quat(np.tile(attitude.as_quat(), (n, 1))))


def run(motion: Motion, frames: np.ndarray, config: SensingConfig) -> tuple[np.ndarray, Sensing]:
    """World-frame attitude errors (n, 3), degrees."""
    sensing = Sensing(config)
    for frame in frames:
        sensing.step(frame)
    q = frames[:, LAYOUT["quaternion"]]
    return (Rotation.from_quat(np.roll(q, -1, axis=1)) * motion.attitude.inv()).as_rotvec(degrees=True), sensing


def test_a_hand_that_moves_away_does_not_turn_the_attitude() -> None:
    """100 mm in half a second (minimum jerk, 2.3 m/s^2): that velocity is no error of the attitude."""
    n = 4000
    u = np.clip((np.arange(n) / RATE_HZ - 2.0) / 0.5, 0.0, 1.0)
    motion = held(4.0, np.outer(10 * u**3 - 15 * u**4 + 6 * u**5, [0.1, 0.0, 0.0]))
    frames = frames_of(motion.readings(), motion, seed=3)
    worst, gated = {}, {}
    for gate in (4.0, 0.0):
        errors, sensing = run(motion, frames.copy(), SensingConfig(velocity_gate=gate))
        worst[gate] = np.max(np.hypot(errors[2000:, 0], errors[2000:, 1]))
        gated[gate] = sensing.state["attitude"]["error_state"]["gated"][0]
    assert worst[4.0] < 10.0 < 15.0 < worst[0.0]
    assert gated[4.0] > 100
    assert gated[0.0] == 0


def test_a_magnet_beside_the_instrument_does_not_turn_the_heading() -> None:
    """The field is 40 degrees off and too strong for two seconds."""
    motion = held(6.0)
    frames = frames_of(motion.readings(), motion, seed=4)
    frames[3000:5000, MAGNETOMETER_RAW : MAGNETOMETER_RAW + 3] += [0.3, 0.2, 0.1]
    errors, sensing = run(motion, frames, SensingConfig())
    before = np.sqrt(np.mean(errors[1500:3000, 2] ** 2))
    assert np.max(np.abs(errors[3000:, 2])) < max(4.0 * before, 4.0)
    assert sensing.state["attitude"]["error_state"]["rejected"][0] == 200


def test_the_attitude_is_there_after_less_than_a_tenth_of_a_second() -> None:
    motion = held(0.1)
    frames = frames_of(motion.readings(), motion, seed=5)
    errors, _ = run(motion, frames, SensingConfig())
    assert not int(frames[-1, STATUS]) & ALIGNING
    assert np.hypot(errors[-1, 0], errors[-1, 1]) < 0.3


def test_the_quiet_point_is_where_force_is_least_noisy() -> None:
    """Against the covariance of the readings' least squares about shifted origins."""
    config = SensingConfig(noise_ug_per_rtHz=(110.0, 90.0, 110.0, 130.0, 100.0, 110.0))
    point, density = quiet_point(config)
    sigma = np.array(config.noise_ug_per_rtHz) * 1e-6 * 9.80665 / np.sqrt(2.0)

    def about(r: np.ndarray) -> np.ndarray:
        observe = observation_matrix(config.axis_positions() - r, np.array(config.axes)) / sigma[:, None]
        return np.linalg.inv(observe.T @ observe)

    np.testing.assert_allclose(about(np.zeros(3)), motion_densities(config), rtol=1e-9)
    np.testing.assert_allclose(about(point)[:3, :3], density, rtol=1e-7, atol=1e-16)
    for shift in np.vstack([0.002 * np.eye(3), -0.002 * np.eye(3)]):
        assert np.trace(about(point + shift)[:3, :3]) > np.trace(density)
