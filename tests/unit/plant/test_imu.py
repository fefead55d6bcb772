"""The inertial sensing elements: rigid body, one pole, noise, and what the seed draws."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.config import EmulationConfig
from sim_devices.plant import body_motion, imu
from sim_devices.plant.body_motion import BodyMotion, Mount, rotation
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.imu import BMX055_SPEC, LSM6DS3_SPEC, MPU6050_SPEC, Imu
from sim_devices.plant.instrument import Instrument

MS = 1_000_000
SPIN = BodyMotion(
    np.eye(3),
    np.array([0.0, 0.0, 2.0]),
    np.array([0.0, 0.0, 9.8]),
    np.array([0.0, 0.0, 5.0]),
    field_world_uT=np.array([20.0, 0.0, -40.0]),
)


def test_mount_moves_and_turns() -> None:
    """At 0.1 m along x: centripetal -w^2 r along x, tangential alpha r along y; then seen from a turned sensor."""
    f, w = Mount(np.array([0.1, 0.0, 0.0])).felt(SPIN)
    assert f == pytest.approx([-0.4, 0.5, 9.8])
    f, w = Mount(np.array([0.1, 0.0, 0.0]), rotation((180.0, 0.0, 0.0))).felt(SPIN)
    assert f == pytest.approx([-0.4, -0.5, -9.8])
    assert w == pytest.approx([0.0, 0.0, -2.0])
    assert Mount(turn=rotation((0.0, 0.0, 90.0))).field_uT(SPIN) == pytest.approx([0.0, -20.0, -40.0])


def test_compiled_kernels_and_their_python_twins() -> None:
    rng = np.random.default_rng(3)
    vectors = [rng.standard_normal(3) for _ in range(5)]
    turn = rotation((10.0, 20.0, 30.0))
    outs = [np.zeros(3) for _ in range(4)]
    body_motion._felt(tuple(vectors[:4]), (vectors[4], turn), outs[0], outs[1])
    body_motion._felt.py_func(tuple(vectors[:4]), (vectors[4], turn), outs[2], outs[3])
    assert outs[0] == pytest.approx(outs[2])
    assert outs[1] == pytest.approx(outs[3])
    a, b = np.ones((4, 3)), np.ones((4, 3))
    weights = (0.5, 0.2, 0.3, 0.1, 0.9, 0.01)
    arguments = (turn, *vectors[:3], rng.standard_normal((3, 3))), (*vectors[3:], 2.0)
    draw = rng.standard_normal(6)
    imu._triad_step(*arguments, a, draw, weights, outs[0])
    imu._triad_step.py_func(*arguments, b, draw, weights, outs[2])
    assert outs[0] == pytest.approx(outs[2])
    assert a == pytest.approx(b)


@pytest.mark.parametrize("step_ns", [MS, 5 * MS])
def test_one_pole_of_a_ramp_is_exact_at_any_rate(step_ns: int) -> None:
    """From 1 to 2 m/s^2 linearly over one interval, as between samples; then towards 2 with the time constant."""
    level = [1.0]

    def source(t_ns: int) -> BodyMotion:
        return BodyMotion(np.eye(3), np.zeros(3), np.array([0.0, 0.0, level[0]]))

    accelerometer = Imu(MPU6050_SPEC, source, errors=0.0, noise=0.0).accelerometer
    accelerometer.sample(0, 10.0)
    level[0] = 2.0
    accelerometer.sample(step_ns, 10.0)
    tau_s, t_s = 1 / (2 * np.pi * 10.0), step_ns * 1e-9
    after_ramp = 2 - tau_s / t_s * (1 - np.exp(-t_s / tau_s))
    later = accelerometer.sample(step_ns + 10 * MS, 10.0)[2]
    assert later == pytest.approx(2 - (2 - after_ramp) * np.exp(-0.01 / tau_s), rel=1e-9)


@pytest.mark.parametrize(("spec", "mg"), [(MPU6050_SPEC, 0.4), (LSM6DS3_SPEC, 0.09), (BMX055_SPEC, 0.15)])
def test_noise_of_each_chip(spec: imu.ImuSpec, mg: float) -> None:
    """Erat 2018, Table 5.1: density 400, 90, 150 ug/rtHz."""
    chip = Imu(spec, lambda t: SPIN, errors=0.0)
    values = np.array([chip.accelerometer.sample(k * 20 * MS, 50.0)[0] for k in range(3000)])
    assert np.std(values) == pytest.approx(mg * 9.80665e-3 * np.sqrt(50.0), rel=0.05)


def test_units_differ_by_name_and_stay_within_the_limits() -> None:
    bias = [Imu(MPU6050_SPEC, lambda t: SPIN, name=f"imu{k}").gyroscope.unit.bias for k in range(40)]
    dps = np.degrees(bias)
    assert np.abs(dps).max() <= 20.0
    assert 3.5 < dps.std() < 6.5
    again = Imu(MPU6050_SPEC, lambda t: SPIN, name="imu0").gyroscope.unit.bias
    assert np.array_equal(again, bias[0])


def test_bias_follows_temperature_and_g() -> None:
    warm = [25.0, 1.0]

    def source(t_ns: int) -> BodyMotion:
        return BodyMotion(np.eye(3), np.zeros(3), np.array([0, 0, 9.80665 * warm[1]]), temperature_C=warm[0])

    chip = Imu(MPU6050_SPEC, source, noise=0.0, seed=5)
    unit = chip.gyroscope.unit
    cold = chip.gyroscope.sample(0, 100.0)
    warm[0] = 45.0
    chip.gyroscope.sample(10**9, 100.0)
    hot = chip.gyroscope.sample(2 * 10**9, 100.0)
    assert hot - cold == pytest.approx(20.0 * unit.bias_per_K, abs=1e-12)
    warm[1] = -1.0
    chip.gyroscope.sample(3 * 10**9, 100.0)
    turned = chip.gyroscope.sample(4 * 10**9, 100.0)
    assert turned - hot == pytest.approx(-2 * 9.80665 * unit.per_m_s2[:, 2], abs=1e-12)


def test_on_the_instrument_it_feels_what_the_accelerometers_feel() -> None:
    config = EmulationConfig()
    instrument = Instrument(config, 1, SyntheticHand(config.hand, 1), quiet=True)
    instrument.advance_to(500 * MS)
    state = instrument._state[0]
    for location in range(3):
        position = instrument.unit.sensors.positions_m[location]
        f, w = Mount(position).felt(instrument.motion())
        assert f == pytest.approx(state["specific_force"][location], abs=1e-9)
        assert w == pytest.approx(state["rate"], abs=1e-12)
