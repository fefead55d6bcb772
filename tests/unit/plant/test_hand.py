"""The synthetic hand: derivatives that belong together, a tremor as hard as a real one, the same for the same seed."""

import math

import numpy as np
import pytest
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from sim_devices.config import HandConfig
from sim_devices.plant.hand import PLANNED, POSE_HOLD_S, SyntheticHand, holding_frame, pose_angles, tremor_matrix
from sim_devices.plant.hand_kernel import between, hand_nodes, hand_pose, jerk_motion, pose_between, reach_motion
from sim_devices.plant.smooth_noise import smooth_noise
from sim_devices.plant.streams import stream


def motion(config, seed, milliseconds, block=None):
    hand = SyntheticHand(config, seed)
    pose, parts = np.zeros((milliseconds + 1, 18)), np.zeros((milliseconds + 1, 6))
    hand.start(pose[0], parts[0])
    block = block or milliseconds
    for at in range(1, milliseconds + 1, block):
        hand.fill(pose[at : at + block], parts[at : at + block])
    return pose, parts


def fine(pose, per_ms):
    """The pose at ``per_ms`` points per millisecond, by the quintics between nodes."""
    out, quintic = np.empty(((len(pose) - 1) * per_ms, 18)), np.empty((6, 6))
    for k in range(len(pose) - 1):
        between(pose[k], pose[k + 1], 1e-3, quintic)
        for j in range(per_ms):
            pose_between(quintic, j / per_ms, 1e-3, out[k * per_ms + j])
    return out


def test_velocity_and_acceleration_are_the_derivatives_of_position():
    """Within a millisecond by a five-point stencil; from one to the next without a jump."""
    pose, _ = motion(HandConfig(jerk_interval_s=0.5), 3, 3000)
    x = fine(pose, 8).reshape(3000, 8, 18)
    h = 0.125e-3
    for order in range(2):
        y = x[:, :, 6 * order : 6 * order + 6]
        numeric = (y[:, 1:4] - 8 * y[:, 2:5] + 8 * y[:, 4:7] - y[:, 5:8]) / (12 * h)
        exact = x[:, 3:6, 6 * order + 6 : 6 * order + 12]
        assert np.all(np.abs(numeric - exact).max(axis=(0, 1)) < 2e-6 * exact.std(axis=(0, 1)))
    quintic, end = np.empty((6, 6)), np.empty(18)
    for k in range(0, 3000, 50):
        between(pose[k], pose[k + 1], 1e-3, quintic)
        pose_between(quintic, 1.0, 1e-3, end)
        assert np.allclose(end, pose[k + 1], rtol=1e-9, atol=1e-12)


def test_nodes_belong_to_one_smooth_motion():
    """A quintic over two milliseconds meets the node in the middle: position, velocity and acceleration agree."""
    pose, _ = motion(HandConfig(jerk_um=0.0), 4, 2000)
    quintic, middle = np.empty((6, 6)), np.empty(18)
    worst = np.zeros(18)
    for k in range(0, 1998, 2):
        between(pose[k], pose[k + 2], 2e-3, quintic)
        pose_between(quintic, 0.5, 2e-3, middle)
        worst = np.maximum(worst, np.abs(middle - pose[k + 1]))
    assert np.all(worst[:6] < 1e-6 * pose[:, :6].std(axis=0))
    assert np.all(worst[6:12] < 1e-5 * pose[:, 6:12].std(axis=0))
    assert np.all(worst[12:] < 2e-2 * pose[:, 12:].std(axis=0))


def test_reach_and_jerk_shapes():
    reach = np.array([[1.0, 2.0, *np.zeros(6), *np.full(6, 3.0)]])
    for t, share in ((0.5, 0.0), (1.0, 0.0), (2.0, 0.5), (3.0, 1.0), (9.0, 1.0)):
        out, intended = np.zeros(18), np.zeros(6)
        reach_motion(t, reach, 0, out, intended)
        assert out[:6] == pytest.approx(3.0 * share)
        assert intended[:3] == pytest.approx(3.0 * share)
    out = np.zeros(18)
    jerk_motion(0.12, np.array([[0.0, 0.04, 1.0, 2.0, 3.0]]), 0, out)
    assert out[:3] == pytest.approx([1.0, 2.0, 3.0])
    assert out[6:9] == pytest.approx(0.0, abs=1e-12)


