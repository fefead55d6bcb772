"""Changes that a heal has to find: a warm amplifier, a loose mount, a slow converter."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sim_devices.config import (
    AmplifierConfig,
    DaqConfig,
    EmulationConfig,
    EnvironmentConfig,
    ManipulatorConfig,
    SensorConfig,
)
from sim_devices.plant.hand import SyntheticHand
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.lab_motion import SHAKES_HZ, measure_motion
from sim_devices.plant.lab_tip import measure_tip
from sim_devices.plant.manipulator import take_up

from .stand import PERFECT, Still
from .test_instrument import LINEAR, MS

STEP_NS = MS // 8


def linear(**tables) -> EmulationConfig:
    return LINEAR.model_copy(update=tables)


def volts(config: EmulationConfig, times_ns: list[int]) -> np.ndarray:
    unit = Instrument(config, 1, SyntheticHand(config.hand, 1), quiet=True)
    out = []
    for t in times_ns:
        unit.advance_to(t)
        out.append(unit.analog_V.copy())
    return np.array(out)


@pytest.mark.parametrize("delay_ms", [0.05, 0.125, 1.7, 10.0])
def test_the_converter_shows_the_accelerometers_as_they_were(delay_ms: float) -> None:
    """Between steps the delayed course is interpolated, which moves it by far less than a count."""
    times = [600 * MS + k * MS // 3 for k in range(60)]
    config = EmulationConfig(sensors=SensorConfig(**PERFECT))
    late = volts(config.model_copy(update={"daq": DaqConfig(delay_ms=delay_ms)}), times)
    as_they_were = volts(config, [t - round(delay_ms * MS) for t in times])
    assert np.ptp(late[:, :6], axis=0).min() > 1e-4
    np.testing.assert_allclose(late[:, :6], as_they_were[:, :6], atol=2e-7)
    np.testing.assert_array_equal(late[:, 6], volts(config, times)[:, 6])


def test_a_delayed_run_does_not_depend_on_how_time_is_cut() -> None:
    config = EmulationConfig(daq=DaqConfig(delay_ms=2.3))
    every, coarse = ([k * step for k in range(step, 200 * MS // step)] for step in (STEP_NS, MS))
    assert np.array_equal(
        volts(config, [k for k in every if k % MS == 0]), volts(config, [k for k in coarse if k % MS == 0])
    )


def test_the_lab_sees_the_delay_too() -> None:
    shaken = [
        measure_motion(EmulationConfig(daq=DaqConfig(delay_ms=ms)), "shake", 4.0)[0]["analog_V"] for ms in (0.0, 3.0)
    ]
    now, late = (np.fft.rfft(x[1000:, :6] - x[1000:, :6].mean(axis=0), axis=0) for x in shaken)
    for k, hz in enumerate(SHAKES_HZ):
        line = round(hz * 3.0)
        turned = np.angle(np.sum(late[line] * np.conj(now[line])))
        assert turned == pytest.approx(-2 * np.pi * hz * 3e-3, abs=0.03), k


def test_a_delay_is_refused_where_it_is_not_emulated() -> None:
    axis = {"input": 7, "position_mm": (0, 0, 0), "direction": (0, 0, 1)}
    with pytest.raises(ValidationError, match="more_axes"):
        EmulationConfig.model_validate({"daq": {"delay_ms": 1.0}, "more_axes": [axis]})
    with pytest.raises(ValidationError, match="delay_ms"):
        EmulationConfig.model_validate({"daq": {"delay_ms": 11.0}})


def test_the_amplifiers_gain_follows_the_room() -> None:
    """At 35 degC and 0.2 % per kelvin the amplifier puts out 2 % more, from the first instant on."""
    fast = LINEAR.amplifier.model_copy(update={"gain_per_K": 2e-3})
    room = EnvironmentConfig(ambient_C=35.0, warm_up_K=0.0)
    unit = Instrument(linear(amplifier=fast, environment=room), 1, Still(), quiet=True)
    assert unit.stack_V == pytest.approx([51.0] * 3, abs=1e-9)
    unit.set_demand_V(0, 80.0, 0)
    unit.advance_to(20 * MS)
    assert unit.stack_V == pytest.approx([81.6, 51.0, 51.0], abs=1e-6)
    assert AmplifierConfig().gain_per_K == 0.0


def test_play_swallows_the_travel_after_a_reversal() -> None:
    seat, out = np.zeros(3), []
    for x in (0.0, 1.0, 3.0, 2.5, 1.0, 0.0):
        e = np.array([x, 0.0, 0.0])
        take_up(2.0, seat, e)
        out.append(float(e[0]))
    assert out == [0.0, 0.0, 2.0, 2.0, 2.0, 1.0]


def test_a_loose_mount_shows_at_the_tip_and_in_the_lab() -> None:
    loose = LINEAR.manipulator.model_copy(update={"mount_play_um": 4.0})
    firm, slack = (Instrument(c, 1, Still(), quiet=True) for c in (LINEAR, linear(manipulator=loose)))
    for ms in range(1500):
        for channel in range(3):
            demand = 50.0 + 20.0 * np.sin(2e-3 * np.pi * ms) * np.cos(2.1 * channel)
            for unit in (firm, slack):
                unit.set_demand_V(channel, float(demand), ms * MS)
    away = 1e6 * (slack.truth()["tip_m"] - firm.truth()["tip_m"])
    moved = np.ptp(firm.truth()["tip_m"], axis=0)
    assert np.abs(away).max() == pytest.approx(2.0, rel=1e-3)
    assert np.argmax(moved) in set(np.argmax(np.abs(away), axis=1))
    plain, played = (
        measure_tip(c, 10.0)
        for c in (EmulationConfig(), EmulationConfig(manipulator=ManipulatorConfig(mount_play_um=4.0)))
    )
    assert np.array_equal(plain["stroke_um"], played["stroke_um"])
    assert np.abs(played["tip_um"] - plain["tip_um"]).max() == pytest.approx(2.0, rel=1e-6)
