"""The sensing stage on a moving instrument: attitude, tip acceleration, bad samples, gaps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.frame import COUNTS, INVALID, LAYOUT, RESTARTED, SATURATED, STATUS, TICK, TIP_ACCELERATION
from firmware_py.sensing import stage
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing
from firmware_py.sensing.translation import displacement_response
from hal.errors import BenchError
from tests.unit.pure_python import assert_kernel_is_python
from tests.unit.sensing.rigid_body import RATE_HZ, TIP, Motion, frames_of, hand_motion, rc_filter


def tone(seconds: float, hz: float, amplitude: np.ndarray, phase: float = 0.0) -> np.ndarray:
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.sin(2 * np.pi * hz * t + phase)[:, None] * np.asarray(amplitude)


def run(frames: np.ndarray, config: SensingConfig | None = None) -> Sensing:
    sensing = Sensing(config or SensingConfig())
    for frame in frames:
        sensing.step(frame)
    return sensing


def amplitude(signal: np.ndarray, hz: float) -> np.ndarray:
    """Complex amplitude of the last 2 s at ``hz`` (whole periods)."""
    t = np.arange(len(signal))[-2000:] / RATE_HZ
    return 2.0 * np.mean(signal[-2000:] * np.exp(-2j * np.pi * hz * t)[:, None], axis=0)


@pytest.fixture(scope="module")
def trembling() -> tuple[np.ndarray, Motion]:
    """10 Hz in translation and, out of phase, in rotation; tool tip down at 45 degrees."""
    motion = hand_motion(
        3, 8.0, tone(8.0, 10.0, np.array([8e-6, -5e-6, 6e-6])), tone(8.0, 10.0, np.array([9e-5, 6e-5, -8e-5]), 1.0)
    )
    frames = frames_of(motion.readings(), motion)
    run(frames)
    return frames, motion


def test_tip_acceleration_is_the_true_one_behind_the_rc_filter(trembling: tuple[np.ndarray, Motion]) -> None:
    """Gravity that leans into the axes with the tilt (2.5 mm of lever at 10 Hz) is gone, amplitude and phase."""
    frames, motion = trembling
    true = rc_filter(motion.attitude[0].inv().apply(motion.acceleration(TIP)))
    ours = amplitude(frames[:, LAYOUT["tip_acceleration"]], 10.0)
    error = np.abs(ours - amplitude(true, 10.0)) / np.abs(amplitude(true, 10.0))
    assert np.max(error) < 0.05


@pytest.mark.parametrize(("hz", "share"), [(8.5, 0.6), (9.8, 0.01), (11.5, 0.1)])
def test_gravity_that_leans_with_the_tilt_is_removed(hz: float, share: float) -> None:
    """Turning about the origin leaves gravity swinging through its axes: the lever of the tip must come out as 155 mm,
    not as 155 - g / omega^2. The filter's own corrections at the edges of the notch leave more of it."""
    motion = hand_motion(4, 12.0, np.zeros((12_000, 3)), tone(12.0, hz, np.array([1e-3, -1e-3, 1e-3])))
    frames = frames_of(motion.readings(), motion)
    run(frames)
    true = amplitude(rc_filter(motion.attitude[0].inv().apply(motion.acceleration(TIP))), hz)
    error = np.abs(amplitude(frames[:, LAYOUT["tip_acceleration"]], hz) - true)
    behind_filter = 1.0 / np.hypot(1.0, 2.0 * np.pi * hz * 32_000.0 * 0.33e-6)
    leaning = behind_filter * 9.80131 * 1e-3 * np.sin(np.radians(135.0))
    assert np.all(error < share * leaning)


def test_tip_displacement_has_the_stated_response(trembling: tuple[np.ndarray, Motion]) -> None:
    frames, motion = trembling
    config = SensingConfig()
    true = amplitude(motion.attitude[0].inv().apply(motion.point(TIP)), 10.0)
    response = displacement_response(np.array([10.0]), RATE_HZ, config.cutoff_rad_s)[0]
    ours = amplitude(frames[:, LAYOUT["tip_displacement"]], 10.0)
    np.testing.assert_allclose(ours, true * response, atol=0.05 * np.abs(true).max())


