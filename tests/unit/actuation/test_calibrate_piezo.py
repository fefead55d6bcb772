"""Identification of the stack model: known operators, an unlike plant, real data, bad input."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from firmware_py.actuation.config import ActuationConfig, StackConfig
from tests.unit.actuation.excitation import excitation_V
from tools.calibrate.piezo import identify_stack, piezo_calibration
from tools.calibrate.piezo_dynamics import Dynamics, delayed
from tools.calibrate.piezo_prediction import simulate
from tools.errors import InputError
from tools.mismatch.recording import Recording, Split, TwinText

RATE_HZ = 1000.0


def recording(drive: np.ndarray, displacement: np.ndarray, rate_hz: float = RATE_HZ) -> Recording:
    return Recording(
        path=Path("recording.toml"),
        title="test",
        t=np.arange(len(drive)) / rate_hz,
        dt=1.0 / rate_hz,
        inputs={"command": drive},
        outputs={"displacement": displacement},
        context={},
        noise={"displacement": None},
        unit={"command": "V", "displacement": "um"},
        column={"command": "command_V", "displacement": "displacement_um"},
        twin=TwinText("piezo_stack", {}),
        split=Split(),
    )


def bouc_wen(drive: np.ndarray) -> np.ndarray:
    """A stack that is not a play model: Bouc-Wen memory, whose small loops do not even close."""
    h, z = 0.0, np.empty_like(drive)
    previous = 0.0
    for k, u in enumerate(drive):
        step = u - previous
        h += 0.35 * step - 0.012 * abs(step) * h - 0.006 * step * abs(h)
        z[k] = 0.15 * u + 2e-4 * u * (100 - u) * 0.3 - 0.06 * h
        previous = u
    return z


def test_the_models_own_numbers_come_back() -> None:
    truth = StackConfig(dead_zone_thresholds_um=(0.0, 7.0), dead_zone_weights=(1.0, -0.1), offset_um=-2.0)
    drive = excitation_V(RATE_HZ, 20.0)
    rng = np.random.default_rng(0)
    fit = identify_stack(recording(drive, simulate(truth, drive) + 0.02 * rng.standard_normal(len(drive))))
    assert fit.lag_s == 0.0
    assert fit.held_out_rms_um < 0.03
    small = 50 + 5 * np.sin(np.linspace(0, 60, 3000))
    ours, theirs = simulate(fit.stack, small), simulate(truth, small)
    assert np.std(ours - theirs) < 0.01  # of 0.37 um rms; the thresholds are not the same


def test_an_unlike_stack_is_tracked_better_than_by_a_line() -> None:
    drive = excitation_V(RATE_HZ, 20.0)
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(drive))
    fit = identify_stack(recording(drive, bouc_wen(drive) + noise))
    assert fit.linear_rms_um > 0.01 * fit.range_um
    assert fit.held_out_rms_um < 0.3 * fit.linear_rms_um
    assert np.all(np.cumsum(fit.stack.play_weights_um_per_V) > 0.0)
    assert fit.warnings == ()


def test_a_lag_is_found_and_not_taken_for_hysteresis() -> None:
    drive = excitation_V(RATE_HZ, 20.0)
    truth = StackConfig()
    late = np.interp(np.arange(len(drive)) - 1.4, np.arange(len(drive)), drive)
    fit = identify_stack(recording(drive, simulate(truth, late)))
    assert fit.lag_s == pytest.approx(1.4e-3, abs=1e-4)
    assert fit.held_out_rms_um < 0.01


def test_the_firmware_loads_what_is_written() -> None:
    drive = excitation_V(RATE_HZ, 10.0)
    fit = identify_stack(recording(drive, simulate(StackConfig(), drive)))
    table = tomllib.loads(piezo_calibration([fit], "three alike"))
    assert table["format"] == 1
    config = ActuationConfig.from_dict(table["actuation"])
    assert config.stacks == (fit.stack,) * 3
    with pytest.raises(InputError, match="one \\(for all three stacks\\) or three"):
        piezo_calibration([fit, fit], "two")


def test_poor_excitation_is_named() -> None:
    drive = 50 + 20 * np.sin(np.arange(4000) * 0.01)
    fit = identify_stack(recording(drive, 0.15 * drive))
    assert any("covers 40 V" in warning for warning in fit.warnings)
    assert any("small loops" in warning for warning in fit.warnings)
    with pytest.raises(InputError, match="visit its lowest"):
        identify_stack(recording(np.linspace(0, 100, 3000), np.linspace(0, 15, 3000)))


def test_a_real_micromanipulator_is_predicted_from_its_other_recording(shared_data: Path) -> None:
    """Public recording: the paper's own errors come out, prediction and simulated control are as good as they must."""
    from tools.research.reproduce.actuation_real import real_stack

    *paper, line, goal, preisach, narx = real_stack()
    assert [row.published for row in paper] == [1.68, 0.58]
    assert all(row.meets for row in (*paper, goal, preisach, narx))
    assert goal.published == 0.25
    assert line.ours == goal.ours
    assert line.ours < 0.1 * line.published


