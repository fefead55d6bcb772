"""The adaptive filter: its design against direct integrals, its learning against batch least squares, its manners."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.signal import cont2discrete, lfilter

from firmware_py.frame import INVALID, LAYOUT, QUATERNION, RESTARTED, STATUS, TICK, TIP_ACCELERATION
from firmware_py.tremor.adaptive import LEARNED, factorize
from firmware_py.tremor.adaptive_design import (
    GRID_STEP_HZ,
    band,
    bank_of,
    block_response,
    design_adaptive,
    sensor_noise,
    sensor_response,
    shaking_power,
    solve_scaled,
    spectra,
    target_taps,
)
from firmware_py.tremor.config import PRESETS, AdaptiveConfig, TremorConfig
from firmware_py.tremor.estimator import Estimator
from firmware_py.tremor.family import AXES
from firmware_py.tremor.stage import Tremor, learn_kernel
from hal.errors import BenchError
from tests.unit.tremor.compare import HELD_OUT, residuals
from tests.unit.tremor.estimator_state import peek
from tests.unit.tremor.synthetic import CUTOFF_RAD_S, RATE_HZ, make_record, rc_filter, residual_percent


def tone_acceleration(hz: float, size: float, n: int, bias: float = 0.0) -> np.ndarray:
    w, t = 2 * np.pi * hz, np.arange(n) / RATE_HZ
    rc = CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
    return np.real(-(w**2) * size * rc * np.exp(1j * w * t)) + bias


def test_bank_response_is_what_the_recursion_does() -> None:
    bank = bank_of(AdaptiveConfig(), RATE_HZ)
    impulse = np.zeros(4000)
    impulse[0] = 1.0
    hz = np.array([3.0, 10.0])
    response = bank.response(np.exp(2j * np.pi * hz / RATE_HZ))
    pole = bank.pole[4]
    state = lfilter([1.0 - abs(pole)], [1.0, -pole], impulse.astype(complex))
    turning = np.exp(-2j * np.pi * hz[:, None] * np.arange(4000) / RATE_HZ)
    np.testing.assert_allclose(turning @ state.real, response[8], atol=1e-6)
    np.testing.assert_allclose(turning @ state.imag, response[9], atol=1e-6)


CONFIG = TremorConfig()
WHOLE = (*CONFIG.adaptive.cancel_from_hz, *CONFIG.adaptive.cancel_to_hz)


def through_target(hz: float, advance_s: float, edges_hz: tuple[float, float, float, float]) -> complex:
    """What the target makes of a tone of displacement, as seen by the sensor, against the tone itself."""
    taps = target_taps(CONFIG, 10, advance_s, edges_hz)
    f = np.array([hz])
    delays = np.exp(-2j * np.pi * hz * 0.01 * (np.arange(len(taps)) - len(taps) // 2))
    seen = block_response(f, 10, RATE_HZ)[0] * sensor_response(CONFIG, f)[0]
    return complex(taps @ delays * seen * np.exp(-2j * np.pi * hz * advance_s))


@pytest.mark.parametrize("hz", [4.9, 6.0, 7.0, 8.0, 9.3, 10.7, 12.0, 14.0, 15.9])
def test_the_target_is_the_displacement_some_blocks_ago(hz: float) -> None:
    """Gain 1 and no phase at the centre tap, for a tone in the band, sensor and double integration undone."""
    for advance_s in (0.0, 0.002):
        assert abs(through_target(hz, advance_s, WHOLE) - 1.0) < 0.02


@pytest.mark.parametrize("hz", [8.0, 9.3, 10.7, 12.0])
def test_the_core_is_eight_to_twelve_hertz(hz: float) -> None:
    core = CONFIG.adaptive.core_hz
    assert abs(through_target(hz, 0.002, core) - 1.0) < 0.02
    for outside in (3.0, 4.5, 18.0):
        assert abs(through_target(outside, 0.002, core)) < 0.02


def test_voluntary_motion_and_bias_are_outside_the_target() -> None:
    for hz in (0.01, 0.3, 1.0):
        assert abs(through_target(hz, 0.0, WHOLE)) < 0.003
    # a bias of 0.2 m/s^2 for the length of the target
    assert abs(np.sum(target_taps(CONFIG, 10, 0.0, WHOLE))) * 0.2 < 1e-6


def test_the_prior_filter_is_the_wiener_filter_of_its_hand() -> None:
    """No other filter over the same bank has a smaller error: the gradient of the error vanishes."""
    d = design_adaptive(TremorConfig())
    rng = np.random.default_rng(0)
    gram = rng.standard_normal((6, 6))
    spd = gram @ gram.T + np.diag(10.0 ** np.arange(-6, 6, 2))
    right = rng.standard_normal((2, 6))
    np.testing.assert_allclose(solve_scaled(spd, right) @ spd, right, rtol=1e-4, atol=1e-6)
    assert np.all(np.linalg.eigvalsh(d.rest[0]) > -1e-12 * np.linalg.norm(d.rest[0]))
    # the mean square error written out as an integral over frequency: every step away from the filter makes it larger
    config = TremorConfig()
    hand = spectra(config)
    phi = d.bank.response(np.exp(2j * np.pi * hand.hz / RATE_HZ).astype(np.complex128))
    wanted = band(hand.hz, WHOLE)

    def error(row: np.ndarray, level: int, rms_m: float) -> float:
        through = row @ phi
        missed = np.abs(through * hand.seen - wanted) ** 2 * hand.tremor[level] * rms_m**2
        mean_square = float(np.sum(missed + np.abs(through) ** 2 * hand.rest)) * GRID_STEP_HZ
        return mean_square + float(row @ d.quiet[0] @ row)

    for level, rms_m in enumerate((config.adaptive.tremor_rms_m, config.adaptive.burst_rms_m)):
        row = d.start[0, level, 0]
        best = error(row, level, rms_m)
        assert best < 0.5 * error(0.0 * row, level, rms_m)
        for step in (1e-2, -1e-2):
            for j in range(len(row)):
                moved = row.copy()
                moved[j] *= 1.0 + step
                assert error(moved, level, rms_m) > best * (1.0 - 1e-6)
    # the calm hand's filter lets a steady tone in the middle of the band through nearly whole and in phase
    z = np.array([np.exp(2j * np.pi * 10.0 / RATE_HZ)])
    through = d.start[0, 0, 0] @ d.bank.response(z)[:, 0] * sensor_response(TremorConfig(), np.array([10.0]))[0]
    assert abs(through - 1.0) < 0.15


def test_the_gate_tells_a_burst_from_a_calm_hand_within_a_tenth_of_a_second() -> None:
    """A burst after nothing but sensor noise; the share stands for a power ratio of ``gate_ratio`` to one."""
    rng = np.random.default_rng(3)
    samples = 0.01 * rng.standard_normal(6000)
    samples[4000:] += tone_acceleration(8.0, 300e-6, 2000)
    estimator = Estimator(TremorConfig(), axes=1)
    estimator.run(samples[:4000, None])
    assert peek(estimator.state).adaptive.burst[0] < 0.1
    estimator.run(samples[4000:4100, None])
    assert peek(estimator.state).adaptive.burst[0] > 0.8
    assert peek(estimator.state).adaptive.burst[1] == 0.0  # each axis by itself


def test_a_first_burst_is_met_by_a_bold_filter() -> None:
    """After ten calm seconds, a swing of 300 um at 10 Hz: a fifth of its first half second is left at most.

    One filter, learned from the calm hand alone, is cautious and leaves more.
    """
    n, at = 10_500, 10_000
    t = np.arange(n) / RATE_HZ
    rise = np.clip((t - at / RATE_HZ) / 0.1, 0.0, 1.0)
    swing = 300e-6 * (rise**2 * (3.0 - 2.0 * rise)) * np.sin(2.0 * np.pi * 10.0 * (t - at / RATE_HZ))
    acceleration = np.zeros(n)
    acceleration[1:-1] = np.diff(swing, 2) * RATE_HZ**2
    seen = rc_filter(acceleration) + 0.01 * np.random.default_rng(4).standard_normal(n)
    left: list[float] = []
    for adaptive in (AdaptiveConfig(), AdaptiveConfig(gate_ratio=1e12)):
        config = TremorConfig(adaptive=adaptive, loop_delay_s=0.002)
        ahead = Estimator(config, axes=1).run(seen[:, None]).ahead_m[:, 0]
        left.append(float(np.std((swing[2:] - ahead[:-2])[at:]) / np.std(swing[at:])))
    assert left[0] < 0.2
    assert left[0] < 0.6 * left[1]


@pytest.mark.parametrize("kind", ["one tone", "two tones", "band noise"])
def test_it_beats_every_fixed_filter_on_held_out_hands(kind: str) -> None:
    seeds = list(HELD_OUT)[:3]
    assert np.mean(residuals("adaptive", 2, kind, seeds, 14.0)) < np.mean(residuals("kalman", 2, kind, seeds, 14.0))


def test_a_steady_tone_is_learned_as_well_as_its_target_says() -> None:
    n, size = 12_000, 20e-6
    acceleration = tone_acceleration(10.7, size, n, bias=0.02)
    ahead = Estimator(TremorConfig(loop_delay_s=0.004), axes=1).run(acceleration[:, None]).ahead_m[:, 0]
    true = size * np.cos(2 * np.pi * 10.7 * (np.arange(n) / RATE_HZ + 0.004))
    assert np.max(np.abs(ahead[-1000:] - true[-1000:])) < 0.025 * size


@pytest.mark.parametrize("rms_m", [5e-6, 500e-6])
def test_one_setting_serves_small_and_large_tremor(rms_m: float) -> None:
    record = make_record(104, "two tones", 12.0, rms_m=rms_m)
    ahead = Estimator(TremorConfig(), axes=1).run(record.acceleration[:, None]).ahead_m[:, 0]
    assert residual_percent(record.tremor, ahead, 2) < (30.0 if rms_m < 1e-5 else 8.0)


def test_a_bias_that_grows_does_not_capture_it() -> None:
    """Ang 2004, 5.2.2: 5 mg in 10 s, then a step of 20 mg, under 20 um of tremor."""
    n, size = 12_000, 20e-6
    t = np.arange(n) / RATE_HZ
    drift = rc_filter(np.minimum(0.005 * 9.81 * t, 0.05) + 0.2 * (t > 10.5))
    acceleration = tone_acceleration(9.4, size, n) + drift
    result = Estimator(TremorConfig(), axes=1).run(acceleration[:, None])
    true = size * np.cos(2 * np.pi * 9.4 * t)
    error = result.now_m[:, 0] - true
    assert np.std(error[8000:10_400]) < 0.03 * np.std(true)
    assert np.std(error[11_200:]) < 0.15 * np.std(true)
    assert result.frequency_hz[-1, 0] == pytest.approx(9.4, abs=0.1)


def test_voluntary_motion_below_one_hertz_is_kept() -> None:
    """A movement of 1 mm at 0.8 Hz beside the tremor: less than one percent of it is taken for tremor."""
    n = 14_000
    t = np.arange(n) / RATE_HZ
    w = 2 * np.pi * 0.8
    lag = CUTOFF_RAD_S / (1j * w + CUTOFF_RAD_S)
    slow = np.real(-(w**2) * 1e-3 * lag * np.exp(1j * w * t))
    ahead = Estimator(TremorConfig(), axes=1).run((tone_acceleration(10.0, 25e-6, n) + slow)[:, None]).ahead_m[:, 0]
    tail = slice(-5000, None)  # four whole periods
    taken = 2 * np.mean(ahead[tail] * np.exp(-1j * w * t[tail]))
    assert abs(taken) < 0.01 * 1e-3


def test_learning_is_least_squares_with_the_prior() -> None:
    """After a run the filter of an axis and level solves the normal equations that the state holds."""
    config = TremorConfig(adaptive=AdaptiveConfig(share=0.0))
    record = make_record(3, "one tone", 6.0)
    estimator = Estimator(config, axes=1)
    estimator.run(record.acceleration[:, None])
    state, param = peek(estimator.state).adaptive, peek(estimator.params).adaptive
    for level in range(2):
        count, n0 = state.count[0, level], param.prior_blocks[level]
        assert count > 10.0
        known = state.power[0, level] + n0 * param.weighted_power[level] - count * param.noise_power[0]
        power = known / (count + n0)
        normal = np.tril(state.normal[0, level]) + np.tril(state.normal[0, level], -1).T
        matrix = normal + n0 * (power * param.tremor[level] + param.rest[0]) + (n0 + count) * param.quiet[0]
        right = state.right[0, level] - count * param.noise_cross[0] + n0 * power * param.cross[level]
        direct = solve_scaled(matrix, np.asarray(right))
        found = np.array(state.solved[0, level])
        # the last solution is a few blocks old
        np.testing.assert_allclose(found @ matrix, direct @ matrix, rtol=0.05, atol=0.02 * np.abs(right).max())


def _system(state: Any, param: Any, level: int, part: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Matrix and right side of the first axis' regression with its prior, and the mean power of a row."""
    count, n0 = state.count[0, level], param.prior_blocks[level]
    known = getattr(state, f"{part}power")[0, level] - count * getattr(param, f"{part}noise_power")[0]
    power = (known + n0 * getattr(param, f"{part}weighted_power")[level]) / (count + n0)
    below = getattr(state, f"{part}normal")[0, level]
    prior = power * getattr(param, f"{part}tremor")[level] + getattr(param, f"{part}rest")[0]
    right = getattr(state, f"{part}right")[0, level] - count * getattr(param, f"{part}noise_cross")[0]
    right = right + n0 * power * getattr(param, f"{part}cross")[level]
    return np.tril(below) + np.tril(below, -1).T + n0 * prior, right, power


