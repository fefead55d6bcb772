"""Slow motion yields to tremor: against what the stroke allows, and against what clipping would do to 8 to 12 Hz."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from firmware_py.actuation import yielding
from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.stage import Actuation
from firmware_py.actuation.yielding import LEAST_ROOM, Swing, YieldLimits, YieldState, shrink_core, yield_rest
from firmware_py.frame import CLIP, CLIP_WORKSPACE, CLIP_YIELD, CONFIDENCE, LAYOUT, TREMOR_AHEAD, TREMOR_CORE
from firmware_py.records import attributes, new
from tests.unit.pure_python import without_compiler

LOW, HIGH = np.full(3, -7e-6), np.full(3, 7e-6)
KEEP = float(np.exp(-1.0 / 2000.0))
LIMITS = YieldLimits(LOW, HIGH, KEEP, 1.2, 1, 1.2, 1.0)
ATTACK = 1.0 - float(np.exp(-1.0 / 40.0))
BAND = butter(4, [8.0, 12.0], btype="band", fs=1000.0, output="sos")


def hand(n: int, slow_m: float, core_m: float = 15e-6) -> np.ndarray:
    """Frames that want a swing of ``slow_m`` at 4 Hz and a tremor of ``core_m`` at 9.5 Hz along the shaft."""
    t = np.arange(n) / 1000.0
    frames = np.zeros((n, LAYOUT.size))
    frames[:, CONFIDENCE : CONFIDENCE + 3] = 0.9
    frames[:, TREMOR_CORE + 2] = core_m * np.sin(2 * np.pi * 9.5 * t)
    frames[:, TREMOR_AHEAD + 2] = frames[:, TREMOR_CORE + 2] + slow_m * np.sin(2 * np.pi * 4.0 * t)
    return frames


def run(frames: np.ndarray) -> np.ndarray:
    """Wanted tip along the shaft, m."""
    actuation = Actuation(ActuationConfig())
    for frame in frames:
        actuation.step(frame)
    return frames[:, LAYOUT["desired_tip"]][:, 2]


def in_band_error(frames: np.ndarray, tip: np.ndarray) -> float:
    """Error against minus the core in 8 to 12 Hz over the core's rms, the first second left out."""
    error = sosfiltfilt(BAND, tip + frames[:, TREMOR_CORE + 2])[1000:-500]
    return float(np.std(error) / np.std(frames[1000:-500, TREMOR_CORE + 2]))


def test_within_the_stroke_nothing_yields() -> None:
    frames = hand(1500, slow_m=20e-6)
    tip = run(frames)
    assert np.all(frames[:, CLIP] == 0.0)
    np.testing.assert_allclose(tip[600:], -frames[600:, TREMOR_AHEAD + 2], atol=1e-18)


def test_a_swing_beyond_the_stroke_leaves_the_tremor_its_own() -> None:
    """Clipped instead, the same wish leaves a quarter of the tremor and more."""
    frames = hand(4000, slow_m=150e-6)
    tip = run(frames)
    flags = frames[1500:, CLIP].astype(int)
    assert np.all(flags & CLIP_YIELD)
    assert np.mean(flags & CLIP_WORKSPACE != 0) < 0.01  # the scale follows in 40 ms
    assert in_band_error(frames, tip) < 0.05
    clipped = hand(4000, slow_m=150e-6)
    clipped[:, TREMOR_CORE + 2] = clipped[:, TREMOR_AHEAD + 2]
    reached = run(clipped)
    assert in_band_error(frames, reached) > 0.25
    # most of the stroke is still used
    assert np.max(np.abs(tip[1500:])) > 0.75 * np.max(np.abs(reached[1500:]))