def test_smooth_noise_has_unit_variance_and_its_correlation_time():
    noise = smooth_noise(0.05, 1e-3)
    covariance = noise.stationary @ noise.stationary.T
    assert covariance[0, 0] == pytest.approx(1.0)
    lagged = covariance.copy()
    for _ in range(50):
        lagged = noise.transition @ lagged
    assert lagged[0, 0] == pytest.approx(math.exp(-1.0), abs=0.01)


def test_tremor_is_fifty_micrometres_narrow_band_and_no_sine():
    """17.7 um rms per axis over people; 0.35 to 1 Hz of spread; a sine explains less than a third of 20 s."""
    variance = []
    for seed in range(4):
        _, parts = motion(HandConfig(), seed, 60_000)
        tremor = parts[:, 3:]
        variance.append(tremor.var(axis=0))
        f, power = welch(tremor, 1000.0, nperseg=4096, axis=0)
        power = power.sum(axis=1)
        assert power[(f >= 7.5) & (f <= 12.5)].sum() > 0.95 * power.sum()
        mean = np.average(f, weights=power)
        assert 8.3 < mean < 11.7
        near = (f > 6.0) & (f < 14.0)
        assert 0.35 < math.sqrt(np.average((f[near] - mean) ** 2, weights=power[near])) < 1.0
        x = tremor[:20_000, 0]
        best_line = 2.0 * np.max(np.abs(np.fft.rfft(x, 2**18))) ** 2 / len(x) / np.sum(x * x)
        assert best_line < 0.34
    assert math.sqrt(np.mean(variance)) * 1e6 == pytest.approx(50.0 / (2.0 * math.sqrt(2.0)), rel=0.15)


def test_amplitude_fades_as_in_a_gaussian_process():
    _, parts = motion(HandConfig(), 2, 60_000)
    window = np.abs(parts[1:, 3].reshape(-1, 500)).max(axis=1)
    assert window.std() / window.mean() > 0.35
    assert window.min() < 0.35 * window.mean()


def test_voluntary_motion_is_below_one_hertz_and_hundreds_of_micrometres():
    _, parts = motion(HandConfig(), 1, 120_000)
    f, power = welch(parts[:, :3], 1000.0, nperseg=16384, axis=0)
    assert power[f > 1.0].sum() < 1e-3 * power.sum()
    assert 300e-6 < np.ptp(parts[:, :3], axis=0).min() <= 600e-6


def test_turning_about_the_grip_moves_the_tip():
    """Turning by (ax, ay) about a grip L behind the tip moves the tip by L (ay, -ax) in body axes."""
    config = HandConfig(rotation_share=1.0)
    frame = holding_frame(config)
    matrix = tremor_matrix(config, frame)
    body, angles = frame.T @ matrix[:3, :3], matrix[3:, :3]
    assert np.allclose(body[0], 0.09 * angles[1], rtol=1e-12, atol=1e-18)
    assert np.allclose(body[1], -0.09 * angles[0], rtol=1e-12, atol=1e-18)
    assert np.allclose(np.sum(body**2, axis=1), (50e-6 / (2.0 * math.sqrt(2.0))) ** 2)
    correlation = (body @ body.T) / np.sum(body[0] ** 2)
    assert np.allclose(correlation, [[1.0, 0.4, 0.4], [0.4, 1.0, 0.4], [0.4, 0.4, 1.0]])
    down = frame[:, 2]
    assert math.degrees(math.acos(-down[2])) == pytest.approx(40.0)


def test_same_seed_same_hand_whatever_the_blocks():
    a, ap = motion(HandConfig(), 9, 960, block=16)
    b, bp = motion(HandConfig(), 9, 960, block=320)
    assert np.array_equal(a, b)
    assert np.array_equal(ap, bp)
    c, _ = motion(HandConfig(), 10, 960, block=16)
    assert not np.array_equal(a, c)


