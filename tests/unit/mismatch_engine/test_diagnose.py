"""The whole chain on small recordings whose physics was written in other forms than the effects'."""

import json

import numpy as np
import pytest
from scipy.signal import lsim

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import RATE, N, noise, recording, stack, wave
from tools.mismatch.engine.report import Report
from tools.mismatch.infer import diagnose

SIGMA = 0.05


def names(report: Report) -> list[str]:
    return [p.name for p in report.physics]


@pytest.mark.parametrize(
    ("effect", "severity"),
    [
        ("hysteresis", 10.0),
        ("backlash", 6.0),
        ("thermal_drift", 4.0),
        ("saturation", 4.0),
        ("mains_interference", 4.0),
        ("vibration", 4.0),
        ("step_shift", 4.0),
        ("dead_time", 4.0),
        ("first_order_lag", 6.0),
        ("static_nonlinearity", 4.0),
        ("spikes", 4.0),
    ],
)
def test_named_and_fitted_to_the_noise(effect: str, severity: float) -> None:
    made = stack(np.random.default_rng([5, len(effect)]), effect, severity)
    sigma = made.noise["displacement"]
    assert sigma is not None
    report = diagnose(made, jobs=1)
    assert report.verdict == "missing_physics"
    assert names(report)[0] == effect
    assert report.location.outputs == ("displacement",)
    after = report.fit.fitted_rms["displacement"]
    before = report.fit.recalibrated_rms["displacement"]
    assert before**2 - after**2 > 0.9 * (before**2 - sigma**2)
    assert after > 0.93 * sigma


@pytest.mark.parametrize("kind", ["white", "coloured", "heavy", "quantised"])
@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_nothing_is_missing_in_controls(kind: str, shift: float) -> None:
    rng = np.random.default_rng([6, len(kind)])
    report = diagnose(stack(rng, "none", 0.0, kind=kind, shift=shift), jobs=1)
    assert report.verdict == ("recalibrate" if shift else "agrees")
    assert report.physics == ()
    limits = report.detection_limit["displacement"]
    assert len(limits) > 10
    assert all(0 < v < 20 * SIGMA for v in limits.values())


def test_gain_by_a_context_signal_is_unexplained_and_the_decoy_is_not_blamed() -> None:
    report = diagnose(stack(np.random.default_rng(8), "gain by load", 6.0), jobs=1)
    assert report.verdict == "unexplained"
    assert report.location.depends_on[0].signal == "load"


def test_two_axes_with_misalignment() -> None:
    rng = np.random.default_rng(9)
    fx, fy = wave(rng), wave(rng)
    inputs = {"specific_force_x": fx, "specific_force_y": fy}
    outputs = {
        "voltage_x": 2.5 + fx + 0.03 * fy + 0.003 * noise("white", rng),
        "voltage_y": 2.5 + fy + 0.003 * noise("white", rng),
    }
    twin = {"bias_V": 2.5, "scale_V_per_g": 1.0}
    report = diagnose(recording("accelerometer", inputs, outputs, twin), jobs=1)
    assert names(report)[0] == "misalignment"
    assert report.location.outputs[0] == "voltage_x"


def test_axis_with_cubic_spring() -> None:
    rng = np.random.default_rng(10)
    force = 8 * wave(rng, low=0.5, high=4.0)
    m, c, k, cubic = 0.5, 6.0, 400.0, 4e5
    x, v, dt = 0.0, 0.0, 1 / RATE / 8
    out = np.empty(N)
    fine = np.interp(np.arange(8 * N) / 8, np.arange(N), force)
    for i in range(N):
        out[i] = x
        for j in range(8):
            v += dt * (fine[8 * i + j] - c * v - k * x - cubic * x**3) / m
            x += dt * v
    linear = lsim(([1.0], [m, c, k]), force, np.arange(N) / RATE)[1]
    sigma = float(np.std(out - linear)) / 15
    y = out + sigma * noise("white", rng)
    twin = {"mass": m, "damping": c, "stiffness": k, "offset_force": 0.0}
    report = diagnose(recording("mechanical_axis", {"force": force}, {"position": y}, twin), jobs=1)
    assert names(report)[0] == "cubic_stiffness"


def test_same_recording_same_seed_same_answer_whatever_the_jobs() -> None:
    made = stack(np.random.default_rng(12), "backlash", 4.0)
    few = {n: EFFECTS[n] for n in ("backlash", "hysteresis", "creep", "dead_time")}.values()

    def body(jobs: int) -> str:
        report = diagnose(made, jobs=jobs, effects=few).to_json()
        report.pop("seconds")
        return json.dumps(report, sort_keys=True)

    assert body(1) == body(1)
    assert body(1) == body(2)


def test_report_has_the_keys_of_the_contract() -> None:
    report = diagnose(stack(np.random.default_rng(13), "mains_interference", 4.0), jobs=1).to_json()
    keys = {"format", "recording", "verdict", "summary", "location", "physics", "alternatives", "equivalent"}
    assert keys | {"detection_limit", "fit", "checks", "seconds"} <= set(report)
    assert {"outputs", "stage", "windows", "regime", "depends_on"} <= set(report["location"])
    found = report["physics"][0]
    assert {"name", "output", "stage", "confidence", "parameters", "equation", "source"} <= set(found)
    frequency = found["parameters"]["frequency_Hz"]
    assert frequency["ci95"][0] < 50.03 < frequency["ci95"][1]
    assert report["fit"]["held_out"] is True
    json.dumps(report, allow_nan=False)