def test_the_wish_has_no_jump_when_the_swing_begins() -> None:
    frames = hand(3000, slow_m=150e-6)
    onset = np.clip((np.arange(3000) - 1500) / 20.0, 0.0, 1.0)
    frames[:, TREMOR_AHEAD + 2] = frames[:, TREMOR_CORE + 2] + onset * (
        frames[:, TREMOR_AHEAD + 2] - frames[:, TREMOR_CORE + 2]
    )
    tip = run(frames)
    assert np.max(np.abs(np.diff(tip[600:]))) <= 1.05 * np.max(np.abs(np.diff(frames[600:, TREMOR_AHEAD + 2])))


@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_let_through_fits_whatever_comes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = new(YieldState)
    for _ in range(400):
        core = rng.uniform(-3e-6, 3e-6, 3)
        stroke = core + rng.standard_normal(3) * 10.0 ** rng.uniform(-6.5, -4.0)
        wanted = stroke.copy()
        held = yield_rest(Swing(stroke, core), state[0], LIMITS)
        assert np.all((stroke >= LOW - 1e-18) & (stroke <= HIGH + 1e-18))
        assert held == bool(np.any(stroke != wanted))


def test_what_has_no_inverse_is_left_alone_and_not_remembered() -> None:
    state = new(YieldState)
    stroke = np.array([np.nan, 0.0, 0.0])
    assert not yield_rest(Swing(stroke, np.zeros(3)), state[0], LIMITS)
    assert state[0].tobytes() == new(YieldState)[0].tobytes()


TIMES = np.arange(4000) / 1000.0


def shrunk(cores: np.ndarray, overdrive: float, tilts: bool = True) -> np.ndarray:
    """What is let through of ``cores`` (n, 3), m of stroke; what is wanted beside them stays."""
    state, out = new(YieldState), cores.copy()
    for core in out:
        stroke = core + 1e-6
        limits = YieldLimits(LOW, HIGH, KEEP, overdrive, int(tilts), overdrive, 1.0)
        shrink_core(Swing(stroke, core), state[0], limits)
        np.testing.assert_allclose(stroke - core, 1e-6, atol=1e-18)
    return out


@pytest.mark.parametrize("tremor_hz", [8.0, 9.7, 12.0])
def test_a_swing_beyond_the_stroke_is_let_through_as_a_smaller_one(tremor_hz: float) -> None:
    """A sine stays a sine, whatever its frequency: its scale does not know its phase."""
    sine = np.sin(2 * np.pi * tremor_hz * TIMES)
    wanted = np.repeat(20e-6 * sine[:, None], 3, axis=1)
    through = shrunk(wanted, 1.2)[2500:, 0]
    cosine = np.cos(2 * np.pi * tremor_hz * TIMES)
    basis = np.column_stack([sine, cosine])[2500:]
    weights = np.linalg.lstsq(basis, through, rcond=None)[0]
    assert np.hypot(*weights) == pytest.approx(1.2 * 7e-6, rel=0.01)
    assert np.std(through - basis @ weights) < 0.01 * np.std(through)


def test_a_swing_within_overdrive_and_one_that_may_be_clipped_are_left_alone() -> None:
    wanted = np.repeat(10e-6 * np.sin(2 * np.pi * 10.0 * TIMES)[:, None], 3, axis=1)
    np.testing.assert_array_equal(shrunk(wanted, 1.5)[600:], wanted[600:])
    np.testing.assert_array_equal(shrunk(3.0 * wanted, 0.0), 3.0 * wanted)


def test_the_tilt_keeps_what_it_needs_and_each_stack_ends_at_its_stroke() -> None:
    """The tilt turns a third of a cycle later: swings add up as phasors, not by their sizes."""
    tilt = np.array([2e-6, -1e-6, -1e-6]) * np.sin(2 * np.pi * 10.0 * TIMES - 2.0)[:, None]
    axial = 15e-6 * np.sin(2 * np.pi * 10.0 * TIMES)[:, None]
    through = shrunk(tilt + axial, 1.0)
    np.testing.assert_allclose(through - through.mean(axis=1, keepdims=True), tilt, atol=1e-15)
    peaks = np.max(np.abs(through[2500:]), axis=0)
    assert np.max(peaks) == pytest.approx(7e-6, rel=0.01)


