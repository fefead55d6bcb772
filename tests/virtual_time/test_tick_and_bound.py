"""At half the tick rate the loop leaves more tremor, and the longer delay alone explains how much more."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from firmware_py.tremor.adaptive_design import design_adaptive, solve_scaled
from firmware_py.tremor.config import TremorConfig
from hal.arrays import Array
from tests.conftest import DEFAULT_BENCH
from tools.research.tremor.bench_variant import merged, write_variant
from tools.research.tremor.bound import bank_features, lift
from tools.research.tremor.cases import RATE_HZ
from tools.research.tremor.ideal import (
    EVERY,
    LOOP_DELAY_S,
    SETTLE_S,
    ideal_changes,
    ideal_samples,
    involuntary,
    wanted_motion,
)

SECONDS = 20.0
SAMPLE_TO_STROKE_S = 0.6e-3
"""Sample to command over the emulated wires (0.5 ms) and the amplifier's lag (0.1 ms), at any tick rate."""


def left_and_bound(truth: Mapping[str, Array], keep: NDArray[np.bool_], delay_s: float) -> tuple[float, float]:
    """Return the lifted residuals (m rms) of a run with accelerometer noise and of the bound at exactly ``delay_s``,
    over the rows ``keep`` (n,).

    The bound looks at every sample of the truth (1000 Hz), whatever the tick of the run.
    """
    design = design_adaptive(TremorConfig(loop_delay_s=LOOP_DELAY_S))
    samples, wanted = ideal_samples(truth, noise=True), wanted_motion(truth)
    t_s = np.arange(len(wanted)) / RATE_HZ
    rows = np.flatnonzero(keep)[::EVERY]
    unpredicted = np.empty_like(wanted)
    for i in range(3):
        then = np.interp(t_s + delay_s, t_s, wanted[:, i])
        plain = bank_features(samples[:, i], design)
        features, goal = lift(plain, design)[rows], lift(then, design)[rows]
        unpredicted[:, i] = then - plain @ solve_scaled(features.T @ features, (features.T @ goal)[None, :])[0]
    error = involuntary(np.asarray(truth["tip_m"]) - np.asarray(truth["intended_m"]))
    left, bound = (float(np.sqrt(np.mean(np.sum(lift(x, design)[keep] ** 2, axis=1)))) for x in (error, unpredicted))
    return left, bound


def left_over_bound(tick_hz: int, seed: int, folder: Path) -> float:
    """Return what a run over the wires leaves of the tremor, divided by the bound at the delay of its tick."""
    delay_s = SAMPLE_TO_STROKE_S + 0.5 / tick_hz  # a command holds for one tick
    changes: dict[str, Any] = {
        "clock": {"tick_hz": tick_hz},
        "device": {"daq": {"rate_hz": tick_hz}},
        "firmware": {"tremor": {"loop_delay_s": delay_s}},
    }
    bench = write_variant(DEFAULT_BENCH, merged(ideal_changes(noise=True), changes), folder, f"at-{tick_hz}")
    outcome, truth = run_in_process(RunRequest(bench, SECONDS, pace="virtual", seed=seed), runtime_dir=folder)
    assert truth is not None
    assert outcome["safe_state"]["normal"]
    t_ns = np.asarray(truth["t_ns"])
    # zero-phase bands are not trusted at the end
    keep = (t_ns >= outcome["armed_ns"] + SETTLE_S * 1e9) & (t_ns < outcome["safe_ns"] - 500_000_000)
    left_m, bound_m = left_and_bound(truth, keep, delay_s)
    return left_m / bound_m


@pytest.mark.slow
def test_the_longer_delay_explains_what_500_hz_leaves(tmp_path: Path) -> None:
    """Seed 2 was looked at before the limit of 2 % was set (1.239 at 1000 Hz, 1.244 at 500 Hz); seed 5 was not."""
    assert left_over_bound(500, 5, tmp_path) == pytest.approx(left_over_bound(1000, 5, tmp_path), rel=0.02)