@pytest.mark.parametrize("method", ["observer", "quaternion-kalman"])
def test_the_filter_of_a_package_finds_the_attitude(trembling: tuple[np.ndarray, Motion], method: str) -> None:
    frames, motion = trembling[0][:2000].copy(), trembling[1]
    run(frames, SensingConfig(attitude_method=method))
    ours = Rotation.from_quat(frames[-1, LAYOUT["quaternion"]], scalar_first=True)
    assert np.degrees((ours * motion.attitude[1999].inv()).magnitude()) < 1.0  # as in the slow hand below
    assert np.any(frames[-1, LAYOUT["quaternion"]] != trembling[0][1999, LAYOUT["quaternion"]])


def test_an_installed_wheel_says_where_the_other_filters_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_py.sensing.config.offered", lambda group: {})
    with pytest.raises(BenchError, match="'observer' is a filter to compare with: only a source tree has it"):
        SensingConfig.from_dict({"attitude_method": "observer"})
    with pytest.raises(BenchError, match="there are error-state"):
        SensingConfig.from_dict({"attitude_method": "kalman"})


def test_attitude_follows_a_slow_hand_with_noisy_sensors() -> None:
    seconds = 20.0
    sway = tone(seconds, 0.2, np.array([0.05, -0.04, 0.06]))
    motion = hand_motion(5, seconds, np.zeros((20_000, 3)), sway)
    frames = frames_of(motion.readings(), motion, seed=5)
    run(frames)
    q = frames[:, LAYOUT["quaternion"]]
    assert np.all(q[:, 0] >= 0.0)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
    error = (Rotation.from_quat(np.roll(q, -1, axis=1)).inv() * motion.attitude).as_rotvec(degrees=True)
    rms = np.sqrt(np.mean(error[5000:] ** 2, axis=0))
    assert np.all(rms < [1.0, 1.0, 1.5])


def test_without_a_magnetometer_the_attitude_stays_bounded() -> None:
    motion = hand_motion(6, 20.0, np.zeros((20_000, 3)), np.zeros((20_000, 3)), tilt_deg=0.0)
    frames = frames_of(motion.readings(), motion, seed=6)
    frames[:, LAYOUT["magnetometer_fresh"]] = 0.0
    run(frames)
    assert np.max(np.abs(frames[:, LAYOUT["rate"]])) < 0.5
    assert np.all(frames[2000:, STATUS] == 0.0)


def test_a_bad_sample_changes_nothing_but_its_flag() -> None:
    motion = hand_motion(7, 1.0, tone(1.0, 10.0, np.full(3, 1e-5)), np.zeros((1000, 3)))
    frames = frames_of(motion.readings(), motion)
    sensing = run(frames[:-1])
    before = sensing.state.copy()
    bad = frames[-1].copy()
    bad[COUNTS + 2] = np.nan
    sensing.step(bad)
    assert int(bad[STATUS]) & INVALID
    assert sensing.state.tobytes() == before.tobytes()
    sensing.step(frames[-1])
    assert np.all(np.isfinite(frames[-1]))


def test_a_long_gap_aligns_anew_and_a_short_one_coasts() -> None:
    motion = hand_motion(8, 2.0, tone(2.0, 10.0, np.full(3, 1e-5)), tone(2.0, 10.0, np.full(3, 1e-4)))
    frames = frames_of(motion.readings(), motion)
    whole = frames.copy()
    run(whole)
    gap = np.delete(frames, np.arange(1500, 1505), axis=0)
    run(gap)
    assert not np.any(gap[:, STATUS].astype(int) & RESTARTED)
    scale = np.abs(whole[1000:, TIP_ACCELERATION]).max()
    assert np.max(np.abs(gap[-100:, TIP_ACCELERATION] - whole[-100:, TIP_ACCELERATION])) < 0.2 * scale
    frames[1500:, TICK] += 200
    run(frames)
    assert int(frames[1500, STATUS]) & RESTARTED
    assert np.all(frames[1500:1579, LAYOUT["tip_acceleration"]] == 0.0)


