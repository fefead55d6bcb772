"""Mapping of the card's angles to the field of view against the closed forms of Erat 2018, section 6.2."""

from __future__ import annotations

import math

import pytest
from pydantic import ValidationError

from firmware_py.endoscope.control import INACTIVE, MOVE, ZOOM, ControlConfig, EndoscopeControl, View

DT_S = 0.01
BIG = {"width_px": 4000.0, "height_px": 4000.0}


def test_position_mapping_without_filter_is_gain_times_turn() -> None:
    control = EndoscopeControl(ControlConfig(response_s=0.0, **BIG))
    control.step(3.0, -2.0, MOVE, DT_S)  # any orientation is zero
    view = control.step(13.0, -7.0, MOVE, DT_S)
    assert view == View(2000.0 + 80.0, 2000.0 - 40.0, 120.0)
    assert control.turn_deg == (10.0, -5.0)


@pytest.mark.parametrize("tau_s", [0.1, 1.0, 2.0, 10.0])
def test_step_response_is_the_first_order_one(tau_s: float) -> None:
    control = EndoscopeControl(ControlConfig(response_s=tau_s, **BIG))
    control.step(0.0, 0.0, MOVE, DT_S)
    n = 200
    for _ in range(n):
        view = control.step(10.0, 0.0, MOVE, DT_S)
    # (6.3) is the implicit rule: exactly 1 - a^n, and 1 - exp(-t/tau) as dt goes to 0
    a = tau_s / (tau_s + DT_S)
    assert view.x - 2000.0 == pytest.approx(80.0 * (1.0 - a**n), abs=1e-9)
    assert view.x - 2000.0 == pytest.approx(80.0 * (1.0 - math.exp(-n * DT_S / tau_s)), abs=80.0 * DT_S / tau_s)


def test_speed_mapping_integrates() -> None:
    control = EndoscopeControl(ControlConfig(mapping="speed", response_s=0.0, **BIG))
    control.step(0.0, 0.0, MOVE, DT_S)
    for _ in range(100):
        view = control.step(5.0, -10.0, MOVE, DT_S)
    assert view.x - 2000.0 == pytest.approx(8.0 * 5.0 * 1.0)
    assert view.y - 2000.0 == pytest.approx(-8.0 * 10.0 * 1.0)


def test_zoom_changes_the_size_alone_and_only_by_psi() -> None:
    control = EndoscopeControl(ControlConfig(response_s=0.0))
    start = control.step(0.0, 0.0, ZOOM, DT_S)
    view = control.step(4.0, 30.0, ZOOM, DT_S)
    assert (view.x, view.y, view.size) == (start.x, start.y, 120.0 + 32.0)
    assert control.step(90.0, 0.0, ZOOM, DT_S).size == 240.0
    assert control.step(-90.0, 0.0, ZOOM, DT_S).size == 40.0


def test_inactive_holds_and_each_activation_begins_where_the_view_is() -> None:
    control = EndoscopeControl(ControlConfig(response_s=0.5, **BIG))
    control.step(0.0, 0.0, MOVE, DT_S)
    for _ in range(30):
        moved = control.step(20.0, 0.0, MOVE, DT_S)
    assert control.step(-50.0, 40.0, INACTIVE, DT_S) == moved
    # errata no. 120: the filter starts at the new zero, so nothing jumps
    assert control.step(-50.0, 40.0, MOVE, DT_S) == moved
    assert control.activations == 2


def test_the_view_stays_on_the_screen_and_speed_does_not_wind_up() -> None:
    control = EndoscopeControl(ControlConfig(mapping="speed", response_s=0.0))
    control.step(0.0, 0.0, MOVE, DT_S)
    for _ in range(1000):
        view = control.step(45.0, 0.0, MOVE, DT_S)
    assert view.x == 640.0
    assert control.step(-10.0, 0.0, MOVE, DT_S).x == pytest.approx(640.0 - 8.0 * 10.0 * DT_S)


@pytest.mark.parametrize(
    ("psi", "status", "dt_s"), [(math.nan, MOVE, DT_S), (0.0, 3, DT_S), (0.0, MOVE, -1.0), (math.inf, MOVE, DT_S)]
)
def test_bad_input_is_refused(psi: float, status: int, dt_s: float) -> None:
    with pytest.raises(ValueError, match=r"status|numbers"):
        EndoscopeControl().step(psi, 0.0, status, dt_s)


def test_configuration_is_checked() -> None:
    with pytest.raises(ValidationError, match="gain"):
        ControlConfig(gain=0.0)
