"""What stands for the samples inside events, and which loops a recording shows."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.hysteresis import one_loop, turning_points
from tools.mismatch.engine.residual import STAND_OFF, stand_ins
from tools.mismatch.engine.unexplained import about


def test_every_excused_row_has_a_usual_one_of_its_own_off_the_edge() -> None:
    excused = np.zeros(200, bool)
    excused[60:75] = excused[120:123] = True
    source = stand_ins(excused)
    assert np.array_equal(source[~excused], np.flatnonzero(~excused))
    assert not excused[source].any()
    assert len(set(source[60:75])) == 15
    assert source[60:75].max() == 60 - STAND_OFF - 1
    assert source[120:123].max() < 120 - STAND_OFF


def test_an_event_at_the_start_takes_what_comes_after() -> None:
    excused = np.zeros(50, bool)
    excused[:5] = True
    assert stand_ins(excused)[:5].min() >= 5


def test_turning_points_and_single_loops() -> None:
    t = np.arange(3000) / 1000
    sine = np.sin(2 * np.pi * 2 * t)
    keep = np.ones(t.size, bool)
    turns = turning_points(sine, 0.04)
    assert len(turns) == 12
    assert np.allclose(np.abs(turns), 1.0, atol=1e-4)
    assert one_loop(sine, keep)
    assert not one_loop(sine * (1 + t) / 4, keep)
    assert not one_loop(np.zeros(100), np.ones(100, bool))


def test_what_a_current_coupling_follows_is_the_current() -> None:
    assert "actuator_current" in about(EFFECTS["current_coupling"])
    assert about(EFFECTS["temperature_sensitivity"]) == ("temperature",)
