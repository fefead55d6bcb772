"""Lag and resonance from steps, and the taps that undo them, against a state-space simulation of the mechanism."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import StateSpace, cont2discrete

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.feedforward import design_feedforward, tracking_gain
from firmware_py.control.stages import StageConfigs
from hal.errors import BenchError
from tools.calibrate.piezo_dynamics import Dynamics
from tools.calibrate.piezo_feedforward import Answers, for_instrument, for_tip
from tools.calibrate.piezo_steps import fit_steps, is_steps, mean_step
from tools.errors import InputError
from tools.mismatch.recording import Recording, Split, TwinText

TICK_S = 1e-3
SUB = 16
SLOW = Dynamics(lag_s=0.3e-3, resonance_hz=150.0, damping=0.05)
STACK = Dynamics(lag_s=0.1e-3, resonance_hz=650.0, damping=0.04)


def follow(dynamics: Dynamics, demand: np.ndarray, dt: float) -> np.ndarray:
    """Strokes at the beginning of each ``dt`` for demands held over it: amplifier and mechanism as a state space."""
    w, z, p = 2 * np.pi * dynamics.resonance_hz, dynamics.damping, 1 / dynamics.lag_s
    system = StateSpace([[-p, 0, 0], [0, 0, 1], [w * w, -w * w, -2 * z * w]], [[p], [0], [0]], [[0, 1, 0]], [[0]])
    a, b, _, _, _ = cont2discrete((system.A, system.B, system.C, system.D), dt)
    x, out = np.zeros(3), np.empty(len(demand))
    for k, u in enumerate(demand):
        out[k] = x[1]
        x = a @ x + b[:, 0] * u
    return out


def steps(dynamics: Dynamics | None, rate_hz: float = 8000.0, seconds: float = 2.0, noise: float = 0.0) -> Recording:
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    drive = 50.0 + 2.0 * np.where((5.0 * t) % 1.0 < 0.5, 1.0, -1.0)
    z = 0.12 * (drive - 50.0) if dynamics is None else follow(dynamics, 0.12 * (drive - 50.0), 1.0 / rate_hz)
    z = z + noise * np.random.default_rng(0).standard_normal(len(t))
    return Recording(
        path=Path("steps"), title="", t=t, dt=1.0 / rate_hz, inputs={"command": drive}, outputs={"displacement": z},
        context={}, noise={"displacement": None}, unit={}, column={}, twin=TwinText("piezo_stack", {}), split=Split(),
    )  # fmt: skip


@pytest.mark.parametrize("truth", [STACK, SLOW])
def test_a_resonance_is_found_in_steps(truth: Dynamics) -> None:
    recording = steps(truth, noise=0.03)
    assert is_steps(recording)
    found = fit_steps(recording)
    assert found.resonance_hz == pytest.approx(truth.resonance_hz, rel=0.01)
    assert found.damping == pytest.approx(truth.damping, rel=0.1)
    assert found.lag_s == pytest.approx(truth.lag_s, rel=0.2)


def test_no_resonance_is_made_up() -> None:
    well_damped = replace(STACK, resonance_hz=4000.0, damping=0.8, lag_s=0.5e-3)
    found = fit_steps(steps(well_damped, noise=0.03))
    assert found.resonance_hz == 0.0
    assert found.lag_s == pytest.approx(0.56e-3, rel=0.1)


def test_poor_steps_are_refused() -> None:
    with pytest.raises(InputError, match="steps need at least"):
        mean_step(steps(STACK, seconds=0.6))
    smooth = steps(STACK)
    smooth = replace(smooth, inputs={"command": np.sin(smooth.t)})
    assert not is_steps(smooth)


@pytest.mark.parametrize("truth", [STACK, SLOW])
def test_the_tip_follows_a_tremor_through_the_taps(truth: Dynamics) -> None:
    """20 Hz: demands held for a tick, mechanism simulated sixteen times per tick, error over the whole tick."""
    found = for_tip([Answers(truth, truth, 0.0, TICK_S)], TICK_S)

    def error(taps: tuple[float, ...], preview_s: float) -> float:
        n = 2000
        ahead = np.sin(2 * np.pi * 20.0 * (np.arange(n) * TICK_S + preview_s))
        demand = np.convolve(ahead, taps)[:n]
        tip = follow(truth, np.repeat(demand, SUB), TICK_S / SUB)
        at = np.arange(n * SUB) * TICK_S / SUB
        left = tip - np.sin(2 * np.pi * 20.0 * at)
        # the steps of the hold themselves are not the taps' business: mean over each tick
        return float(np.max(np.abs(left.reshape(n, SUB).mean(axis=1)[1000:])))

    with_taps = error(found.taps[0], found.preview_s)
    assert with_taps < 0.003
    assert with_taps < 0.5 * error((1.0,), 0.0)
    assert sum(found.taps[0]) == pytest.approx(1.0)
    assert found.peak[0] < 3.0
    # what was promised, up to 40 Hz, is what comes out at 20
    assert with_taps < found.left[0] + 1e-3


def test_stacks_that_differ_get_taps_of_their_own_for_one_preview() -> None:
    late = Answers(STACK, STACK, 0.2e-3, TICK_S)
    both = for_tip([Answers(STACK, STACK, 0.0, TICK_S), late], TICK_S)
    assert both.taps[0] != both.taps[1]
    assert max(both.left) < 0.002
    # 0.5 ms of hold, 0.1 ms of lag, 0.02 of damping, 0.2 more
    assert both.preview_s == pytest.approx(0.82e-3, abs=0.02e-3)


def test_an_instrument_that_reads_at_the_ticks_needs_another_preview() -> None:
    """Read just before the next demand: a whole tick for a quick mechanism, and the ringing as the samples see it."""
    answers = Answers(STACK, STACK, 0.0, TICK_S)
    found = for_instrument([answers])
    n = 1000
    ahead = np.sin(2 * np.pi * 15.0 * (np.arange(n) * TICK_S + found.preview_s))
    z = follow(STACK, np.convolve(ahead, found.taps[0])[:n], TICK_S)
    assert np.max(np.abs(z - np.sin(2 * np.pi * 15.0 * np.arange(n) * TICK_S))[500:]) < 0.002
    slow = Dynamics(delay_s=3e-3)
    assert slow.sampled_delay_s(TICK_S) == pytest.approx(3e-3)
    assert slow.mechanism(TICK_S, held=True).delay_s == pytest.approx(2.5e-3)
    assert slow.mechanism(TICK_S, held=False) == slow


def test_gains_at_the_ticks_against_the_simulation() -> None:
    n = 4000
    t = np.arange(n) * TICK_S
    for hz in (5.0, 35.0):
        z = follow(SLOW, np.sin(2 * np.pi * hz * t), TICK_S)[2000:]
        turn = np.exp(-2j * np.pi * hz * t[2000:])
        seen = 2j * np.mean(z * turn)
        assert SLOW.sampled_gain(np.array([hz]), TICK_S)[0] == pytest.approx(seen, abs=2e-3)


def test_taps_do_not_raise_noise_and_leave_rest_alone() -> None:
    taps = design_feedforward(lambda hz: SLOW.held_gain(hz, TICK_S), TICK_S, 1.4e-3)
    assert taps.sum() == pytest.approx(1.0, abs=1e-12)
    # white noise of the wish comes through with the norm of the taps
    assert np.linalg.norm(taps) < 1.5
    hz = np.linspace(1.0, 40.0, 40)
    assert np.max(np.abs(tracking_gain(taps, lambda f: SLOW.held_gain(f, TICK_S), TICK_S, 1.4e-3, hz) - 1)) < 0.01


def test_the_firmware_refuses_taps_that_are_none_and_a_horizon_that_is_too_short() -> None:
    assert ActuationConfig(feedforward=(0.5, 0.5)).feedforward == ((0.5, 0.5),) * 3  # pyright: ignore[reportArgumentType]
    with pytest.raises(BenchError, match="taps must sum to 1"):
        ActuationConfig.from_dict({"feedforward": [[1.0], [0.9], [1.0]]})
    tables = {"tremor": {"loop_delay_s": 0.001}, "actuation": {"preview_s": 0.0015}}
    with pytest.raises(BenchError, match="predicts less far ahead"):
        StageConfigs.from_dict(tables, "bench.toml")
