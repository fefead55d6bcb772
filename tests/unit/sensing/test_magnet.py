"""A magnet that moves with the body: found and taken off the field; a magnet in the room is not taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.records import Records, attributes, new
from firmware_py.sensing.attitude_params import gyroscope_error_state
from firmware_py.sensing.error_state_records import ErrorStateParams
from firmware_py.sensing.gyroscope_filter import GyroscopeMemory, begin_gyroscope, run_gyroscope
from firmware_py.sensing.magnet import UNKNOWNS, Magnet, MagnetParams, begin_magnet, find_magnet, heading_spread
from hal.arrays import Array

RATE_HZ = 100.0
ROOM_UT = np.array([16.0, 0.0, -42.0])
MAGNET_UT = np.array([-1.5, 2.0, 2.5])
"""A weak magnet: 3.5 uT, which the tolerance of the field's size (10 %) lets pass."""


def turning_body(seconds: float) -> tuple[Rotation, Array]:
    """Attitudes and rates of a body that lies for 10 s and then turns about all axes."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    swing = np.clip(t - 10.0, 0.0, 2.0) / 2.0
    turn = np.stack([0.8 * np.sin(1.1 * t), 0.9 * np.sin(0.7 * t), 1.5 * np.sin(0.5 * t)], axis=1) * swing[:, None]
    attitude = Rotation.from_rotvec(turn)
    rate = np.zeros_like(turn)
    rate[1:] = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE_HZ
    return attitude, rate


def sensed(attitude: Rotation, seed: int = 3) -> Array:
    """Field of the room, which differs by 0.5 uT between places that the body passes in a second, and its noise, uT."""
    rng = np.random.default_rng(seed)
    places = np.zeros((len(attitude), 3))
    for k in range(1, len(places)):
        places[k] = np.exp(-1.0 / RATE_HZ) * places[k - 1] + 0.5 * np.sqrt(2.0 / RATE_HZ) * rng.standard_normal(3)
    return attitude.inv().apply(ROOM_UT + places) + 0.3 * rng.standard_normal(places.shape)


def run(
    attitude: Rotation, rate: Array, field: Array, setting: Records[ErrorStateParams]
) -> tuple[Array, list[Magnet]]:
    """Return heading errors in degrees, and the two models at the end of every second."""
    memory = new(GyroscopeMemory)
    memory["params"]["error_state"] = setting
    memory["params"]["align_samples"] = 10.0
    begin_gyroscope(memory)
    force = attitude.inv().apply(np.array([0.0, 0.0, 9.81]))
    q, seconds = np.empty((len(rate), 4)), []
    for start in range(0, len(rate), int(RATE_HZ)):
        part = slice(start, start + int(RATE_HZ))
        run_gyroscope(memory, rate[part], force[part], field[part], np.full(len(rate[part]), 1.0 / RATE_HZ), q[part])
        seconds.append(attributes(memory["state"]["error_state"]["magnet"][0].copy())[0])
    away = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) * attitude.inv()).as_rotvec()[:, 2]
    return np.degrees(away), seconds


def test_a_weak_magnet_on_the_body_is_found_and_let_go() -> None:
    attitude, rate = turning_body(120.0)
    field = sensed(attitude)
    field[2000:7000] += MAGNET_UT
    away, seconds = run(attitude, rate, field, gyroscope_error_state())
    assert max(m.share for m in seconds[:20]) < 0.01
    assert all(m.share > 0.99 for m in seconds[40:70])
    np.testing.assert_allclose(seconds[69].unit * seconds[69].pair[3:], MAGNET_UT, atol=0.3)
    assert all(m.share < 0.01 for m in seconds[95:])
    without = gyroscope_error_state()
    without["magnet"]["room_density"] = 0.0
    believed, _ = run(attitude, rate, field, without)
    late = slice(4000, 7000)
    assert np.sqrt(np.mean(away[late] ** 2)) < 0.5 * np.sqrt(np.mean(believed[late] ** 2))


@pytest.mark.parametrize("seed", range(4))
def test_a_room_without_a_magnet_has_none(seed: int) -> None:
    attitude, rate = turning_body(90.0)
    _, seconds = run(attitude, rate, sensed(attitude, seed), gyroscope_error_state())
    assert max(m.share for m in seconds) < 0.05


def test_a_magnet_in_the_room_is_not_on_the_body() -> None:
    """Steel beside the path: the body passes it every four seconds, whatever its attitude."""
    attitude, rate = turning_body(90.0)
    near = np.maximum(0.0, np.sin(np.pi / 2.0 * np.arange(len(rate)) / RATE_HZ)) ** 4
    field = sensed(attitude) + attitude.inv().apply(near[:, None] * np.array([2.0, 4.0, -3.0]))
    _, seconds = run(attitude, rate, field, gyroscope_error_state())
    assert max(m.share for m in seconds) < 0.5


def test_the_unit_of_the_field_does_not_matter() -> None:
    attitude, rate = turning_body(40.0)
    field = sensed(attitude)
    field[1500:] += MAGNET_UT
    in_uT, in_gauss = (run(attitude, rate, scale * field, gyroscope_error_state())[0] for scale in (1.0, 0.01))
    np.testing.assert_allclose(in_gauss, in_uT, atol=1e-6)


def params_and_models() -> tuple[Records[MagnetParams], Records[Magnet]]:
    params, magnet = new(MagnetParams), new(Magnet)
    params[0] = gyroscope_error_state()["magnet"][0]
    begin_magnet(magnet[0])
    return params, magnet


def test_the_models_follow_the_dense_equations() -> None:
    rng = np.random.default_rng(8)
    params, magnet = params_and_models()
    again = magnet.copy()  # pyright: ignore[reportAttributeAccessIssue]
    p, m, dt = attributes(params)[0], attributes(magnet)[0], 0.05
    find_magnet(magnet[0], params[0], np.eye(3), ROOM_UT, dt)
    unit = np.linalg.norm(ROOM_UT)
    x = np.concatenate([ROOM_UT / unit, np.zeros(3)])
    cov = p.magnet_start**2 * np.eye(UNKNOWNS)
    room, variance = x[:3].copy(), p.magnet_start**2
    alone = together = p.room_density
    weight = 1.0 - np.exp(-dt / p.window_s)
    attitudes = Rotation.from_quat(rng.standard_normal((30, 4))).as_matrix()
    fields = [c.T @ ROOM_UT + MAGNET_UT + 0.3 * rng.standard_normal(3) for c in attitudes]
    noise = p.room_density / dt
    for c, b in zip(attitudes, fields, strict=True):
        find_magnet(magnet[0], params[0], c, b, dt)
        z = c @ b / unit
        cov += np.diag([p.room_walk * dt] * 3 + [p.magnet_walk * dt] * 3)
        variance += p.room_walk * dt
        h = np.hstack([np.eye(3), c])
        s = h @ cov @ h.T + noise * np.eye(3)
        e = z - h @ x
        gain = cov @ h.T @ np.linalg.inv(s)
        x, cov = x + gain @ e, cov - gain @ s @ gain.T
        together += weight * (e @ np.linalg.solve(s, e) * p.room_density / 3.0 - together)
        away = z - room
        alone += weight * (away @ away / (variance + noise) * p.room_density / 3.0 - alone)
        room, variance = room + variance / (variance + noise) * away, variance * noise / (variance + noise)
    np.testing.assert_allclose(m.pair, x, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(m.covariance, cov, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose((m.alone, m.together), (alone, together), rtol=1e-9)
    preference = 1.5 * p.window_s / p.independent_s * np.log(alone / together)
    assert m.share == pytest.approx(1.0 / (1.0 + np.exp(p.price - preference)), rel=1e-9)
    west = attitudes[-1][1]
    known = west @ cov[3:, 3:] @ west * together / p.room_density
    expected = 2.0 * p.window_s * m.share * (known + (1.0 - m.share) * (west @ x[3:]) ** 2)
    assert heading_spread(magnet[0], params[0], attitudes[-1]) == pytest.approx(expected, rel=1e-9)
    begin_magnet(again[0])
    twin = find_magnet.py_func  # type: ignore[attr-defined]
    for c, b in zip([np.eye(3), *attitudes], [ROOM_UT, *fields], strict=True):
        twin(attributes(again)[0], p, c, b, dt)
    np.testing.assert_allclose(attributes(again)[0].pair, m.pair, rtol=1e-9)


def test_no_field_at_all_is_waited_out() -> None:
    params, magnet = params_and_models()
    find_magnet(magnet[0], params[0], np.eye(3), np.zeros(3), 0.05)
    find_magnet(magnet[0], params[0], np.eye(3), ROOM_UT, 0.05)
    m = attributes(magnet)[0]
    assert m.unit == pytest.approx(np.linalg.norm(ROOM_UT))
    np.testing.assert_allclose(m.room * m.unit, ROOM_UT)