def test_loops_of_one_size_show_their_lag_only_where_they_begin_with_a_step() -> None:
    """Both recordings are the same stack behind the same lag; one of them began when the amplifier was switched on."""
    rate_hz, late = 200.0, Dynamics(delay_s=0.004, lag_s=0.012)
    truth = StackConfig(centre_V=50.0)
    t = np.arange(2400) / rate_hz
    drive = 50.0 + 49.0 * np.sin(2.0 * np.pi * t)
    before = 400
    whole = np.concatenate([np.zeros(before), drive])
    levels = simulate(truth, whole, rate_hz, high_V=0.0)
    z = levels[0] + lfilter(late.response(1.0 / rate_hz), [1.0], levels - levels[0])
    z += 0.005 * np.random.default_rng(3).standard_normal(len(z))
    begun = identify_stack(recording(drive, z[before:], rate_hz))
    assert begun.lag_s == pytest.approx(late.sampled_delay_s(1.0 / rate_hz), abs=1.5e-3)
    assert any("step from 0 V" in warning for warning in begun.warnings)
    running = identify_stack(recording(drive[200:], z[before + 200 :], rate_hz))
    assert running.lag_s == 0.0
    assert any("taken as none" in warning for warning in running.warnings)


def test_rates_and_creep_come_back() -> None:
    """A stack of the model's own form: slopes that fall and rise with the rate, creep; several recordings."""
    truth = StackConfig(
        centre_V=50.0,
        slope_per_rate_s_per_V=(-4e-5, -2e-5, *[0.0] * 6, 3e-5, 3e-5),
        creep_times_s=(0.1, 1.0, 10.0),
        creep_shares=(0.01, 0.015, 0.01),
    )
    t = np.arange(3000) / RATE_HZ
    sweep = 50.0 + 50.0 * np.sin(2 * np.pi * t / 3.0)
    given = []
    for hz in (1.0, 5.0, 20.0, 38.0):
        drive = np.concatenate([sweep, 50.0 + 48.0 * np.sin(2 * np.pi * hz * t)])
        noise = 0.02 * np.random.default_rng(int(hz)).standard_normal(len(drive))
        given.append(recording(drive, simulate(truth, drive) + noise))
    fit = identify_stack(given)
    assert fit.stack.slope_per_rate_s_per_V
    assert fit.held_out_rms_um < 0.04
    assert fit.singular_um_s == pytest.approx(0.105 / 4e-5, rel=0.35)
    # a rate between those recorded
    drive = np.concatenate([sweep, 50.0 + 48.0 * np.sin(2 * np.pi * 12.0 * t)])
    # slopes that fall with the rate and a lag look much alike: together they must give the same displacement
    apart = simulate(fit.stack, delayed(drive, fit.lag_s, 1.0 / RATE_HZ)) - simulate(truth, drive)
    assert np.std(apart[3100:]) < 0.05  # of 5.5 um rms; unseen recordings leave 0.03


def test_dynamics_step_against_the_differential_equation() -> None:
    from scipy.signal import StateSpace, step

    w, z, p = 2 * np.pi * 300.0, 0.07, 1 / 0.4e-3
    system = StateSpace([[-p, 0, 0], [0, 0, 1], [w * w, -w * w, -2 * z * w]], [[p], [0], [0]], [[0, 1, 0]], [[0]])
    t, y = step(system, T=np.linspace(0, 0.02, 400))
    np.testing.assert_allclose(Dynamics(0.0, 0.4e-3, 300.0, 0.07).step(t), np.ravel(y), atol=1e-6)
    slow = Dynamics(0.0, 0.4e-3, 0.0, 0.0, 0.5, 2e-3).step(t)
    one = -np.expm1(-t * p)
    two = 1 - (2e-3 * np.exp(-t / 2e-3) - 0.4e-3 * np.exp(-t * p)) / (2e-3 - 0.4e-3)
    np.testing.assert_allclose(slow, 0.5 * one + 0.5 * two, atol=1e-9)
