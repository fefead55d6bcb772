"""A bus that answers nobody for a while: nobody is ended for it, and the outputs are brought to neutral afterwards."""

from __future__ import annotations

import pytest

from firmware_py.guardian.guardian import State
from firmware_py.guardian.heartbeat import TakeoverReason
from hal.errors import BusError, HalError
from hal.middleware.faults import FaultPlan
from tests.unit.guardian.test_exclusive import FAR_V, MS, Stand, alternating


class HangingStand(Stand):
    """Firmware and guardian at one DAC, and a bus that can hang for both."""

    def hang(self) -> None:
        self.dac.nack_address = True

    def come_back(self) -> None:
        self.dac.nack_address = False

    def pass_ms(self, count: int) -> list[str]:
        """The firmware's way to neutral, a step a millisecond, until it is there; what was said."""
        said: list[str] = []
        for _ in range(count):
            try:
                if self.amplifier.safe_step():
                    return [*said, "neutral"]
            except HalError as error:
                said.append(str(error))
            self.tick()
        return said


@pytest.mark.parametrize("hangs_ms", [60, 500, 3000])
def test_the_guardian_is_not_ended_while_the_bus_answers_nobody_and_ramps_when_it_is_back(hangs_ms: int):
    stand = HangingStand()
    stand.run(5, alternating)
    stand.clock.burn_ns(50 * MS)  # the guardian takes the outputs
    stand.hang()
    assert stand.run(1, alternating)
    said = stand.pass_ms(hangs_ms)
    assert "neutral" not in said
    assert stand.guardian.state is State.RAMPING, "it was ended, or has given up"
    stand.come_back()
    back_ns = stand.clock.now_ns()
    assert "neutral" in stand.pass_ms(60)
    assert stand.volts() == pytest.approx([50.0] * 3)
    assert not [t_ns for t_ns in stand.commands_of("firmware") if t_ns > back_ns]  # one ramp, not two


def test_closing_leaves_the_guardian_at_work_where_the_bus_answers_nobody():
    stand = HangingStand()
    stand.run(5, alternating)
    stand.clock.burn_ns(50 * MS)
    stand.hang()
    assert stand.run(1, alternating)
    with pytest.raises(BusError):
        stand.amplifier.close()
    assert stand.guardian.state is State.RAMPING
    stand.come_back()
    stand.alive = False  # the run is over
    for _ in range(100):
        stand.tick()
    assert stand.guardian.state is State.DONE
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_the_firmware_takes_the_outputs_of_a_guardian_that_does_nothing_on_a_bus_that_answers():
    stand = HangingStand(guardian_steps=False)
    stand.run(5)
    stand.clock.burn_ns(50 * MS)
    stand.hang()
    assert stand.run(5)
    assert stand.guardian.state is not State.DONE
    stand.come_back()
    assert "neutral" in stand.pass_ms(100)
    assert stand.guardian.state is State.DONE
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_a_hang_in_the_firmware_s_own_ramp_is_taken_over_and_brought_to_neutral():
    """The firmware's transfers fail without a pause; its heartbeat goes on until the pauses exceed the lease."""
    stand = HangingStand()
    stand.run(5, lambda k: FAR_V)
    stand.hang()
    said = stand.pass_ms(45)
    assert "neutral" not in said
    stand.clock.burn_ns(60 * MS)
    stand.come_back()
    for _ in range(60):
        stand.tick()
    assert "neutral" in stand.pass_ms(60)
    assert stand.volts() == pytest.approx([50.0] * 3)


@pytest.mark.parametrize("slow_ms", [0, 400])
def test_a_read_that_waited_for_the_bus_gives_the_guardian_its_time(slow_ms: int):
    """The firmware's look at the bus fails, or hangs and then succeeds: the guardian's ramp comes only after it."""
    stand = HangingStand()
    stand.run(5, alternating)
    stand.clock.burn_ns(50 * MS)
    stand.hang()
    assert stand.run(1, alternating)
    stand.pass_ms(100)
    stand.come_back()
    if slow_ms:
        stand.slow.arm(FaultPlan(delay=1.0, delay_s=slow_ms * 1e-3))
        stand.clock.at(stand.clock.now_ns() + 1 * MS, lambda _: stand.slow.arm(FaultPlan()))
    assert "neutral" in stand.pass_ms(80)
    assert stand.guardian.state is not State.DONE, "it was ended"
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_the_firmware_s_own_ramp_after_it_ended_a_guardian_that_had_taken_the_outputs_takes_its_sixteen_steps():
    stand = HangingStand(guardian_steps=False)
    stand.run(5)
    stand.heartbeat.take_outputs(TakeoverReason.SILENT, stand.clock.now_ns())  # and then it stands still
    stand.clock.burn_ns(50 * MS)
    said = stand.pass_ms(100)
    assert said == ["neutral"]
    assert stand.guardian.state is State.DONE
    assert len(stand.commands_of("firmware")) <= 5 + 3 + 18
    assert stand.volts() == pytest.approx([50.0] * 3)
