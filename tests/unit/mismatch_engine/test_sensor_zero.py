"""The zero of a sensor of differential equations: re-fitted, unless a constant of the equations is as good."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine.pose import prepared
from tools.mismatch.infer import diagnose

NOISE_C = 0.02


def block(equation: str, numbers: dict[str, float], ambient_degC: float, wrong_degC: float) -> dict[str, float]:
    """Re-fit a heated block, 23 or 20 degrees without heat, and return its parameters by name."""
    rng, n, dt, tau = np.random.default_rng(7), 3000, 0.002, 0.06
    u = np.repeat(rng.uniform(0.0, 2.0, n // 30), 30)
    x, y = ambient_degC, np.empty(n)
    for k in range(n):
        y[k] = x
        x = ambient_degC + 5.0 * u[k] + (x - ambient_degC - 5.0 * u[k]) * np.exp(-dt / tau)
    own: dict[str, object] = {"hold": "zero", "states": {"displacement": {"unit": "um", "start": 20.0}}}
    own |= {"equations": {"displacement": equation}, **numbers}
    measured = y + wrong_degC + rng.normal(0.0, NOISE_C, n)
    problem, _, base = prepared(recording("ode", {"command": u}, {"displacement": measured}, own), 0.3, 0, False)
    assert np.std(base.residual["displacement"][problem.held_rows]) < 1.05 * NOISE_C
    return {p.name: float(v) for p, v in zip(base.model.parameters, base.theta, strict=True)}


def test_a_sensor_that_is_wrong_by_a_constant_is_recalibrated() -> None:
    found = block("(gain * command + 20 - displacement) / tau", {"gain": 4.6, "tau": 0.055}, 20.0, 0.8)
    assert abs(found["displacement_offset"] - 0.8) < 3e-3
    assert abs(found["gain"] - 5.0) < 5e-3
    assert abs(found["tau"] - 0.06) < 2e-4


def test_a_constant_that_the_equations_have_is_left_to_them() -> None:
    numbers = {"gain": 4.6, "tau": 0.055, "ambient": 20.0}
    found = block("(gain * command + ambient - displacement) / tau", numbers, 23.0, 0.0)
    assert abs(found["ambient"] - 23.0) < 0.01
    assert abs(found["displacement_offset"]) < 0.01


def test_an_amplifier_that_loses_the_mean_has_a_zero_of_its_own() -> None:
    """Behind columns, too: no parameter of the simulation that made them takes its response to a constant away."""
    rng, rate_hz, tau_s = np.random.default_rng(3), 50.0, 1.9
    x = 300.0 + 60.0 * np.repeat(rng.uniform(-1.0, 1.0, 60), 50) + 5.0 * wave(rng, 3000)
    keep = (2 * tau_s * rate_hz - 1) / (2 * tau_s * rate_hz + 1)
    passed = np.asarray(lfilter([(1 + keep) / 2, -(1 + keep) / 2], [1.0, -keep], x - x[0]))
    y = 0.985 * passed + 0.6 + 0.3 * rng.standard_normal(x.size)
    rec = recording("columns", {"simulated_level": x}, {"level": y}, {}, rate_hz=rate_hz)
    report = diagnose(rec, jobs=1, effects=[EFFECTS[n] for n in ("ac_coupling", "thermal_drift", "creep")])
    assert (report.verdict, [p.name for p in report.physics]) == ("missing_physics", ["ac_coupling"])
    assert abs(report.physics[0].parameters["time_constant_s"].value - tau_s) < 0.01