@pytest.mark.parametrize(("powers", "beyond"), [((1.0, 0.5), 0.0), ((1.15, 1.3), 0.0), ((1.3, 1.6), 1.0)])
def test_relative_errors_add_up_over_the_whole_band_and_the_tremor(powers: tuple[float, float], beyond: float) -> None:
    """The learned filter solves the sum of two systems, each over its own motion's power, with the prior in both."""
    relative = 12.0
    adaptive = AdaptiveConfig(
        share=0.0, emphasis=1.0, relative=relative, relative_powers=powers, relative_beyond=beyond
    )
    config = TremorConfig(adaptive=adaptive)
    record = make_record(3, "one tone", 6.0)
    estimator = Estimator(config)
    estimator.run(np.repeat(record.acceleration[:, None], 3, axis=1))
    state, param = peek(estimator.state).adaptive, peek(estimator.params).adaptive
    for level in range(2):
        whole, right, all_power = _system(state, param, level, "")
        core, core_right, tremor_power = _system(state, param, level, "core_")
        rows, wider = state.count[0, level] + param.prior_blocks[level], all_power / tremor_power
        counts = relative * max(wider - beyond, 0.0) ** powers[0]
        matrix = whole + counts * core + rows * wider ** powers[1] * param.quiet[0]
        right = right + counts * core_right
        found = np.array(state.solved[0, level])
        np.testing.assert_allclose(found @ matrix, right, rtol=0.05, atol=0.02 * np.abs(right).max())


