"""Sensors against closed forms and data-sheet figures."""

import cmath
import math

import numpy as np
import pytest

from sim_devices.config import EmulationConfig, InstrumentConfig, SensorConfig
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.kernel import STEP_S
from sim_devices.plant.sensors import accelerometer_V, field_gauss, rc_weights, sensor_unit

from .stand import PERFECT, Still, perfect

G = 9.80665


def test_rc_at_ten_hertz_is_0_833_and_minus_33_6_degrees():
    """Errata no. 27, of the discrete filter as the kernel runs it."""
    tau = 32e3 * 0.33e-6
    keep, before, after = rc_weights(tau, STEP_S)
    t = np.arange(40_000) * STEP_S
    u = np.exp(2j * math.pi * 10.0 * t)
    v = np.zeros_like(u)
    for k in range(1, len(u)):
        v[k] = keep * v[k - 1] + before * u[k - 1] + after * u[k]
    response = v[-1] / u[-1]
    exact = 1.0 / (1.0 + 2j * math.pi * 10.0 * tau)
    assert abs(response - exact) < 1e-5
    assert abs(response) == pytest.approx(0.833, abs=5e-4)
    assert math.degrees(cmath.phase(response)) == pytest.approx(-33.6, abs=0.1)


def test_rc_ramp_is_exact():
    keep, before, after = rc_weights(0.01, STEP_S)
    v = 0.0
    for k in range(1, 500):
        v = keep * v + before * (k - 1) * STEP_S + after * k * STEP_S
    t = 499 * STEP_S
    assert v == pytest.approx(t - 0.01 * (1.0 - math.exp(-t / 0.01)), rel=1e-10)


def test_perfect_sensors_read_the_physics():
    """x up: 1 g on a1x and a3x, 0 on the others; field, supply, TMP36."""
    frame = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).T  # body x points up
    instrument = Instrument(perfect(noise_ug_per_rtHz=0.0), 1, Still(frame))
    instrument.advance_to(5_000_000)
    one_g = 9.80131 / G
    expected = [2.5 + one_g * frame[2, axis] for axis in (0, 2, 1, 2, 0, 1)]
    assert frame[2, 0] in (1.0, -1.0)
    assert instrument.analog_V[:6] == pytest.approx(expected, abs=1e-12)
    assert instrument.analog_V[6] == pytest.approx(2.5, abs=1e-12)
    temperature_C = instrument.truth()["temperature_C"][-1]
    assert instrument.analog_V[7] == pytest.approx(0.5 + 0.01 * temperature_C, abs=1e-12)
    field = frame.T @ field_gauss(EmulationConfig().environment)
    assert instrument.magnetometer_V == pytest.approx(2.5 + field, abs=1e-12)
    instrument.strap("reset")
    assert instrument.magnetometer_V == pytest.approx(2.5 - field, abs=1e-12)
    instrument.strap("set")
    assert instrument.magnetometer_V == pytest.approx(2.5 + field, abs=1e-12)


def test_field_points_north_and_down():
    assert field_gauss(EmulationConfig().environment) == pytest.approx(
        [0.48 * math.cos(math.radians(66)), 0.0, -0.48 * math.sin(math.radians(66))]
    )


def test_strap_offset_does_not_turn_and_a_wrong_pulse_is_refused():
    instrument = Instrument(perfect(magnetometer_offset_V=0.01), 3, Still())
    up = instrument.magnetometer_V.copy()
    instrument.strap("reset")
    mean = 0.5 * (up + instrument.magnetometer_V) - 2.5
    assert np.all(np.abs(mean) > 0.0)
    assert np.abs(mean).max() < 0.05
    with pytest.raises(ValueError, match="'set' or 'reset'"):
        instrument.strap("flip")  # type: ignore[arg-type]


def test_ratiometric_to_supply():
    rows = sensor_unit(SensorConfig(**PERFECT), InstrumentConfig(), 1, STEP_S).accelerometers
    f = np.array([0.5 * G, 0.0, 0.0])
    assert accelerometer_V(rows[0], f, 5.0, 25.0) == pytest.approx(3.0)
    assert accelerometer_V(rows[0], f, 4.5, 25.0) == pytest.approx(2.7)
    assert accelerometer_V.py_func(rows[0], f, 4.5, 25.0) == pytest.approx(2.7)


