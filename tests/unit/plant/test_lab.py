"""The lab's measurements: the same unit as the bench, readable by everybody, wrong orders refused."""

import tomllib

import numpy as np
import pytest

from sim_devices.config import EmulationConfig, SensorConfig
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.lab import (
    drive_profile,
    drive_stack,
    main,
    measure_piezo,
    measure_tumble,
    tumble_attitudes,
)
from sim_devices.plant.stack import drive_channel, stack_unit
from sim_devices.plant.unit import build_unit

from .stand import Still


def test_the_stack_in_the_lab_is_the_one_in_the_instrument():
    """Same demands, same stroke: lab bench against the instrument's own truth."""
    config = EmulationConfig(unit=4, seed=4)
    unit = Instrument(config, 4, Still(), quiet=True)
    demand = drive_profile("sine", 20.0, 0.2, 40.0, 4)
    for k, volts in enumerate(demand):
        unit.set_demand_V(1, volts, k * 1_000_000)
    unit.advance_to(200_000_000)
    columns, _ = measure_piezo(config, 1, "sine", 20.0, 0.2, 40.0)
    difference_um = columns["displacement_um"] - unit.truth()["stroke_m"][:200, 1] * 1e6
    assert difference_um.std() == pytest.approx(0.07, rel=0.2)
    assert abs(difference_um.mean()) < 0.02
    assert np.array_equal(stack_unit(config.stack, 4, 1).weight, build_unit(config, 4).stacks[1].weight)


@pytest.mark.parametrize("profile", ["sawtooth", "sine", "tremor"])
def test_profiles_stay_within_their_swing_and_start_at_neutral(profile):
    volts = drive_profile(profile, 9.0, 4.0, 30.0, 1)
    assert np.ptp(volts) == pytest.approx(60.0, rel=0.2)
    assert np.abs(volts - 50.0).max() <= 30.0 + 1e-9
    assert volts[0] == pytest.approx(50.0, abs=1e-9)


def test_piezo_recording_on_disk(tmp_path, capsys):
    assert main(["piezo", "--out", str(tmp_path), "--seconds", "0.5", "--profile", "sawtooth", "--axis", "2"]) == 0
    table = tomllib.loads((tmp_path / "recording.toml").read_text())
    assert table["twin"]["kind"] == "piezo_stack"
    assert [c["signal"] for c in table["channels"]] == ["command", "displacement", "temperature"]
    with np.load(tmp_path / table["data"]) as data:
        assert {c["column"] for c in table["channels"]} == set(data.files)
        assert len(data["command_V"]) == 500
    assert capsys.readouterr().out == ""
    again = tmp_path / "again"
    main(["piezo", "--out", str(again), "--seconds", "0.5", "--profile", "sawtooth", "--axis", "2"])
    with np.load(tmp_path / "data.npz") as a, np.load(again / "data.npz") as b:
        assert all(np.array_equal(a[k], b[k]) for k in a.files)


def test_tumble_gives_back_the_units_bias_and_scale():
    """A straight-line fit over the attitudes finds the true axes; what is left is the cross-axis curvature."""
    config = EmulationConfig(unit=6, seed=6, sensors=SensorConfig(supply_wander_mV=0.0))
    columns, _ = measure_tumble(config, 60, 5.0)
    up = columns["attitude"][:, 2, :]  # world z in body axes
    design = np.column_stack([up * config.environment.gravity_m_s2 / 9.80665, np.ones(60)])
    unit = build_unit(config, 6).sensors
    for i in range(6):
        found, *_ = np.linalg.lstsq(design, columns["analog_V"][:, i], rcond=None)
        a = unit.accelerometers[i]
        assert found[:3] / np.linalg.norm(found[:3]) == pytest.approx(a["axis"], abs=0.02)
        assert np.linalg.norm(found[:3]) == pytest.approx(a["scale_V_per_g"] * unit.supply_V / 5.0, abs=0.02)
        left = columns["analog_V"][:, i] - design @ found
        assert left.std() < 5e-3
    assert np.allclose(columns["analog_V"][:, 6], unit.supply_V * unit.divider, atol=2e-3)


def test_attitudes_are_rotations_that_cover_the_sphere():
    angles, frames = tumble_attitudes(50)
    assert angles.shape == (50, 2)
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3))
    up = frames[:, 2, :]
    assert np.abs(up.mean(axis=0)).max() < 0.05
    assert np.linalg.eigvalsh(up.T @ up / 50).min() > 0.25


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["piezo", "--rate-hz", "900"], "rate 900 Hz"),
        (["piezo", "--axis", "3"], "stacks are 0, 1 and 2"),
        (["piezo", "--amplitude-V", "80"], "amplitude 80 V"),
        (["piezo", "--seconds", "0.01"], "no full cycle"),
        (["piezo", "--seconds", "1e9"], "an hour"),
        (["tumble", "--positions", "3"], "12 to 10000"),
        (["tumble", "--seconds", "nan"], "0.01 to 60 s"),
        (["piezo", "--bench", "missing.toml"], "missing.toml"),
        (["piezo", "--unit", "-1"], "unit"),
    ],
)
def test_wrong_orders_end_with_status_2_and_write_nothing(tmp_path, capsys, arguments, message):
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_unit_of_a_bench_file(tmp_path, capsys):
    bench = tmp_path / "bench.toml"
    bench.write_text("[emulation]\nseed = 3\n[emulation.stack]\nslip_summ = 1\n")
    assert main(["piezo", "--bench", str(bench), "--out", str(tmp_path / "out")]) == 2
    assert "stack.slip_summ" in capsys.readouterr().err


def test_compiled_and_python_agree():
    config = EmulationConfig()
    volts = np.linspace(40.0, 60.0, 20)
    results = []
    for function in (drive_stack, drive_stack.py_func):
        params, state = drive_channel(stack_unit(config.stack, 1, 0), config.amplifier, 1.25e-4, 25.0)
        x, v = np.empty(20), np.empty(20)
        function(params, state, volts, 25.0, 8, (x, v))
        results.append((x, v))
    assert np.allclose(results[0], results[1], rtol=1e-12, atol=0.0)


def test_steps_are_small_held_and_read_at_eight_kilohertz():
    columns, descriptor = measure_piezo(EmulationConfig(), 0, "steps", 10.0, 0.5, 40.0)
    volts = columns["command_V"]
    assert tomllib.loads(descriptor)["rate_hz"] == 8000.0
    assert len(volts) == 4000
    assert sorted(set(volts)) == [48.0, 52.0]
    assert np.count_nonzero(np.diff(volts)) == 9
    # 650 Hz: the step overshoots and the ring is there to be seen
    after = columns["displacement_um"][400:420] - columns["displacement_um"][380:400].mean()
    assert np.abs(after).max() > 1.3 * abs(
        columns["displacement_um"][700:790].mean() - columns["displacement_um"][380:400].mean()
    )
