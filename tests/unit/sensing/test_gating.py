"""What must not turn the attitude: a hand that moves away, a magnet; and how soon the attitude is there."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfiltfilt
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
        errors, sensing = run(motion, frames.copy(), SensingConfig(velocity_gate=gate, hand_swing_s=0.0))
        worst[gate] = np.max(np.hypot(errors[2000:, 0], errors[2000:, 1]))
        gated[gate] = sensing.state["attitude"]["error_state"]["gated"][0]
    assert worst[4.0] < 10.0 < 15.0 < worst[0.0]
    assert gated[4.0] > 100
    assert gated[0.0] == 0
    # a hand whose velocity is looked for needs no gate for that
    errors, _ = run(motion, frames.copy(), SensingConfig(velocity_gate=0.0))
    assert np.max(np.hypot(errors[2000:, 0], errors[2000:, 1])) < 4.0


def swing(seed: int, calm_m_s: float, burst_m_s: float) -> np.ndarray:
    """(12000, 3) m: a hand that swings at 1.5 to 6 Hz with this velocity (rms), from 4 to 5.5 s with the other one."""
    n = 12_000
    band = butter(2, [1.5, 6.0], "bandpass", fs=RATE_HZ, output="sos")
    path = sosfiltfilt(band, np.random.default_rng(seed).standard_normal((n, 3)), axis=0)
    t_s = np.arange(n) / RATE_HZ
    size = gaussian_filter1d(np.where((t_s > 4.0) & (t_s < 5.5), burst_m_s, calm_m_s), 150.0)
    return size[:, None] * path / np.std(np.gradient(path, 1.0 / RATE_HZ, axis=0))


def tilt_rms_deg(motion: Motion, frames: np.ndarray, config: SensingConfig) -> float:
    errors, _ = run(motion, frames.copy(), config)
    return float(np.sqrt(np.mean(errors[1500:, 0] ** 2 + errors[1500:, 1] ** 2)))


def test_after_a_wild_swing_neither_its_velocity_nor_the_field_turns_the_tilt_away() -> None:
    """The body's z axis leans and the dip is 66 degrees: an error about it turns what the field shows the other way."""
    motion = held(12.0, swing(1, 3e-3, 30e-3))
    frames = frames_of(motion.readings(), motion, seed=1)
    assert tilt_rms_deg(motion, frames, SensingConfig()) < 1.0
    assert tilt_rms_deg(motion, frames, SensingConfig(heading_tilts=False)) > 10.0
    assert tilt_rms_deg(motion, frames, SensingConfig(hand_swing_s=0.0)) > 3.0


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