def test_no_tremor_when_none_is_asked_for():
    _, parts = motion(HandConfig(tremor_pp_um=0.0), 1, 100)
    assert not parts[:, 3:].any()


def test_compiled_and_python_agree():
    ours, python = SyntheticHand(HandConfig(), 5), SyntheticHand(HandConfig(), 5)
    noise = np.random.default_rng(0).standard_normal((12, 20))
    a, ap, b, bp = np.zeros((12, 18)), np.zeros((12, 6)), np.zeros((12, 18)), np.zeros((12, 6))
    hand_nodes(ours._p, ours._s, noise, (ours._reaches, ours._jerks), a, ap)
    hand_nodes.py_func(python._p, python._s, noise, (python._reaches, python._jerks), b, bp)
    assert np.allclose(a, b, rtol=1e-12, atol=1e-18)
    assert np.allclose(ap, bp, rtol=1e-12, atol=1e-18)
    c, cp = np.zeros(18), np.zeros(6)
    hand_pose.py_func(python._p[0], python._s[0], python._reaches, python._jerks, c, cp)
    assert np.allclose(c, b[-1], rtol=1e-12, atol=1e-18)
    q, r, x, y = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(18), np.zeros(18)
    between(a[0], a[1], 1e-3, q)
    between.py_func(a[0], a[1], 1e-3, r)
    pose_between(q, 0.3, 1e-3, x)
    pose_between.py_func(r, 0.3, 1e-3, y)
    assert np.allclose(q, r, rtol=1e-12, atol=1e-20)
    assert np.allclose(x, y, rtol=1e-9, atol=1e-12)


def test_calibration_poses_are_every_half_axis_and_octant_once_and_are_held():
    """Up in body axes, by scipy's rotations; then the hand itself: still for the pose's rest, in fourteen places."""
    ups = Rotation.from_euler("ZYX", pose_angles()[:, ::-1]).inv().apply([0.0, 0.0, 1.0])
    assert {tuple(up) for up in np.sign(ups.round(9))} == {
        (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) in (1, 3)
    }
    assert np.abs(np.diff(pose_angles(), axis=0)).max() <= math.pi / 2 + 1e-12
    config = HandConfig(
        performs="poses", reach_s=(1.0, 1.0), hold_s=(0.0, 0.0), voluntary_angle_deg=0.0, tremor_pp_um=0.0,
        roll_tremor_mrad=0.0,
    )  # fmt: skip
    pose, _ = motion(config, 2, 14 * 2500)
    rests = [k * 2500 for k in range(1, 15)]  # each reach ends here and the next begins after POSE_HOLD_S
    assert np.allclose(pose[rests, 3:6], pose_angles(), atol=1e-12)
    assert np.ptp(pose[2500 : 2500 + round(1000 * POSE_HOLD_S), 3:6], axis=0).max() == 0.0


def test_a_long_run_keeps_few_reaches_and_they_are_those_of_a_plan_in_one_go() -> None:
    config, seed, n = HandConfig(), 7, 1500
    hand = SyntheticHand(config, seed)
    pose, parts = np.zeros((256, 18)), np.zeros((256, 6))
    seen: dict[float, np.ndarray] = {}
    while len(seen) < n:
        hand.fill(pose, parts)
        seen |= {float(row[0]): row for row in hand._reaches}
        assert len(hand._reaches) <= 2 * PLANNED
        assert len(hand._jerks) <= 2 * PLANNED
    draw = stream(seed, "hand.reaches").random((n, 8))
    duration_s = config.reach_s[0] + (config.reach_s[1] - config.reach_s[0]) * draw[:, 0]
    hold_s = config.hold_s[0] + (config.hold_s[1] - config.hold_s[0]) * draw[:, 1]
    found = np.array([seen[t] for t in sorted(seen)[:n]])
    np.testing.assert_array_equal(found[:, 0], np.cumsum(hold_s + duration_s) - duration_s)
    np.testing.assert_array_equal(found[1:, 2:8], found[:-1, 8:])
    np.testing.assert_array_equal(np.sign(found[:, 8:]), np.sign(2.0 * draw[:, 2:] - 1.0))