@pytest.mark.parametrize("tilts", [True, False])
def test_a_tilt_beyond_the_stroke_is_a_smaller_sine_unless_it_may_be_clipped(tilts: bool) -> None:
    tilt = np.array([20e-6, -10e-6, -10e-6]) * np.sin(2 * np.pi * 10.0 * TIMES)[:, None]
    through = shrunk(tilt, 1.0, tilts)[2500:]
    share = through[:, 0] @ tilt[2500:, 0] / (tilt[2500:, 0] @ tilt[2500:, 0])
    assert share == pytest.approx(7e-6 / 20e-6 if tilts else 1.0, rel=0.01)
    assert np.std(through - share * tilt[2500:]) < 0.01 * np.std(through)


def let_through(rest: np.ndarray, attack: float) -> np.ndarray:
    """Return what is let through of motion ``rest`` (n,), m along the shaft, without a core."""
    state, out = new(YieldState), np.repeat(rest[:, None], 3, axis=1)
    for stroke in out:
        yield_rest(Swing(stroke, np.zeros(3)), state[0], LIMITS._replace(attack=attack))
    return np.clip(out, LOW, HIGH)[:, 0]


def test_a_swing_that_grows_beyond_the_stroke_has_no_corners() -> None:
    """A scale that follows the position holds each new peak: a swing that doubles in a second has a corner at each."""
    rest = 5e-6 * 2.0**TIMES * np.sin(2 * np.pi * 4.0 * TIMES)
    above = butter(4, 20.0, btype="high", fs=1000.0, output="sos")
    shaken = [float(np.std(sosfiltfilt(above, let_through(rest, a))[500:-500])) for a in (1.0, ATTACK)]
    assert shaken[1] < 0.6 * shaken[0]


def test_a_tilt_may_have_an_overdrive_of_its_own() -> None:
    tilt = np.array([20e-6, -10e-6, -10e-6]) * np.sin(2 * np.pi * 10.0 * TIMES)[:, None]
    state, out = new(YieldState), tilt + 5e-6 * np.sin(2 * np.pi * 10.0 * TIMES)[:, None]
    for core in out:
        shrink_core(Swing(core.copy(), core), state[0], LIMITS._replace(overdrive=1.0, tilt=1.5))
    along = out[2500:].mean(axis=1)
    assert np.max(np.abs(out[2500:] - along[:, None])) == pytest.approx(1.5 * 7e-6, rel=0.01)
    assert np.max(np.abs(along)) == pytest.approx(LEAST_ROOM * 5e-6, rel=0.01)  # the tilt leaves the shaft nothing


def test_kernel_and_python_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    rows = [(c + rng.standard_normal(3) * 1e-5, c) for c in rng.uniform(-3e-6, 3e-6, (50, 3))]
    fast, slow = new(YieldState), new(YieldState)
    compiled = [row[0].copy() for row in rows]
    flags = [yield_rest(Swing(s, r[1]), fast[0], LIMITS) for s, r in zip(compiled, rows, strict=True)]
    without_compiler(monkeypatch)
    for (stroke, core), found, flag in zip(rows, compiled, flags, strict=True):
        assert yielding.yield_rest(Swing(stroke, core), attributes(slow)[0], LIMITS) == flag
        np.testing.assert_allclose(stroke, found, atol=1e-18)
    fast, slow = new(YieldState), new(YieldState)
    for k, core in enumerate(rng.uniform(-9e-6, 9e-6, (50, 3))):
        found, stroke = core.copy(), core + 1e-6
        monkeypatch.undo()
        flag = shrink_core(Swing(stroke.copy(), found), fast[0], LIMITS)
        without_compiler(monkeypatch)
        assert yielding.shrink_core(Swing(stroke, core), attributes(slow)[0], LIMITS) == flag, k
        np.testing.assert_allclose(core, found, atol=1e-18)
