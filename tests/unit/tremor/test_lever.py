"""What the instrument knows of its own turning: where it comes from, and what it is worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from firmware_py.control.plan import load_plan
from firmware_py.frame import ANGULAR_ACCELERATION, LAYOUT, TICK, TIP_ACCELERATION, TREMOR_AHEAD
from firmware_py.sensing.attitude_params import tip_lever
from firmware_py.sensing.config import SensingConfig
from firmware_py.tremor.adaptive_design import design_adaptive, lever_signals, noise_in_channels
from firmware_py.tremor.config import LeverConfig, TremorConfig
from firmware_py.tremor.estimator import Estimator
from firmware_py.tremor.stage import Tremor
from hal.bench import load_bench
from tests.conftest import DEFAULT_BENCH
from tests.unit.tremor.estimator_state import peek
from tests.unit.tremor.synthetic import RATE_HZ, rc_filter
from tools.research.tremor.bound import bank_features

ARM_M = 0.1
POINT, TURN = 0.8e-3, 2.8e-3  # m/s^2/sqrt(Hz), about those of the default bench
ABOUT = 8.0  # noise of the turn about the arm over that of a turn across it
COMMON = 0.9  # what the two have in common
WITHOUT_GRAVITY = 1e-9


def lever(common: float = COMMON) -> LeverConfig:
    """The lever of ``frames`` with the same ``common``."""
    point, across, about = POINT**2 * np.eye(3), (TURN / ARM_M) ** 2 * np.eye(3), ABOUT * TURN / ARM_M
    across[2, 2] = about**2
    across[1, 2] = across[2, 1] = common * about * TURN / ARM_M
    turns = np.cross(np.eye(3), (0.0, 0.0, ARM_M)).T  # from alpha to alpha x arm
    carry = np.vstack([turns, np.eye(3)])
    noise = carry @ across @ carry.T
    noise[:3, :3] += point
    return LeverConfig.model_validate(
        {"arm_m": (0.0, 0.0, ARM_M), "noise": noise.tolist(), "gravity_m_s2": WITHOUT_GRAVITY}
    )


LEVER = lever()


def frames(share: float, n: int, seed: int, common: float = COMMON) -> tuple[np.ndarray, np.ndarray]:
    """(n, Layout.size) of a hand with ``share`` of its tremor along x a turn about y; its tremor (n,) m.

    ``common``: correlation of the noise of that turn with that of the turn about the arm.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    size = 20e-6 * (1.0 + 0.3 * np.sin(2 * np.pi * 0.7 * t))
    own = [size * np.sin(2 * np.pi * hz * t + p) for hz, p in ((9.1, 0.0), (9.8, 1.0))]
    still, turning = (1.0 - share) ** 0.5 * own[0], share**0.5 * own[1]
    white = rng.standard_normal((3, n)) * np.sqrt(RATE_HZ / 2)

    def seen(motion_m: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return rc_filter(np.gradient(np.gradient(motion_m, t), t) + noise)

    turned = seen(turning, TURN * white[1])
    rows = np.zeros((n, LAYOUT.size))
    rows[:, TICK] = np.arange(n)
    rows[:, TIP_ACCELERATION] = seen(still, POINT * white[0]) + turned
    rows[:, ANGULAR_ACCELERATION + 1] = turned / ARM_M
    about = common * white[1] + (1.0 - common**2) ** 0.5 * white[2]
    rows[:, ANGULAR_ACCELERATION + 2] = seen(0.0 * t, ABOUT * TURN / ARM_M * about)
    return rows, still + turning


def residual(config: TremorConfig, rows: np.ndarray, tremor: np.ndarray) -> tuple[float, float]:
    """(error against the tremor, motion above 25 Hz) of the prediction, um rms."""
    stage = Tremor(config)
    ahead = np.empty(len(rows))
    for k, frame in enumerate(rows.copy()):
        stage.step(frame)
        ahead[k] = frame[TREMOR_AHEAD]
    keep = slice(-5000, None)
    delay = round(config.loop_delay_s * RATE_HZ)
    error = (np.roll(ahead, delay) - tremor)[keep]
    spectrum = np.fft.rfft(ahead[keep] * np.hanning(5000)) / 5000
    hz = np.fft.rfftfreq(5000, 1 / RATE_HZ)
    above = np.sqrt(2 * np.sum(np.abs(spectrum[hz > 25.0]) ** 2) / 0.375)
    return 1e6 * float(np.sqrt(np.mean(error**2))), 1e6 * float(above)


def test_a_hand_that_hardly_turns_is_known_better_and_shakes_the_tip_less() -> None:
    rows, tremor = frames(0.05, 20_000, 1)
    alone, above = residual(TremorConfig(), rows, tremor)
    told, above_told = residual(TremorConfig(lever=LEVER), rows, tremor)
    assert told < 0.75 * alone
    assert above_told < 0.6 * above


def test_a_hand_that_only_turns_is_not_known_worse() -> None:
    rows, tremor = frames(1.0, 20_000, 2)
    alone, _ = residual(TremorConfig(), rows, tremor)
    told, _ = residual(TremorConfig(lever=LEVER), rows, tremor)
    assert told < 1.1 * alone


def test_noise_that_the_turn_about_the_arm_shows_is_taken_out_of_the_tip() -> None:
    """The turn about the arm moves nothing at the tip: what it has in common with the tip's signal is noise."""
    left: list[float] = []
    for common in (0.0, 0.95):
        rows, tremor = frames(0.5, 20_000, 4, common)
        left.append(residual(TremorConfig(lever=lever(common)), rows, tremor)[0])
    assert left[1] < 0.8 * left[0]


def test_gravity_carries_the_noise_of_a_turn_into_what_is_learned() -> None:
    """What the design takes out of the regression is what noise alone puts in, whichever way is up."""
    tremor = load_plan(load_bench(DEFAULT_BENCH)).stages.tremor
    assert tremor.lever is not None
    design, own = design_adaptive(tremor), tremor.lever
    n, rng = 300_000, np.random.default_rng(7)
    white = rng.standard_normal((n, 6)) @ np.linalg.cholesky(0.5 * RATE_HZ * np.array(own.noise)).T
    corner = 2.0 * np.pi * own.lean_from_hz
    # the double integral above the corner, as the sensing stage has it
    lean = signal.bilinear(
        [1.0, 0.0, 0.0], np.polymul([1.0, 2**0.5 * corner, corner**2], [1.0, 2**0.5 * corner, corner**2]), RATE_HZ
    )
    turn = signal.lfilter(*lean, white[:, 3:], axis=0)
    for up in ((-0.64, 0.15, -0.75), (0.3, 0.6, 0.74)):
        force = rc_filter(white[:, 0] - own.gravity_m_s2 * np.cross(up, turn)[:, 0])
        signals = [force, *(rc_filter(x) for x in lever_signals(own)[0, 1:, 3:] @ white[:, 3:].T)]
        weight = design.weight[:3], [1.0, *design.weight[3:]]
        weighted = [np.asarray(signal.lfilter(*weight, x)) for x in signals]
        features = np.concatenate([bank_features(x, design) for x in weighted], axis=1)
        length = design.block_ticks * (n // design.block_ticks)
        blocks = weighted[0][:length].reshape(-1, design.block_ticks).mean(axis=1)
        lag = design.taps.shape[1] // 2
        target = np.convolve(blocks, design.taps[1])[2 * lag : -2 * lag or None]
        at = (np.arange(lag, len(blocks) - lag) + 1) * design.block_ticks - 1
        seen = features[at].T @ target / len(at)
        one = design.bank.one
        known = design.noise_cross[0, 1].copy()
        for c in range(design.bank.channels):
            known[c * one : (c + 1) * one] += design.lean.by_up[0, c] @ up * design.lean_cross[0, 1]
        known[:one] += up @ design.lean.by_square[0] @ up * design.lean_cross[1, 1]
        error = np.linalg.norm((seen - known)[:one]) / np.linalg.norm(known[:one])
        assert error < 0.15
        assert np.linalg.norm((seen - design.noise_cross[0, 1])[:one]) > 2.0 * np.linalg.norm((seen - known)[:one])


def test_without_an_arm_it_is_the_estimator_alone() -> None:
    rows, _ = frames(0.5, 3000, 3)
    stage = Tremor(TremorConfig())
    samples = rows[:, TIP_ACCELERATION : TIP_ACCELERATION + 3].copy()
    for frame in rows:
        stage.step(frame)
    found = Estimator(TremorConfig()).run(samples).ahead_m
    np.testing.assert_array_equal(rows[:, TREMOR_AHEAD : TREMOR_AHEAD + 3], found)


def test_noise_of_the_tip_is_that_of_the_point_and_of_the_turn() -> None:
    """At the quiet point the two are independent, along the axes that a turn moves: variances add."""
    config = SensingConfig()
    arm, densities = tip_lever(config)
    turns = lever_signals(LeverConfig.model_validate({"arm_m": arm.tolist(), "noise": densities.tolist()}))[:, 1]
    tip, turn = np.sqrt(np.diag(densities)[:3]), np.sqrt(np.diag(turns @ densities @ turns.T))
    observe = config.observation() / (np.array(config.noise_ug_per_rtHz)[:, None] * 9.80665e-6)
    covariance = np.linalg.inv(observe.T @ observe)
    force_alpha = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, 400_000)
    force, alpha = force_alpha[:, :3], force_alpha[:, 3:]
    at_tip = force + np.cross(alpha, np.asarray(config.tip_m))
    np.testing.assert_allclose(np.std(at_tip, axis=0), tip, rtol=0.01)
    np.testing.assert_allclose(np.std(np.cross(alpha, arm), axis=0), turn, rtol=0.01)
    point = at_tip - np.cross(alpha, arm)
    for axis in range(2):
        assert abs(np.corrcoef(point[:, axis], np.cross(alpha, arm)[:, axis])[0, 1]) < 0.1


def test_a_bench_gives_the_lever_unless_the_hand_shall_not_be_split(tmp_path: Path) -> None:
    configs = load_plan(load_bench(DEFAULT_BENCH)).stages
    assert configs.tremor.lever is not None
    assert configs.tremor.lever.arm_m[2] == pytest.approx(0.097, abs=0.02)
    design = design_adaptive(configs.tremor)
    assert design.bank.channels == 3
    # a run asks twice; what it is given may not be changed, and another delay is another design
    assert design_adaptive(configs.tremor.model_copy(deep=True)) is design
    assert not any(array.flags.writeable for array in (design.taps, design.start, design.onward, design.quiet))
    assert design_adaptive(configs.tremor.model_copy(update={"loop_delay_s": 0.002})) is not design
    table = "[firmware.tremor.adaptive]"
    text = DEFAULT_BENCH.read_text().replace(table, f"{table}\nlever_share = 0.0")
    other = tmp_path / "bench.toml"
    other.write_text(text.replace('"calibration/', f'"{DEFAULT_BENCH.parent}/calibration/'))
    assert load_plan(load_bench(other)).stages.tremor.lever is None


def test_a_solved_filter_is_eased_in() -> None:
    """No tick moves the filter in use by more than its share of the way to the solved one."""
    estimator = Estimator(TremorConfig(), axes=1)
    rng = np.random.default_rng(5)
    t = np.arange(6000) / RATE_HZ
    samples = rc_filter(-((2 * np.pi * 9.0) ** 2) * 20e-6 * np.sin(2 * np.pi * 9.0 * t)) + 0.05 * rng.standard_normal(
        6000
    )
    estimator.run(samples[:, None])
    share = float(peek(estimator.params).adaptive.ease)
    assert share == pytest.approx(1.0 - np.exp(-1.0 / 100.0))
    for _ in range(20):
        state = peek(estimator.state).adaptive
        used = np.array(state.filter[0])
        estimator.run(samples[:1, None])
        state = peek(estimator.state).adaptive
        np.testing.assert_allclose(
            np.array(state.filter[0]), used + share * (np.array(state.solved[0]) - used), rtol=1e-9
        )


def test_a_recording_of_a_version_without_the_turn_about_the_arm_has_the_two_channels_of_then() -> None:
    old = {
        "arm_m": (0.0, 0.0, ARM_M),
        "noise_m_s2_rtHz": (TURN, TURN, 0.0),
        "tip_noise_m_s2_rtHz": (2 * TURN, 1.0, 1.0),
    }
    design = design_adaptive(TremorConfig(lever=LeverConfig.model_validate(old)))
    assert design.bank.channels == 2
    assert not design.lean.by_up.any()
    assert not design.lean.by_square.any()
    np.testing.assert_allclose(
        noise_in_channels(TremorConfig(lever=LeverConfig.model_validate(old))), [[1.0, 0.25], [0.25, 0.25]]
    )
