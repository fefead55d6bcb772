"""What the quick accelerometer calibrations say of themselves, against logs whose answer is known in closed form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command import micron
from tools.calibrate.quick import QuickResult, flat, free_fall, turn
from tools.calibrate.still import remove_drift
from tools.errors import InputError

ONE_G = 16384.0
BIAS = np.array([300.0, -500.0, 900.0])
SCALE = np.array([16000.0, 16500.0, 15800.0])
FIVE = ("x up", "x down", "y up", "y down", "z down")


def turned(samples: int, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Once about x, then about y, through all six poses, without a jump between."""
    t = np.linspace(0.0, 2.0 * np.pi, samples)
    about_x = np.stack([0 * t, np.sin(t), np.cos(t)], axis=1)
    about_y = np.stack([np.sin(t), 0 * t, np.cos(t)], axis=1)
    rng = np.random.default_rng(seed)
    force = np.vstack([about_x, about_y])
    return force * SCALE + BIAS + noise * rng.standard_normal(force.shape)


def exact(result: QuickResult) -> None:
    assert result.freedom == 0
    assert result.residual is None
    assert result.readings == len(result.parameters)
    assert "residual: none left, as many poses as parameters" in "\n".join(result.lines())


def test_flat_is_one_pose_with_the_interval_of_its_block_means() -> None:
    blocks = 3.0 * np.tile([1.0, -1.0], 8)  # 16 means of +-3: their deviation is 3 sqrt(16/15)
    log = np.tile([0.0, 0.0, ONE_G], (160, 1)) + BIAS + np.repeat(blocks, 10)[:, None]
    result = flat(log, ONE_G, "z")
    exact(result)
    half = 2.131 * 3.0 * np.sqrt(16.0 / 15.0) / 4.0
    for axis, true in zip("xyz", BIAS, strict=True):
        e = result.parameters[f"bias_{axis}"]
        assert (e.low, e.value, e.high) == pytest.approx((true - half, true, true + half))
    assert (result.poses, result.readings, result.samples) == (1, 3, 160)
    assert result.noise == pytest.approx(3.0)
    assert result.condition == pytest.approx(1.0)
    assert result.missing == FIVE
    assert "286 in x and y" in result.limits[0]  # sin(1 degree) of 16384
    assert "164 in z" in result.limits[1]


def test_readings_that_all_say_one_count_are_known_to_half_a_count_only() -> None:
    log = np.tile([0.0, 0.0, ONE_G], (64, 1)) + BIAS
    with pytest.raises(InputError, match="do not change at all"):
        flat(log, ONE_G, "z")
    log[::2, 2] += 1.0
    e = flat(log, ONE_G, "z").parameters["bias_x"]
    assert e.high - e.value == pytest.approx(0.475)


def test_fall_says_that_it_shows_no_scale_and_what_came_before_it() -> None:
    rng = np.random.default_rng(0)
    rest = np.tile([0.0, 0.0, ONE_G], (50, 1))
    log = np.vstack([rest, np.zeros((100, 3)), rest]) + BIAS + 5.0 * rng.standard_normal((200, 3))
    result = free_fall(log, 200.0, ONE_G)
    exact(result)
    assert (result.poses, result.samples) == (1, 80)
    assert result.condition == pytest.approx(1.0)
    assert result.missing == ("x up or down", "y up or down", "z up or down")
    assert "the rest before the fall" in free_fall(log[50:], 200.0, ONE_G).missing


def test_turn_has_six_readings_for_six_numbers_and_checks_the_rest() -> None:
    result = turn(turned(2000))
    exact(result)
    assert (result.poses, result.readings) == (6, 6)
    assert result.condition == pytest.approx(1.0)
    assert result.missing == ()
    assert result.check is not None
    assert result.check.mean_g == pytest.approx(1.0, abs=2e-4)
    assert result.check.rms_error_g < 2e-4
    for i, axis in enumerate("xyz"):
        # the highest 20 of 2000 to a turn are within 10 steps: 1 - cos is at most 5e-4
        assert result.parameters[f"scale_{axis}"].value == pytest.approx(SCALE[i], rel=5e-4)
        assert result.parameters[f"bias_{axis}"].value == pytest.approx(BIAS[i], abs=1e-3 * ONE_G)
    assert any("too narrow" in text for text in turn(turned(300)).limits)


