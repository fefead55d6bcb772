"""The endoscope bench's body: rates and forces are the derivatives of its attitude and path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_devices.config import EmulationConfig
from sim_devices.plant.scanner import Scanner

G = 9.80131


def scanner(**endoscope: Any) -> Scanner:
    return Scanner(EmulationConfig.model_validate({"endoscope": endoscope}))


@pytest.mark.parametrize("scenario", ["hand", "poses", "turntable"])
def test_rate_is_the_derivative_of_attitude(scenario: str) -> None:
    body = scanner(
        scenario=scenario,
        attitude_deg=[10.0, -20.0, 30.0],
        poses=[[0.2, 40.0, 10.0, -30.0, 1.0], [1.5, 0.0, 0.0, 0.0, 0.5]],
        start_s=0.1,
    )
    h = 1000
    for t_ns in (300_000_000, 700_000_000, 1_100_000_000, 1_700_000_000):
        now = body.motion_at(t_ns)
        step = now.attitude.T @ (body.motion_at(t_ns + h).attitude - body.motion_at(t_ns - h).attitude) / (2e-9 * h)
        assert [step[2, 1], step[0, 2], step[1, 0]] == pytest.approx(list(now.rate_rad_s), abs=1e-6)
        dw = (body.motion_at(t_ns + h).rate_rad_s - body.motion_at(t_ns - h).rate_rad_s) / (2e-9 * h)
        assert dw == pytest.approx(now.angular_acceleration_rad_s2, abs=1e-4)


def test_rest_feels_the_reaction_to_gravity() -> None:
    motion = scanner(scenario="rest", attitude_deg=[0.0, 0.0, 77.0]).motion_at(10**9)
    assert motion.specific_force_m_s2 == pytest.approx([0.0, 0.0, G])
    assert motion.rate_rad_s == pytest.approx([0.0, 0.0, 0.0])


def test_turntable_pulls_towards_its_axis() -> None:
    body = scanner(scenario="turntable", rate_dps=180.0, radius_m=0.1, start_s=0.0, ramp_s=0.5)
    assert body.motion_at(2 * 10**9).specific_force_m_s2 == pytest.approx([-(np.pi**2) * 0.1, 0.0, G])
    assert body.motion_at(10**8).specific_force_m_s2[1] == pytest.approx(2 * np.pi * 0.1)  # while it spins up


def test_fall_is_weightless_for_its_time_and_the_impact_takes_the_momentum_back() -> None:
    body = scanner(scenario="fall", fall_at_s=1.0, fall_m=1.25)
    falls_s = np.sqrt(2 * 1.25 / G)
    t = np.arange(0.9, 1.0 + falls_s + 0.01, 1e-4)
    up = np.array([body.motion_at(round(s * 1e9)).specific_force_m_s2[2] for s in t])
    weightless = t[up == 0.0]
    assert weightless[0] == pytest.approx(1.0, abs=2e-4)
    assert weightless[-1] == pytest.approx(1.0 + falls_s, abs=2e-4)
    assert np.sum(up - G) * 1e-4 == pytest.approx(0.0, abs=0.1)  # velocity before and after: none


def test_poses_are_reached_and_held() -> None:
    body = scanner(scenario="poses", poses=[[0.5, 0.0, 45.0, 0.0, 0.5]])
    assert body.motion_at(4 * 10**8).attitude == pytest.approx(np.eye(3))
    assert body.motion_at(10**9).attitude[2, 0] == pytest.approx(-np.sin(np.pi / 4))
    assert body.motion_at(10**9).rate_rad_s == pytest.approx([0.0, 0.0, 0.0])


def test_hand_is_the_same_for_the_same_seed() -> None:
    one, two = scanner(scenario="hand"), scanner(scenario="hand")
    assert np.array_equal(one.motion_at(123456789).attitude, two.motion_at(123456789).attitude)


def test_room_temperature() -> None:
    body = scanner(scenario="rest", start_C=40.0, end_C=10.0, thermal_s=100.0)
    assert body.motion_at(0).temperature_C == 40.0
    assert body.motion_at(100 * 10**9).temperature_C == pytest.approx(10.0 + 30.0 / np.e)
