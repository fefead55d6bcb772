"""The supervisor: nothing moves before the self-test, the first reason wins, neutral within 20 ms."""

import numpy as np
import pytest

from firmware_py.control.safety import RAMP_TICKS, State, Supervisor
from hal.contracts import Float64Array
from hal.errors import I2cNack, SafetyTrip
from hal.types import OutputLimit


class FakeAmplifier:
    """Ramps in ``ticks`` steps; ``failing`` transfers are refused first."""

    name = "piezo"
    limits = (OutputLimit(0.0, 100.0, 20_000.0, 50.0),)

    def __init__(self, ticks: int = RAMP_TICKS, failing: int = 0, self_test: bool = True) -> None:
        self.ticks, self.failing, self.self_test, self.armed = ticks, failing, self_test, False

    def arm(self) -> None:
        if not self.self_test:
            raise SafetyTrip("read-back differs from what was written", device="piezo")
        self.armed = True

    def write(self, values_V: Float64Array) -> int:
        return 0

    def safe_step(self) -> bool:
        self.armed = False
        if self.failing:
            self.failing -= 1
            raise I2cNack("address 0x0c not acknowledged", device="piezo")
        self.ticks -= 1
        return self.ticks <= 0

    def readback_V(self) -> Float64Array:
        return np.zeros(1)

    def close(self) -> None:
        pass


def running(amplifier: FakeAmplifier) -> Supervisor:
    supervisor = Supervisor(amplifier)
    supervisor.begin_self_test()
    supervisor.arm()
    return supervisor


def test_no_motion_before_the_self_test():
    supervisor = Supervisor(FakeAmplifier())
    supervisor.arm()
    assert not supervisor.may_move
    supervisor.begin_self_test()
    assert not supervisor.may_move
    supervisor.arm()
    assert supervisor.may_move


def test_failed_self_test_leaves_everything_disarmed():
    amplifier = FakeAmplifier(self_test=False)
    supervisor = Supervisor(amplifier)
    supervisor.begin_self_test()
    with pytest.raises(SafetyTrip):
        supervisor.arm()
    assert not supervisor.may_move
    assert not amplifier.armed


def test_first_reason_wins_and_neutral_in_20_ticks():
    supervisor = running(FakeAmplifier())
    supervisor.trip("stop button", tick=7, t_ns=7_000_000)
    supervisor.trip("stale sample", tick=8, t_ns=8_000_000)
    assert not supervisor.may_move
    steps = 1
    while not supervisor.step():
        steps += 1
    assert steps == RAMP_TICKS
    assert supervisor.safe_reached
    assert supervisor.trip_cause is not None
    assert (supervisor.trip_cause.reason, supervisor.trip_cause.tick) == ("stop button", 7)


def test_no_way_back():
    supervisor = running(FakeAmplifier(ticks=1))
    supervisor.trip("NaN in the estimate", tick=1, t_ns=1)
    assert supervisor.step()
    supervisor.begin_self_test()
    supervisor.arm()
    assert supervisor.state is State.SAFE


def test_a_refused_step_is_tried_again_within_its_tick():
    supervisor = running(FakeAmplifier(ticks=5, failing=4))
    supervisor.trip("link lost", tick=1, t_ns=1)
    # three refusals take the first tick, the fourth costs the second one nothing
    assert [supervisor.step() for _ in range(6)] == [False] * 5 + [True]
    assert supervisor.safe_reached


def test_a_dead_bus_ends_in_a_report_not_in_a_loop():
    supervisor = running(FakeAmplifier(failing=10_000))
    supervisor.trip("link lost", tick=1, t_ns=1)
    assert any(supervisor.step() for _ in range(2 * RAMP_TICKS))
    assert not supervisor.safe_reached
    assert "0x0c not acknowledged" in supervisor.ramp_failure
