"""Two effects in one recording: what hides one of them, and what must not be taken for a second one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import RATE, recording, wave
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Recording

N = 1500
AXES = "xyz"


def accelerometer(change: np.ndarray, force: np.ndarray, **more: object) -> Recording:
    """Three axes of 1 V/g about 2.5 V with ``change`` (n, 3) on top and noise of 2 mV."""
    noise = 2e-3 * np.random.default_rng(9).standard_normal(force.shape)
    volts = 2.5 + force + change + noise
    return recording(
        "accelerometer",
        {f"specific_force_{a}": force[:, i] for i, a in enumerate(AXES)},
        {f"voltage_{a}": volts[:, i] for i, a in enumerate(AXES)},
        {"bias_V": 2.5, "scale_V_per_g": 1.0},
        noise={f"voltage_{a}": 2e-3 for a in AXES},
        **more,  # pyright: ignore[reportArgumentType]
    )


def forces(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([wave(rng, N) for _ in AXES])


def test_a_lag_that_all_channels_share_is_one_effect_and_no_dead_time() -> None:
    f = forces(1)
    a = np.exp(-1 / RATE / 5e-3)
    late = f.copy()
    for i in range(1, N):
        late[i] = a * late[i - 1] + (1 - a) * f[i]
    names = ("first_order_lag", "dead_time", "channel_delay")
    report = diagnose(accelerometer(late - f, f), effects=[EFFECTS[n] for n in names], jobs=1)
    assert [p.name for p in report.physics] == ["first_order_lag"]
    assert set(report.physics[0].outputs) == {f"voltage_{a}" for a in AXES}


def test_a_walk_does_not_hide_a_curve_and_a_recorded_temperature() -> None:
    f = forces(2)
    t = np.arange(N) / RATE
    warm = 25 + 4 * np.sin(2 * np.pi * 0.6 * t) + 2 * t
    change = np.zeros((N, 3))
    change[:, 2] = 0.02 * (warm - 25) * (1 + f[:, 2]) + 0.12 * f[:, 2] ** 2
    names = ("random_walk", "temperature_sensitivity", "static_nonlinearity")
    recorded = accelerometer(change, f, context={"temperature": warm})
    report = diagnose(recorded, effects=[EFFECTS[n] for n in names], jobs=1)
    assert {p.name for p in report.physics} == {"temperature_sensitivity", "static_nonlinearity"}


def test_no_vibration_at_the_frequency_of_the_mains() -> None:
    f = forces(5)
    t = np.arange(N) / RATE
    change = np.zeros((N, 3))
    change[:, 0] = 0.02 * np.sin(2 * np.pi * (60 * t + 0.03 * np.sin(0.9 * t)))
    names = ("mains_interference", "vibration")
    report = diagnose(accelerometer(change, f), effects=[EFFECTS[n] for n in names], jobs=1)
    assert [p.name for p in report.physics] == ["mains_interference"]


def test_a_turned_package_on_a_turning_body_is_misalignment() -> None:
    rng = np.random.default_rng(6)
    w = 4 * np.column_stack([wave(rng, N, high=3.0) for _ in AXES])
    f = np.array([0, 0, 9.8]) + 2 * np.column_stack([wave(rng, N) for _ in AXES])
    r = np.array([0.09, -0.05, 0.06])
    alpha = np.gradient(w, 1 / RATE, axis=0, edge_order=2)
    there = f + np.cross(alpha, r) + np.cross(w, np.cross(w, r))
    turned = there + np.cross([4e-3, -6e-3, 5e-3], there)
    # the twin has no centripetal term, so that one is missing, too
    outputs = {f"accel_1{a}": turned[:, i] + 3e-3 * rng.standard_normal(N) for i, a in enumerate(AXES)}
    inputs = {f"specific_force_{a}": f[:, i] for i, a in enumerate(AXES)}
    inputs |= {f"angular_rate_{a}": w[:, i] for i, a in enumerate(AXES)}
    made = recording("accelerometer_cluster", inputs, outputs, {"positions_m": {"1": r.tolist()}})
    made = replace(made, unit={**made.unit, **dict.fromkeys(inputs, "m/s^2"), **dict.fromkeys(outputs, "m/s^2")})
    names = ("centripetal_acceleration", "misalignment", "sensor_position_error", "dead_zone")
    report = diagnose(made, effects=[EFFECTS[n] for n in names], jobs=1)
    assert [p.name for p in report.physics] == ["centripetal_acceleration", "misalignment"]
    turn = report.physics[1].parameters
    assert [turn[f"rotation_{a}"].value for a in AXES] == pytest.approx([-4, 6, -5], rel=0.1)


def test_a_step_beside_a_curve_is_no_late_warm_up_and_no_walk() -> None:
    f = forces(7)
    change = np.zeros((N, 3))
    change[:, 1] = 0.05 * f[:, 1] ** 2
    change[N // 3 :, 1] += 0.04
    names = ("step_shift", "thermal_drift", "random_walk", "static_nonlinearity")
    report = diagnose(accelerometer(change, f), effects=[EFFECTS[n] for n in names], jobs=1)
    assert {p.name for p in report.physics} == {"step_shift", "static_nonlinearity"}
