"""The actuation stage: sign, ramp, gate, limits; against the mechanism's constraints and the forward hysteresis."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.actuation import stage
from firmware_py.actuation.config import ActuationConfig, StackConfig
from firmware_py.actuation.hysteresis import plays_at, stack_stroke
from firmware_py.actuation.stage import Actuation
from firmware_py.frame import (
    CLIP,
    CLIP_SINGULAR,
    CLIP_SLEW,
    CLIP_VOLTAGE,
    CLIP_WORKSPACE,
    COMMAND,
    CONFIDENCE,
    DESIRED_TIP,
    LAYOUT,
    SETTLING,
    STATUS,
    TREMOR_AHEAD,
)
from firmware_py.records import attributes
from hal.errors import BenchError
from tests.unit.actuation.truth import tip_from_strokes
from tests.unit.pure_python import assert_kernel_is_python


def trembling(n: int, size: float = 25e-6) -> np.ndarray:
    t = np.arange(n) / 1000.0
    frames = np.zeros((n, LAYOUT.size))
    frames[:, CONFIDENCE : CONFIDENCE + 3] = 0.9
    frames[:, LAYOUT["tremor_ahead"]] = size * np.sin(2 * np.pi * np.array([9.0, 10.0, 11.0]) * t[:, None])
    frames[:, LAYOUT["tremor_core"]] = frames[:, LAYOUT["tremor_ahead"]]
    return frames


def run(config: ActuationConfig, frames: np.ndarray) -> Actuation:
    actuation = Actuation(config)
    for frame in frames:
        actuation.step(frame)
    return actuation


def tip_of(actuation: Actuation, frames: np.ndarray) -> np.ndarray:
    """Where stacks that are exactly the model and the real mechanism put the tip, manipulator frame."""
    config, param = actuation.config, attributes(actuation.params)[0]
    plays = [plays_at(param.stacks[i], config.neutral_V, config.high_V) for i in range(3)]
    slopes = [param.stacks[i].slope for i in range(3)]
    tips = []
    for k, frame in enumerate(frames):
        z = np.array(
            [
                stack_stroke(frame[COMMAND + i], slopes[i], plays[i], np.zeros(4), actuation.params[0]["stacks"][i])
                - param.neutral_stroke[i]
                for i in range(3)
            ]
        )
        if k % 25 == 0:
            tips.append(tip_from_strokes(z, config))
    return np.array(tips)


def test_the_tip_goes_where_minus_the_tremor_says() -> None:
    frames = trembling(1500)
    actuation = run(ActuationConfig(), frames)
    assert np.all(frames[:, CLIP] == 0.0)
    wanted = frames[::25, LAYOUT["desired_tip"]]
    np.testing.assert_allclose(wanted[-20:], -frames[::25, LAYOUT["tremor_ahead"]][-20:], atol=1e-20)
    np.testing.assert_allclose(tip_of(actuation, frames), wanted, atol=1e-10)


def test_mounting_turns_the_wish_into_the_manipulators_frame() -> None:
    frames = trembling(800)
    quarter = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    run(ActuationConfig(mounting=quarter), frames)
    tremor, wish = frames[-1, TREMOR_AHEAD : TREMOR_AHEAD + 3], frames[-1, DESIRED_TIP : DESIRED_TIP + 3]
    np.testing.assert_allclose(wish, -np.array(quarter) @ tremor, atol=1e-20)


def test_compensation_fades_in_and_out_with_trust() -> None:
    frames = trembling(2500)
    frames[:, LAYOUT["tremor_ahead"]] = frames[:, LAYOUT["tremor_core"]] = 10e-6
    frames[:100, STATUS] = SETTLING
    frames[1500:, CONFIDENCE + 1] = 0.05
    run(ActuationConfig(ramp_s=0.5), frames)
    wish = -frames[:, LAYOUT["desired_tip"]] / 10e-6
    assert np.all(wish[:100] == 0.0)
    np.testing.assert_allclose(wish[100:700, 0], np.minimum(1.0, np.arange(1, 601) / 500), atol=1e-9)
    assert np.all(np.abs(np.diff(wish, axis=0)) < 0.0021)
    assert wish[-1, 1] == 0.0
    assert wish[-1, 0] == 1.0


def test_centred_strokes_reach_as_far_up_as_down() -> None:
    """A swing along the shaft that the shorter side cannot hold fits about the middle; the tip is off by a constant."""
    centred, plain = ActuationConfig(centring=1.0), ActuationConfig()
    param = attributes(Actuation(centred).params)[0]
    half = float(np.min(param.swing_high))
    np.testing.assert_allclose(-param.swing_low, param.swing_high, rtol=1e-12)
    assert half > 1.05 * min(float(param.stroke_high[0]), -float(param.stroke_low[0]))
    size = 0.97 * half * centred.lever_gain[2]
    frames, others = trembling(3000, size), trembling(3000, size)
    for each in (frames, others):
        each[:, LAYOUT["tremor_ahead"]][:, :2] = each[:, LAYOUT["tremor_core"]][:, :2] = 0.0
    actuation = run(centred, frames)
    run(plain, others)
    assert not np.any(frames[:, CLIP].astype(int) & CLIP_WORKSPACE)
    assert np.any(others[:, CLIP].astype(int) & CLIP_WORKSPACE)
    asked = -frames[1000:, LAYOUT["tremor_ahead"]]
    offset = [0.0, 0.0, float(param.centre) * centred.lever_gain[2]]
    np.testing.assert_allclose(frames[1000:, LAYOUT["desired_tip"]] - asked, [offset] * 2000, atol=1e-9)
    wanted = frames[::25, LAYOUT["desired_tip"]]
    np.testing.assert_allclose(tip_of(actuation, frames), wanted, atol=1e-9)


def test_out_of_reach_is_the_nearest_point_flagged_and_without_a_jump() -> None:
    frames = trembling(1500, size=400e-6)
    actuation = run(ActuationConfig(overdrive=0.0), frames)
    clipped = frames[600:, CLIP].astype(int) & CLIP_WORKSPACE != 0
    assert 0.2 < np.mean(clipped) < 1.0
    wish, tremor = frames[600:, LAYOUT["desired_tip"]], frames[600:, LAYOUT["tremor_ahead"]]
    assert np.all(np.any(wish != -tremor, axis=1) == clipped)
    # the nearest point of a convex set moves no more than what it is nearest to
    moved, wanted = (np.linalg.norm(np.diff(v, axis=0), axis=1) for v in (wish, tremor))
    assert np.all(moved <= 1.02 * wanted)
    command = frames[:, LAYOUT["command"]]
    assert np.all((command >= 0.0) & (command <= 100.0))
    # where the amplifier could follow
    followed = frames[::25, CLIP].astype(int) & CLIP_SLEW == 0
    assert np.mean(followed) > 0.8
    at = frames[::25, LAYOUT["desired_tip"]]
    np.testing.assert_allclose(tip_of(actuation, frames)[followed], at[followed], atol=1e-9)


def test_too_fast_for_the_model_is_limited_and_flagged() -> None:
    """Ang 2004, 7.5: above 36 Hz (1414 um/s) a slope turns negative and the inverse would run backwards."""
    falling = tuple(-w / 1414.0 for w in np.cumsum(StackConfig().play_weights_um_per_V)[:2])
    law = (*falling, *[0.0] * 8)
    stack = StackConfig(slope_per_rate_s_per_V=law, least_slope_um_per_V=0.005)
    config = ActuationConfig(stacks=(stack,) * 3)
    t = np.arange(1200) / 1000.0
    for frequency_hz, beyond in ((20.0, False), (35.0, False), (45.0, True)):
        frames = trembling(1200)
        # all three stacks: 12.5 um p-p of stroke along the shaft
        frames[:, TREMOR_AHEAD : TREMOR_AHEAD + 2] = 0.0
        frames[:, TREMOR_AHEAD + 2] = 8.0 * 5.5e-6 * np.sin(2 * np.pi * frequency_hz * t)
        frames[:, LAYOUT["tremor_core"]] = frames[:, LAYOUT["tremor_ahead"]]
        run(config, frames)
        # peak rate of this sine: 2 pi f 5.5 um/s, so 36 Hz for 12.5 um p-p is 40.9 Hz here
        assert np.any(frames[:, CLIP].astype(int) & CLIP_SINGULAR) == beyond
        command = frames[700:, COMMAND]
        assert np.all((command >= 0.0) & (command <= 100.0))
        # monotonic: where the wish rises for good, so does the drive
        rising = np.diff(frames[700:, LAYOUT["stroke"]][:, 0]) > 0.3e-6
        assert np.all(np.diff(command)[rising] > 0.0)


def test_feedforward_taps_act_on_the_strokes() -> None:
    frames, plain = trembling(900), trembling(900)
    run(ActuationConfig(feedforward=(0.0, 1.0)), frames)
    run(ActuationConfig(), plain)
    np.testing.assert_allclose(frames[1:, LAYOUT["command"]], plain[:-1, LAYOUT["command"]], atol=1e-9)


def test_creep_is_taken_back() -> None:
    """A constant wish: the drive falls as the stack creeps, by the share of what was asked."""
    stack = StackConfig(creep_times_s=(0.1,), creep_shares=(0.05,))
    actuation = Actuation(ActuationConfig(stacks=(stack,) * 3, ramp_s=0.001))
    frames = trembling(1500, size=0.0)
    frames[:, TREMOR_AHEAD + 2] = -24e-6  # 3 um of stroke
    for frame in frames:
        actuation.step(frame)
    param = attributes(actuation.params)[0]
    np.testing.assert_allclose(attributes(actuation.state)[0].creep[:, 0], 3e-6 * 0.05 / 1.05, rtol=1e-4)
    assert np.all(np.diff(frames[10:, COMMAND]) <= 1e-12)
    z = (
        stack_stroke(
            frames[-1, COMMAND],
            param.stacks[0].slope,
            plays_at(param.stacks[0], 50.0, 100.0),
            np.zeros(4),
            actuation.params[0]["stacks"][0],
        )
        - param.neutral_stroke[0]
    )
    assert z < 3e-6


def test_slew_and_voltage_limits_hold_and_are_flagged() -> None:
    frames = trembling(1500, size=60e-6)
    run(ActuationConfig(slew_V_per_s=500.0), frames)
    command = frames[:, LAYOUT["command"]]
    assert np.max(np.abs(np.diff(command, axis=0))) <= 0.5 + 1e-12
    assert np.any(frames[:, CLIP].astype(int) & CLIP_SLEW)
    frames = trembling(1500, size=60e-6)
    run(ActuationConfig(low_V=45.0, high_V=55.0), frames)
    assert np.any(frames[:, CLIP].astype(int) & (CLIP_VOLTAGE | CLIP_WORKSPACE))
    command = frames[:, LAYOUT["command"]]
    assert command.min() >= 45.0
    assert command.max() <= 55.0


def test_nan_is_no_command() -> None:
    frames = trembling(1000)
    frames[900:, TREMOR_AHEAD : TREMOR_AHEAD + 3] = np.nan
    run(ActuationConfig(), frames)
    assert np.all(np.isfinite(frames[:, COMMAND : COMMAND + 3]))
    # there and back through the kinematics, because its swing ended in a jump
    np.testing.assert_allclose(frames[900:, DESIRED_TIP : DESIRED_TIP + 3], 0.0, atol=1e-18)


def test_at_rest_the_amplifier_stays_at_neutral() -> None:
    frames = trembling(10, size=0.0)
    run(ActuationConfig(neutral_V=47.0), frames)
    np.testing.assert_allclose(frames[:, COMMAND : COMMAND + 3], 47.0, atol=1e-9)


def test_stacks_of_different_size_share_one_kernel() -> None:
    linear = {"play_thresholds_V": [0.0], "play_weights_um_per_V": [0.15]}
    config = ActuationConfig.from_dict({"stacks": [linear, {}, linear]})
    frames = trembling(600)
    actuation = run(config, frames)
    np.testing.assert_allclose(tip_of(actuation, frames), frames[::25, LAYOUT["desired_tip"]], atol=1e-10)


def test_kernel_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = trembling(60, size=100e-6)
    twins = frames.copy()
    config = ActuationConfig(ramp_s=0.01, slew_V_per_s=3000.0)
    run(config, frames)
    assert_kernel_is_python(monkeypatch, stage, "actuate_kernel", Actuation(config), twins, frames, atol=1e-18)


def test_reset_is_a_new_start() -> None:
    frames, again = trembling(700), trembling(700)
    actuation = run(ActuationConfig(), frames)
    actuation.reset()
    for frame in again:
        actuation.step(frame)
    assert np.array_equal(frames, again)


def test_a_wrong_key_is_named() -> None:
    with pytest.raises(BenchError, match="neutral_V"):
        ActuationConfig.from_dict({"neutral_V": 120.0})
    with pytest.raises(BenchError, match="rotation"):
        ActuationConfig.from_dict({"mounting": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]})