def test_edges_out_of_order_are_refused() -> None:
    with pytest.raises(BenchError, match="cancel_from_hz"):
        TremorConfig.from_dict({"adaptive": {"cancel_from_hz": [6.0, 4.0]}})
    with pytest.raises(BenchError, match="core_hz"):
        TremorConfig.from_dict({"adaptive": {"core_hz": [6.0, 8.0, 7.0, 16.0]}})


def _noise_above_band_um(quiet: float) -> float:
    """rms of what a filter makes of the sensor's noise above 40 Hz, as an integral over frequency."""
    config = TremorConfig(adaptive=AdaptiveConfig(quiet=quiet))
    d = design_adaptive(config)
    hz = np.arange(40.0, 500.0, 0.5)
    response = d.start[0, 0, 1] @ d.bank.response(np.exp(2j * np.pi * hz / config.tick_hz).astype(np.complex128))
    return 1e6 * float(np.sqrt(np.sum(np.abs(response) ** 2 * sensor_noise(config, hz)) * 0.5))


def test_the_penalty_quietens_the_filter_above_the_band() -> None:
    loud, quiet, quieter = (_noise_above_band_um(q) for q in (0.0, 100.0, 1000.0))
    assert quiet < 0.5 * loud
    assert quieter < 0.7 * quiet


