"""Jog: moves only while armed and held, comes back by itself; the hysteresis memory follows."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.hysteresis import plays_at, stack_stroke
from firmware_py.actuation.stage import Actuation
from firmware_py.control.manual import ARM_S, HOLD_S, RETURN_V_PER_S, ManualDrive, follow_kernel
from firmware_py.frame import COMMAND, LAYOUT, STROKE
from firmware_py.records import attributes
from tests.unit.pure_python import without_compiler

MS = 1_000_000


def drive(manual: ManualDrive, from_ms: int, to_ms: int) -> list[list[float]]:
    return [manual.step(t * MS).tolist() for t in range(from_ms, to_ms)]


@pytest.fixture
def manual() -> ManualDrive:
    armed = ManualDrive(0.0, 100.0, 50.0)
    armed.arm(0, np.array([50.0, 50.0, 50.0]))
    return armed


def test_nothing_moves_before_it_is_armed():
    manual = ManualDrive(0.0, 100.0, 50.0)
    manual.jog(0, 0, 100.0)
    assert not manual.active


def test_it_moves_as_long_as_it_is_held_and_no_longer(manual: ManualDrive):
    manual.step(0)
    manual.jog(0, 1, 100.0)
    path = np.array(drive(manual, 1, 400))
    held = round(HOLD_S * 1000)
    assert path[held - 2, 1] == pytest.approx(50.0 + 100.0 * (held - 1) * 1e-3)
    np.testing.assert_array_equal(path[held:, 1], path[-1, 1])
    np.testing.assert_array_equal(path[:, (0, 2)], 50.0)


def test_limits_and_rate_hold(manual: ManualDrive):
    now = 0
    for _ in range(40):
        manual.arm(now * MS, np.zeros(3))
        manual.jog(now * MS, 0, 1e6)
        path = drive(manual, now + 1, now + 100)
        now += 100
    assert path[-1][0] == 100.0
    assert manual.active


def test_an_unrenewed_switch_brings_it_back_to_neutral(manual: ManualDrive):
    manual.jog(0, 2, -200.0)
    drive(manual, 0, 200)
    assert manual.armed(200 * MS)
    end = round(ARM_S * 1000)
    path = np.array(drive(manual, 200, end + 400))
    assert not manual.active
    np.testing.assert_array_equal(path[-1], 50.0)
    assert np.abs(np.diff(path[:, 2])).max() <= RETURN_V_PER_S * 1.001e-3


@pytest.mark.parametrize("order", [(3, 10.0), (-1, 10.0), (0, float("nan")), (0, float("inf"))])
def test_orders_without_sense_move_nothing(manual: ManualDrive, order: tuple[int, float]):
    manual.jog(0, *order)
    assert drive(manual, 0, 50)[-1] == [50.0, 50.0, 50.0]


def test_stroke_is_the_forward_model_of_the_command():
    stage = Actuation(ActuationConfig())
    frame = LAYOUT.new_frame()
    param = attributes(stage.params)[0]
    plays = [plays_at(param.stacks[i], 50.0, 100.0) for i in range(3)]
    rng = np.random.default_rng(3)
    for volts in 50.0 + 40.0 * rng.uniform(-1, 1, (60, 3)):
        frame[COMMAND : COMMAND + 3] = volts
        follow_kernel(frame, stage.state, stage.params)
        expected = [
            stack_stroke(volts[i], param.stacks[i].slope, plays[i], np.zeros(4), param.stacks[i])
            - param.neutral_stroke[i]
            for i in range(3)
        ]
        np.testing.assert_allclose(frame[STROKE : STROKE + 3], expected, rtol=1e-9, atol=1e-13)


def test_the_kernel_is_its_python(monkeypatch: pytest.MonkeyPatch):
    compiled, plain = Actuation(ActuationConfig()), Actuation(ActuationConfig())
    a, b = LAYOUT.new_frame(), LAYOUT.new_frame()
    a[COMMAND : COMMAND + 3] = b[COMMAND : COMMAND + 3] = 71.0, 20.0, 55.0
    follow_kernel(a, compiled.state, compiled.params)
    python = follow_kernel.py_func
    without_compiler(monkeypatch)
    python(b, attributes(plain.state), attributes(plain.params))
    np.testing.assert_allclose(a, b, rtol=1e-12)