def test_output_stops_at_1_7_g():
    rows = sensor_unit(SensorConfig(**PERFECT), InstrumentConfig(), 1, STEP_S).accelerometers
    for g, v in ((1.69, 4.19), (5.0, 4.2), (-5.0, 0.8)):
        assert accelerometer_V(rows[0], np.array([g * G, 0.0, 0.0]), 5.0, 25.0) == pytest.approx(v)


def test_clipping_is_counted_per_step_and_channel():
    config = perfect().model_copy(
        update={"environment": EmulationConfig().environment.model_copy(update={"gravity_m_s2": 20.0})}
    )
    instrument = Instrument(config, 1, Still())
    instrument.advance_to(3_000_000)
    assert instrument.clipped.tolist() == [0, 25, 0, 25, 0, 0]  # z up; 24 steps and the first instant


def test_accelerometer_noise_rms_and_density():
    """110 ug/rtHz behind the RC: D / (2 sqrt(tau)) = 0.535 mg rms (errata no. 25); flat density at 1 to 3 Hz."""
    instrument = Instrument(perfect(noise_ug_per_rtHz=110.0), 2, Still())
    v = np.empty((40_000, 6))
    for k in range(len(v)):
        instrument.advance_to((k + 1) * 1_000_000)
        v[k] = instrument.analog_V[:6]
    v -= v.mean(axis=0)
    tau = 32e3 * 0.33e-6
    assert v.std() * 1e3 == pytest.approx(110e-3 / (2.0 * math.sqrt(tau)), rel=0.02)
    power = np.mean(np.abs(np.fft.rfft(v, axis=0)) ** 2, axis=1) * 2e-3 / len(v)
    f = np.fft.rfftfreq(len(v), 1e-3)
    low = np.mean(power[(f > 1.0) & (f < 3.0)] * (1.0 + (2.0 * math.pi * f[(f > 1.0) & (f < 3.0)] * tau) ** 2))
    assert math.sqrt(low) * 1e6 == pytest.approx(110.0, rel=0.06)
    assert np.corrcoef(v[:-1, 0], v[1:, 0])[0, 1] == pytest.approx(0.910, abs=0.01)  # errata no. 21


def test_daq_noise_is_white():
    instrument = Instrument(perfect(daq_noise_uV=150.0, noise_ug_per_rtHz=0.0), 2, Still())
    v = np.empty((4000, 8))
    for k in range(len(v)):
        instrument.advance_to((k + 1) * 1_000_000)
        v[k] = instrument.analog_V
    assert v[:, :7].std(axis=0) * 1e6 == pytest.approx(150.0, rel=0.06)
    assert abs(np.corrcoef(v[:-1, 0], v[1:, 0])[0, 1]) < 0.06


def test_a_unit_has_data_sheet_errors_and_is_the_same_each_time():
    unit = sensor_unit(SensorConfig(), InstrumentConfig(), 7, STEP_S)
    again = sensor_unit(SensorConfig(), InstrumentConfig(), 7, STEP_S)
    other = sensor_unit(SensorConfig(), InstrumentConfig(), 8, STEP_S)
    assert np.array_equal(unit.accelerometers, again.accelerometers)
    assert not np.array_equal(unit.accelerometers, other.accelerometers)
    many = np.concatenate(
        [sensor_unit(SensorConfig(), InstrumentConfig(), s, STEP_S).accelerometers for s in range(60)]
    )
    assert many["bias_V"].std() == pytest.approx(0.025, rel=0.15)
    assert many["scale_V_per_g"].std() == pytest.approx(0.012, rel=0.15)
    nominal = np.eye(3)[[0, 2, 1, 2, 0, 1]]
    lean = np.degrees(np.arccos(np.sum(many["axis"].reshape(60, 6, 3) * nominal, axis=2)))
    assert np.sqrt(np.mean(lean**2)) == pytest.approx(0.5 * math.sqrt(2.0), rel=0.15)


def test_sensor_places_are_those_of_the_dissertation():
    """(2.54): P12 = (-d1, d1, 0), P23 = (d2, d2 - d1, d3), P13 = (d2 - d1, d2, d3)."""
    p = np.array(InstrumentConfig().positions_mm)
    d1, d2, d3 = 20.2, 14.3, 116.0
    assert p[1] - p[0] == pytest.approx([-d1, d1, 0.0])
    assert p[2] - p[1] == pytest.approx([d2, d2 - d1, d3])
    assert p[2] - p[0] == pytest.approx([d2 - d1, d2, d3])
    assert np.abs(p[:2, :2]).max() < 13.0  # inside the 26 mm box