def test_a_held_command_shakes_a_resonance_by_its_image() -> None:
    """Against a resonator that is run: a command of 350 Hz held for 1 ms has an image at 650 Hz, where the mode is."""
    config = TremorConfig(adaptive=AdaptiveConfig(shaken_hz=(650.0, 650.0)))
    hz, over = np.array([100.0, 350.0]), 32
    step_s = 1e-3 / over
    n, w, damping = 2000, 2.0 * np.pi * 650.0, config.adaptive.shaken_damping
    mode = cont2discrete(([w * w], [1.0, 2.0 * damping * w, w * w]), step_s)
    power = []
    for f in hz:
        held = np.repeat(np.cos(2.0 * np.pi * f * 1e-3 * np.arange(n)), over)
        moved = lfilter(np.ravel(mode[0]), mode[1], held)[n * over // 2 :]
        power.append(2.0 * np.mean(moved**2))
    # images beyond the first, which the formula leaves out, are a small part
    np.testing.assert_allclose(power, shaking_power(config, hz), rtol=0.02)
    assert power[1] > 20.0
    np.testing.assert_array_equal(shaking_power(TremorConfig(), hz), 1.0)


def test_the_penalty_is_larger_where_the_resonance_is_shaken() -> None:
    """The filter of a bench with a resonance passes less to it, and its penalty is no smaller anywhere."""
    hz = np.arange(250.0, 450.0, 0.5)
    z = np.exp(2j * np.pi * hz / RATE_HZ).astype(np.complex128)
    shaken = TremorConfig(adaptive=AdaptiveConfig(shaken_hz=(600.0, 700.0)))
    flat, aware = design_adaptive(TremorConfig()), design_adaptive(shaken)
    passed = [float(np.mean(np.abs(d.start[0, 0, 1] @ d.bank.response(z)) ** 2)) for d in (flat, aware)]
    assert passed[1] < 0.5 * passed[0]
    assert np.linalg.eigvalsh(aware.quiet[0] - flat.quiet[0])[0] > -1e-9 * np.linalg.norm(aware.quiet[0])
    with pytest.raises(ValueError, match="lowest resonance first"):
        AdaptiveConfig(shaken_hz=(700.0, 600.0))


def test_what_is_learned_is_penalized_as_the_prior_is() -> None:
    """The regression's rows carry the penalty, too: data do not make the filter loud again."""
    record = make_record(105, "two tones", 20.0)
    rough: dict[float, float] = {}
    for quiet in (0.0, 100.0):
        config = TremorConfig(adaptive=AdaptiveConfig(quiet=quiet))
        ahead = Estimator(config, axes=1).run(record.acceleration[:, None]).ahead_m[:, 0]
        rough[quiet] = float(np.std(np.diff(ahead[-10_000:], 2)))
    assert rough[100.0] < 0.3 * rough[0.0]


@pytest.mark.parametrize("rate_hz", [500.0, 1000.0, 2000.0])
def test_errors_above_the_band_count_more(rate_hz: float) -> None:
    config = TremorConfig(tick_hz=rate_hz, adaptive=AdaptiveConfig(emphasis=1.0, above=10.0))
    b0, b1, b2, a1, a2 = design_adaptive(config).weight
    hz = np.array([3.0, 18.0, 120.0])
    back = np.exp(-2j * np.pi * hz / rate_hz)
    gain = np.abs((b0 + b1 * back + b2 * back**2) / (1.0 + a1 * back + a2 * back**2))
    np.testing.assert_allclose(gain, [1.0, np.sqrt(10.0), 10.0], rtol=0.03)
    with pytest.raises(ValidationError, match="set one of them to 1"):
        AdaptiveConfig(emphasis=2.0, above=10.0)


def _passed_above(acceleration: np.ndarray, **keys: float) -> float:
    """Power at 18 to 24 Hz that a filter lets through once it has learned this hand."""
    hz = np.arange(18.0, 24.0, 0.5)
    config = TremorConfig(adaptive=AdaptiveConfig.model_validate({"emphasis": 1.0, "core_q": 4.0, **keys}))
    estimator = Estimator(config)
    estimator.run(np.repeat(acceleration[:, None], 3, axis=1))
    ahead = np.array(peek(estimator.state).adaptive.solved[0, 1, 1])
    features = design_adaptive(config).bank.response(np.exp(2j * np.pi * hz / config.tick_hz))
    return float(np.mean(np.abs(ahead @ features * sensor_response(config, hz)) ** 2))


def test_motion_above_the_band_is_not_enlarged() -> None:
    """A filter that has learned a hand passes less than half as much motion at 18 to 24 Hz."""
    hand = make_record(3, "two tones", 8.0).acceleration
    plain, weighed = (_passed_above(hand, relative=10.0, above=above) for above in (1.0, 10.0))
    assert weighed < 0.25 * plain


@pytest.mark.parametrize("rate_hz", [500.0, 1000.0, 2000.0])
def test_errors_above_the_band_count_as_the_tremors_own(rate_hz: float) -> None:
    """The tremor band's filter is 1 at its peak; far above it is the share beside a peak of quality 4."""
    config = TremorConfig(tick_hz=rate_hz, adaptive=AdaptiveConfig(core_q=4.0, core_above=0.3))
    b0, b1, b2, a1, a2 = design_adaptive(config).core.weight
    back = np.exp(-2j * np.pi * np.array([0.5, 9.8, 120.0]) / rate_hz)
    gain = np.abs((b0 + b1 * back + b2 * back**2) / (1.0 + a1 * back + a2 * back**2))
    np.testing.assert_allclose(gain, [0.0, 1.0, 0.3 / np.hypot(1.0, 1.2)], rtol=0.02, atol=0.01)


def test_the_weight_above_the_band_grows_with_the_other_motion() -> None:
    """Beside a swing at 5 Hz it takes a larger share off what passes above the band than in the tremor alone."""
    hand = make_record(3, "two tones", 8.0).acceleration
    swing = 2.0 * np.std(hand) * np.sin(2.0 * np.pi * 5.0 * np.arange(len(hand)) / RATE_HZ)
    keys = {"relative": 15.0, "relative_beyond": 1.0}
    grown = [_passed_above(x, core_above=0.3, **keys) for x in (hand, hand + swing)]
    plain = [_passed_above(x, **keys) for x in (hand, hand + swing)]
    assert grown[1] / plain[1] < 0.85 * grown[0] / plain[0], (grown, plain)


def test_a_preset_is_the_start_and_the_keys_beside_it_override_it() -> None:
    config = AdaptiveConfig.model_validate({"preset": "still tip", "quiet": 5.0})
    assert (config.quiet, config.relative) == (5.0, PRESETS["still tip"]["relative"])
    assert AdaptiveConfig.model_validate(config.model_dump()) == config
    with pytest.raises(ValidationError, match="'loud tip' is no preset; there are still tip"):
        AdaptiveConfig.model_validate({"preset": "loud tip"})


def test_learning_when_the_output_is_out_gives_the_same_bits() -> None:
    """Some ticks learn at once, others in the next one; there is a restart and a gap."""
    late, early = Tremor(CONFIG), Tremor(CONFIG)
    rng = np.random.default_rng(5)
    samples = np.cumsum(rng.standard_normal((4000, AXES)), axis=0) * 0.01
    frames = [np.zeros(LAYOUT.size) for _ in range(2)]
    learned = []
    for k, sample in enumerate(samples):
        for frame in frames:
            frame[TICK] = k + 7 * (k > 3000)
            frame[STATUS] = RESTARTED if k == 500 else INVALID if k % 97 == 0 else 0
            frame[TIP_ACCELERATION : TIP_ACCELERATION + AXES] = sample
            frame[QUATERNION] = 1.0
        late.step(frames[0])
        early.step(frames[1])
        np.testing.assert_array_equal(frames[0], frames[1])
        if k % 3:
            before = early.state["adaptive"]["solved"].copy()
            learn_kernel(frames[1], early.state, early.params)
            learn_kernel(frames[1], early.state, early.params)  # once is enough
            assert early.state["adaptive"]["running"][0] == LEARNED
            learned.append(bool((early.state["adaptive"]["solved"] != before).any()))
    assert any(learned)
    learn_kernel(frames[0], late.state, late.params)
    learn_kernel(frames[1], early.state, early.params)
    np.testing.assert_array_equal(late.state, early.state)


def test_the_factor_is_cholesky_s_and_an_indefinite_matrix_has_none() -> None:
    rng = np.random.default_rng(6)
    half = rng.standard_normal((72, 72))
    whole = half @ half.T
    scale = 1.0 / np.sqrt(np.diag(whole))
    a = np.tril(whole)
    assert factorize(a, scale)
    expected = np.linalg.cholesky(whole * np.outer(scale, scale) + 1e-9 * np.eye(72))
    np.testing.assert_allclose(np.tril(a), expected, atol=1e-12)
    np.testing.assert_array_equal(np.triu(a), np.tril(a).T)
    whole[40, 40] = -1.0
    assert not factorize(np.tril(whole), np.ones(72))
    whole[40, 40] = np.nan
    assert not factorize(np.tril(whole), np.ones(72))
