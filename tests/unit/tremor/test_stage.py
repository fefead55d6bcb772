"""The tremor stage: settling, lost and bad samples, both methods behind one interface."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.frame import (
    ALIGNING,
    CONFIDENCE,
    INVALID,
    LAYOUT,
    SETTLING,
    STATUS,
    TICK,
    TIP_ACCELERATION,
    TREMOR_AHEAD,
    TREMOR_AMPLITUDE,
    TREMOR_FREQUENCY,
)
from firmware_py.tremor import stage
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.stage import Tremor
from hal.errors import BenchError
from tests.unit.pure_python import assert_kernel_is_python
from tests.unit.tremor.synthetic import RATE_HZ

METHODS = ("kalman", "wflc_flc")
HZ = np.array([9.0, 10.0, 11.0])


def steady(n: int) -> np.ndarray:
    """Frames with tones of 20 um at 9, 10 and 11 Hz (RC filter left out: amplitudes are not judged here)."""
    frames = np.zeros((n, LAYOUT.size))
    t = np.arange(n) / RATE_HZ
    frames[:, TICK] = np.arange(n)
    w = 2 * np.pi * HZ
    frames[:, LAYOUT["tip_acceleration"]] = -20e-6 * w**2 * np.sin(w * t[:, None])
    return frames


def run(config: TremorConfig, frames: np.ndarray) -> Tremor:
    tremor = Tremor(config)
    for frame in frames:
        tremor.step(frame)
    return tremor


@pytest.mark.parametrize("method", METHODS)
def test_three_axes_settle_on_their_own_tones(method: str) -> None:
    frames = steady(5000)
    run(TremorConfig(method=method), frames)
    last = frames[-1]
    np.testing.assert_allclose(last[TREMOR_FREQUENCY : TREMOR_FREQUENCY + 3], HZ, atol=0.05)
    assert np.all(last[CONFIDENCE : CONFIDENCE + 3] > 0.7)
    assert last[STATUS] == 0.0
    rc = 1.0 / np.abs(1.0 / (1.0 + 2j * np.pi * HZ * 32_000.0 * 0.33e-6))
    np.testing.assert_allclose(last[TREMOR_AMPLITUDE : TREMOR_AMPLITUDE + 3], 20e-6 * rc, rtol=0.1)


@pytest.mark.parametrize("method", METHODS)
def test_no_confidence_before_it_has_settled(method: str) -> None:
    frames = steady(800)
    run(TremorConfig(method=method, settle_s=0.7), frames)
    assert np.all(frames[:699, CONFIDENCE : CONFIDENCE + 3] == 0.0)
    assert np.all(frames[:700, STATUS].astype(int) & SETTLING)
    assert not int(frames[-1, STATUS]) & SETTLING


def test_silence_earns_no_confidence() -> None:
    frames = np.zeros((3000, LAYOUT.size))
    frames[:, TICK] = np.arange(3000)
    run(TremorConfig(), frames)
    assert np.all(frames[:, CONFIDENCE : CONFIDENCE + 3] == 0.0)
    assert np.all(np.isfinite(frames))


@pytest.mark.parametrize("method", METHODS)
def test_it_runs_on_through_bad_and_lost_samples(method: str) -> None:
    whole, holes = steady(4000), steady(4000)
    run(TremorConfig(method=method), whole)
    holes[3000:3005, TIP_ACCELERATION : TIP_ACCELERATION + 3] = np.nan
    holes[3000:3005, STATUS] = INVALID
    tremor = run(TremorConfig(method=method), holes[:3100])
    for frame in holes[3105:]:
        tremor.step(frame)
    assert np.all(np.isfinite(holes[:, TREMOR_AHEAD]))
    scale = np.abs(whole[2000:, TREMOR_AHEAD]).max()
    assert np.max(np.abs(holes[3000:3005, TREMOR_AHEAD] - whole[3000:3005, TREMOR_AHEAD])) < 0.05 * scale
    assert np.max(np.abs(holes[3106:3200, TREMOR_AHEAD] - whole[3106:3200, TREMOR_AHEAD])) < 0.1 * scale


def test_a_repeated_scan_is_not_counted_twice() -> None:
    """A stale tick coasts; the late scan that belongs to it only corrects."""
    whole, late = steady(3000), steady(3000)
    run(TremorConfig(), whole)
    tremor = Tremor(TremorConfig())
    for k, frame in enumerate(late):
        if k == 2000:
            stale = late[k - 1].copy()
            stale[STATUS] = 2.0  # STALE, same device tick as before
            tremor.step(stale)
        tremor.step(frame)
    np.testing.assert_allclose(late[2500:, TREMOR_AHEAD], whole[2500:, TREMOR_AHEAD], atol=1e-12)


def test_alignment_of_the_attitude_holds_the_estimator_at_zero() -> None:
    frames = steady(1000)
    frames[:500, STATUS] = ALIGNING
    run(TremorConfig(), frames)
    assert np.all(frames[:500, TREMOR_AHEAD : TREMOR_AHEAD + 3] == 0.0)
    assert int(frames[999, STATUS]) & SETTLING  # settling counts from the end of alignment


@pytest.mark.parametrize("method", ["wflc_flc"])
def test_kernel_and_python_agree(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = steady(40)
    twins = frames.copy()
    config = TremorConfig(method=method, settle_s=0.01)
    run(config, frames)
    assert_kernel_is_python(monkeypatch, stage, "estimate_kernel", Tremor(config), twins, frames, rtol=1e-7, atol=1e-15)


def test_reset_is_a_new_start() -> None:
    frames, again = steady(500), steady(500)
    tremor = run(TremorConfig(), frames)
    tremor.reset()
    for frame in again:
        tremor.step(frame)
    assert np.array_equal(frames, again)


def test_a_wrong_key_is_named() -> None:
    with pytest.raises(BenchError, match=r"wflc\.frequency"):
        TremorConfig.from_dict({"wflc": {"frequency": 9.0}})
    with pytest.raises(BenchError, match="low_hz"):
        TremorConfig.from_dict({"wflc": {"low_hz": 11.0}})
