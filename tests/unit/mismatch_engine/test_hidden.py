"""What a family, a tail or a name hides: a second effect, a burst, a walk, something that has no name."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import bouc_wen, named, recording, wave
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.unexplained import lead
from tools.mismatch.infer import diagnose
from tools.mismatch.simulate_sites import sites
from tools.mismatch.twins.make import make

STACK = {"gain_um_per_V": 0.125, "offset_um": 0.0}


def stack(y, u, **more):
    return recording("piezo_stack", {"command": u}, {"displacement": y}, STACK, **more)


def found(rec, *names: str) -> set[str]:
    return named(rec, names)


def test_no_free_play_where_the_chain_has_no_mechanics() -> None:
    rng = np.random.default_rng(1)
    b = 40 * wave(rng, 400)
    rec = recording("magnetometer", {"field_x": b}, {"voltage_x": 2.5 + 0.01 * b}, {"scale_V_per_uT": 0.01})
    twin = make(rec)
    assert not sites(twin, rec, EFFECTS["backlash"])
    assert sites(twin, rec, EFFECTS["hysteresis"])
    moved = stack(0.125 * b, b)
    assert sites(make(moved), moved, EFFECTS["backlash"])


def test_a_delay_behind_a_loop_is_found_whatever_the_length_of_the_record() -> None:
    said = []
    for n in (2500, 6000):
        rng = np.random.default_rng(3)
        u = 50 + 40 * wave(rng, n)
        late = np.concatenate([u[:1], u[:1], u[:-2]])
        y = 0.125 * late + 0.8 * bouc_wen(late, 20.0)
        said.append(found(stack(y + 0.03 * rng.standard_normal(n), u), "hysteresis", "dead_time"))
    assert said == [{"hysteresis", "dead_time"}] * 2


def test_a_walk_that_nobody_can_predict_is_named_by_its_own_test() -> None:
    rng = np.random.default_rng(11)
    u = 50 + 40 * wave(rng, 4000)
    y = 0.125 * u + 0.02 * rng.standard_normal(u.size) + 0.01 * np.cumsum(rng.standard_normal(u.size))
    assert found(stack(y, u), "random_walk", "creep") == {"random_walk"}
    hum = 0.3 * np.sin(2 * np.pi * 40 * np.arange(u.size) / 500.0 + np.cumsum(0.05 * rng.standard_normal(u.size)))
    assert found(stack(0.125 * u + 0.02 * rng.standard_normal(u.size) + hum, u), "random_walk") == set()


def test_a_gain_that_follows_a_signal_away_from_its_mean_is_seen_in_full() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    u = np.repeat(rng.uniform(20, 80, 20), n // 20)
    load = 5 + np.repeat(rng.uniform(0, 1, 40), n // 40) * np.linspace(0.2, 1, n)
    y = 0.125 * u * (1 + 0.05 * (load - 5)) + 0.01 * rng.standard_normal(n)
    problem, _, base = prepared(stack(y, u, context={"load": load}), 0.3, 0, False)
    first = lead(problem, base, "displacement")
    assert first is not None
    assert first.signal == "load"
    assert first.share > 0.6


def test_rightly_named_steps_are_not_unexplained_for_the_readings_beside_their_edges() -> None:
    rng = np.random.default_rng(9)
    u = 50 + 30 * wave(rng, 2500)
    step = 0.3
    y = np.floor((0.125 * u + 0.02 * rng.standard_normal(u.size)) / step) * step
    said = diagnose(stack(y, u, noise={"displacement": 0.02}), effects=[EFFECTS["quantization"]], jobs=1)
    assert (said.verdict, [p.name for p in said.physics]) == ("missing_physics", ["quantization"])
    # more than the edges account for
    assert said.fit.fitted_rms["displacement"] > 2 * 0.02


def test_a_gain_on_a_reading_of_several_inputs_follows_its_context() -> None:
    rng = np.random.default_rng(12)
    n = 3000
    f = {f"specific_force_{a}": 3 * wave(rng, n) for a in "xyz"}
    w = {f"angular_rate_{a}": 3 * wave(rng, n) for a in "xyz"}
    r = np.array([0.09, 0.02, 0.03])
    rate = np.stack([w[f"angular_rate_{a}"] for a in "xyz"], axis=1)
    turned = np.cross(np.gradient(rate, 1 / 500.0, axis=0), r)[:, 2]
    pressure = 1e5 + 1e3 * np.interp(np.arange(n), np.linspace(0, n, 12), rng.uniform(-1, 1, 12))
    y = f["specific_force_z"] + turned
    y = y * (1 + 0.1 * np.sin((pressure - 1e5) / 300.0)) + 0.1 * rng.standard_normal(n)
    rec = recording("accelerometer_cluster", f | w, {"accel_1z": y}, {"positions_m": {"1": r.tolist()}},
                    context={"pressure": pressure})  # fmt: skip
    problem, _, base = prepared(rec, 0.3, 0, False)
    first = lead(problem, base, "accel_1z")
    assert first is not None
    assert (first.signal, first.feature) == ("pressure", "cross product")


def test_what_a_louder_output_hid_is_looked_at_again() -> None:
    rng = np.random.default_rng(7)
    n = 2400
    t = np.arange(n) / 100.0
    f = np.column_stack([np.sin(0.9 * t + 2 * np.sin(0.31 * t + k)) for k in range(3)])
    turned = {"x": 0.0012 * f[:, 1], "y": 0.002 * f[:, 2], "z": 0.08 * f[:, 0] - 0.05 * f[:, 1]}
    inputs = {f"specific_force_{a}": f[:, i] for i, a in enumerate("xyz")}
    outputs = {
        f"voltage_{a}": 1.5 + 0.3 * (f[:, i] + turned[a]) + 0.0003 * rng.standard_normal(n) for i, a in enumerate("xyz")
    }
    parameters: dict[str, object] = {"bias_V": 1.5, "scale_V_per_g": 0.3}
    rec = recording("accelerometer", inputs, outputs, parameters, rate_hz=100.0)
    rivals = ("random_walk", "scale_factor_variation", "cross_axis_nonlinearity", "creep", "hysteresis", "resonance")
    assert found(rec, "misalignment", *rivals) == {"misalignment"}


def test_a_bias_with_the_fourth_power_of_another_axis_is_one_effect() -> None:
    """The square alone leaves a curve that looked like one of the own axis."""
    rng = np.random.default_rng(9)
    x, y = wave(rng), wave(rng)
    volts = 1.65 + 0.3 * x + 0.02 * y**2 + 0.01 * y**4
    outputs = {"voltage_x": volts + 2e-4 * rng.standard_normal(x.size)}
    inputs = {"specific_force_x": x, "specific_force_y": y}
    rec = recording("accelerometer", inputs, outputs, {"bias_V": 1.65, "scale_V_per_g": 0.3})
    names = ("cross_axis_nonlinearity", "static_nonlinearity", "scale_factor_variation")
    report = diagnose(rec, jobs=1, effects=[EFFECTS[n] for n in names])
    (found,) = report.physics
    assert found.name == "cross_axis_nonlinearity"
    assert found.parameters["k_yyyy"].value == pytest.approx(0.01, rel=0.05)