def test_a_reading_beyond_the_range_is_flagged() -> None:
    motion = hand_motion(9, 0.1, np.zeros((100, 3)), np.zeros((100, 3)))
    frames = frames_of(motion.readings(), motion)
    frames[50, COUNTS] = 6553.6 * (2.5 + 1.75)
    run(frames)
    assert int(frames[50, STATUS]) & SATURATED
    assert not int(frames[49, STATUS]) & SATURATED


def test_supply_that_moves_cancels() -> None:
    """ADXL-203 data sheet: ratiometric. Everything scales with the supply; readings must not."""
    motion = hand_motion(10, 0.5, np.zeros((500, 3)), np.zeros((500, 3)))
    frames = frames_of(motion.readings(), motion)
    low = frames.copy()
    low[:, COUNTS : COUNTS + 7] *= 4.8 / 5.0
    run(frames)
    run(low)
    np.testing.assert_allclose(low[:, LAYOUT["accelerometer"]], frames[:, LAYOUT["accelerometer"]], atol=1e-9)
    np.testing.assert_allclose(low[:, LAYOUT["supply"]], 4.8)


def test_calibration_undoes_bias_scale_temperature_and_misalignment() -> None:
    bias, scale = np.linspace(2.45, 2.55, 6), np.linspace(0.95, 1.05, 6)
    axes = SensingConfig().axes + 0.02 * np.random.default_rng(1).standard_normal((6, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    motion = hand_motion(11, 0.5, np.zeros((500, 3)), np.zeros((500, 3)))
    frames = frames_of(motion.readings(axes=axes), motion)
    g = motion.readings(axes=axes) / 9.80131
    warm = 10.0
    volts = bias + 1e-4 * warm + scale * (1.0 + 2e-4 * warm) * g
    frames[:, COUNTS : COUNTS + 6] = volts * 6553.6
    frames[:, COUNTS + 7] = (0.5 + 0.01 * 35.0) * 6553.6
    config = SensingConfig(
        bias_V=tuple(bias),
        scale_V_per_g=tuple(scale),
        bias_V_per_C=(1e-4,) * 6,
        scale_per_C=(2e-4,) * 6,
        axes=tuple(map(tuple, axes)),
    )
    run(frames, config)
    force = motion.attitude.inv().apply([0.0, 0.0, 9.80131])
    np.testing.assert_allclose(frames[-1, LAYOUT["specific_force"]], force[-1], atol=1e-9)
    np.testing.assert_allclose(frames[-1, LAYOUT["angular_acceleration"]], 0.0, atol=1e-8)


def test_kernel_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    motion = hand_motion(12, 0.06, tone(0.06, 10.0, np.full(3, 1e-5)), tone(0.06, 9.0, np.full(3, 1e-4)))
    frames = frames_of(motion.readings(), motion, seed=1)
    twins = frames.copy()
    config = SensingConfig(align_s=0.02)
    run(frames, config)
    assert_kernel_is_python(monkeypatch, stage, "sense_kernel", Sensing(config), twins, frames, atol=1e-12)


def test_reset_is_a_new_start() -> None:
    motion = hand_motion(13, 0.5, tone(0.5, 10.0, np.full(3, 1e-5)), np.zeros((500, 3)))
    frames = frames_of(motion.readings(), motion, seed=2)
    again = frames.copy()
    sensing = run(frames)
    sensing.reset()
    for frame in again:
        sensing.step(frame)
    assert np.array_equal(again, frames)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"tip": [0, 0, 0.1]}, "unknown key"),
        ({"channels": [0, 1, 2, 3, 4, 6]}, "different numbers"),
        ({"positions_m": [[0, 0, 0], [0, 0, 0], [0, 0, 0.1]]}, "singular"),
        ({"scale_V_per_g": [1, 1, 0, 1, 1, 1]}, "zero"),
    ],
)
def test_a_wrong_key_is_named(table: dict[str, object], message: str) -> None:
    with pytest.raises(BenchError, match=message):
        SensingConfig.from_dict(table)