def test_intervals_of_a_turn_hold_the_truth_under_noise() -> None:
    inside = total = 0
    for seed in range(12):
        result = turn(turned(1500, 80.0, seed))
        for i, axis in enumerate("xyz"):
            for name, true in ((f"bias_{axis}", BIAS[i]), (f"scale_{axis}", SCALE[i])):
                e = result.parameters[name]
                inside += e.low <= true <= e.high
                total += 1
                assert e.high - e.low < 800.0  # four to five times the noise on both sides
    assert inside >= 0.95 * total


def test_noise_does_not_choose_the_extremes_of_a_turn() -> None:
    """By their own value the highest 0.5 % of a noise of 5 mg would be about 1.5 deviations too high."""
    off = [turn(turned(1500, 80.0, seed)).parameters["scale_y"].value - SCALE[1] for seed in range(12)]
    assert abs(float(np.mean(off))) < 40.0


def test_a_spike_is_no_extreme() -> None:
    log = turned(2000)
    log[700] = 40000.0
    assert turn(log).parameters["scale_x"].value == pytest.approx(SCALE[0], rel=5e-4)


def test_the_pose_that_a_turn_left_out_is_named_and_nothing_said_of_its_axis() -> None:
    t = np.linspace(0.0, 2.0 * np.pi, 2000)
    flat_turn = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    s = np.linspace(0.0, np.pi, 1000)
    over = np.stack([np.cos(s), 0 * s, np.sin(s)], axis=1)  # x up, z up, x down
    rng = np.random.default_rng(1)
    log = np.vstack([flat_turn, over]) * SCALE + BIAS + 2.0 * rng.standard_normal((3000, 3))
    result = turn(log)
    exact(result)
    assert result.missing == ("z down",)
    assert set(result.parameters) == {"bias_x", "scale_x", "bias_y", "scale_y"}
    assert result.check is None
    assert turn(log[:2000]).missing == ("z up", "z down")


@pytest.mark.parametrize("seed", range(4))
def test_half_a_turn_is_refused_with_the_poses_it_lacks(seed: int) -> None:
    with pytest.raises(InputError, match="missing: x up, x down, y down: turn slowly"):
        turn(turned(3000, 40.0, seed)[:1500])


def test_an_even_slow_turn_is_no_warm_up() -> None:
    log = turned(3000, 40.0)[:3000]
    assert remove_drift(log, 100.0, allowed=False)[1].steady


def test_two_axes_that_go_up_together_are_no_turn() -> None:
    wave = np.sin(np.linspace(0.0, 2.0 * np.pi, 1000))
    log = np.stack([wave, wave, np.zeros(1000)], axis=1) * SCALE + BIAS
    log[:, 2] += np.random.default_rng(0).standard_normal(1000)
    with pytest.raises(InputError, match="no slow turn"):
        turn(log)


def test_what_drift_is_allowed_lying_flat_is_measured_by_one_g_and_not_by_the_noise() -> None:
    rng = np.random.default_rng(0)
    log = np.tile([0.0, 0.0, ONE_G], (6000, 1)) + BIAS + 4.0 * rng.standard_normal((6000, 3))
    ramp = np.linspace(0.0, 1.0, 6000)[:, None]
    _, warm = remove_drift(log + 5.0 * ramp, 100.0, allowed=False, reach=ONE_G)
    assert warm.tolerance == pytest.approx(2e-3 * ONE_G)
    with pytest.raises(InputError, match="warming up"):
        remove_drift(log + 80.0 * ramp, 100.0, allowed=False, reach=ONE_G)


def test_terminal_and_json_say_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    log = np.tile([0.0, 0.0, ONE_G], (400, 1)) + BIAS + 5.0 * rng.standard_normal((400, 3))
    np.savez(tmp_path / "flat.npz", x=log[:, 0], y=log[:, 1], z=log[:, 2])
    command = ["calibrate", "accelerometer", str(tmp_path / "flat.npz"), "--method", "flat", "--columns", "x,y,z"]
    command += ["--rate-hz", "100", "--json", str(tmp_path / "r.json")]
    done = micron(*command)
    assert done.exit_code == 0
    assert "residual: none left" in done.stdout
    assert "condition 1.0" in done.stdout
    told = json.loads((tmp_path / "r.json").read_text())
    assert told["residual"] is None
    assert (told["poses"], told["readings"], told["freedom"]) == (1, 3, 0)
    assert told["condition"] == pytest.approx(1.0)
    assert told["missing"] == list(FIVE)
    assert told["noise"] == pytest.approx(5.0, rel=0.2)
    assert json.loads(micron(*command[:-1], "-").stdout) == told
