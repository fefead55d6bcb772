"""The guardian against the emulated amplifier, in virtual time: who dies or stands still is brought to neutral."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.piezo.dac_amplifier import DacAmplifier
from firmware_py.guardian.amplifier import GuardedAmplifier
from firmware_py.guardian.guardian import STEP_NS, Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat, Phase, TakeoverReason
from hal.clock import VirtualClock
from hal.errors import I2cNack, SafetyTrip
from hal.middleware.faults import FaultI2c, FaultPlan
from sim_devices.devices.ad5696r import Ad5696r
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.transports.lockstep import LockstepI2cBus

MS = 1_000_000
FAR = np.array([90.0, 10.0, 60.0])


class Held:
    """``GuardianHandle`` of the guardian of ``stand``; nobody starts another one."""

    def __init__(self, stand: Any) -> None:
        self._stand = stand
        self.heartbeat: Heartbeat = stand.heartbeat

    def is_alive(self) -> bool:
        return self._stand.guardian.state is not State.DONE

    def kill(self) -> None:
        self._stand.guardian.stop()

    def begin_replacement(self) -> None:
        raise NotImplementedError

    def stop(self, is_interrupted: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        raise NotImplementedError

    def finish_replacement(self) -> bool:
        raise NotImplementedError


class Stand:
    """One DAC, two masters: the firmware's guarded amplifier and the guardian with an amplifier of its own."""

    def __init__(self, *, loss: float = 0.0) -> None:
        self.clock = VirtualClock(MS)  # 0 is "never"
        line = I2cLine(400_000)
        self.dac = Ad5696r(on_output=lambda channel, volts, t_ns: self.path.append((t_ns, channel, 20.0 * volts)))
        self.path: list[tuple[int, int, float]] = []
        line.attach(0x0C, self.dac)
        bus = LockstepI2cBus("i2c0", line, self.clock, lambda: None)
        lossy = FaultI2c(bus, self.clock, FaultPlan(loss=loss, seed=3))
        self.heartbeat = Heartbeat()
        self.heartbeat.note_guardian_alive(self.clock.now_ns())
        self.amplifier = GuardedAmplifier(DacAmplifier(bus, self.clock), Held(self), self.clock, lease_ms=40.0)
        self.guardian = Guardian(
            self.heartbeat, DacAmplifier(lossy, self.clock), self.clock, notice_ms=8.0, limit_ms=41.0
        )

    def moving(self) -> None:
        """Armed and out at ``FAR``."""
        self.tick()  # a sign of life
        self.amplifier.arm()
        for _ in range(5):
            self.tick()
            self.amplifier.write(FAR)

    def tick(self, *, alive: bool = True) -> None:
        self.guardian.step(alive)
        self.clock.advance_to((self.clock.now_ns() // STEP_NS + 1) * STEP_NS)

    def volts(self) -> list[float]:
        return [20.0 * v for v in self.dac.output_V[:3]]


def test_a_beating_firmware_is_left_alone():
    stand = Stand()
    stand.moving()
    before = len(stand.path)
    for _ in range(200):
        stand.amplifier.write(FAR)
        stand.tick()
    assert len(stand.path) == before
    assert stand.guardian.report()["why"] == "nothing"
    assert stand.heartbeat.late_beat_ns == 0


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_a_dead_firmware_is_brought_to_neutral_within_twenty_ms(loss: float):
    stand = Stand(loss=loss)
    stand.moving()
    died_ns = stand.clock.now_ns()
    while stand.guardian.state is not State.DONE:
        stand.tick(alive=False)
    assert stand.volts() == pytest.approx([50.0] * 3)
    assert max(t_ns for t_ns, _, _ in stand.path) - died_ns <= 20 * MS
    report = stand.guardian.report()
    assert report["why"] == "died"
    assert report["problem"] == ""
    assert report["neutral_ns"] - died_ns <= 25 * MS
    steps = np.diff([v for t_ns, channel, v in stand.path if channel == 0 and t_ns >= died_ns])
    assert np.abs(steps).max() <= 20.0  # the slew limit, per ms


def test_a_firmware_that_dies_at_rest_needs_nothing():
    stand = Stand()
    stand.tick(alive=False)
    assert stand.guardian.state is State.DONE
    assert stand.path == []


def test_a_pause_is_noticed_and_a_long_one_taken_over_and_the_firmware_gives_in():
    stand = Stand()
    stand.moving()
    beat_ns = stand.heartbeat.beat_ns
    for _ in range(30):
        stand.tick()
    assert 8 * MS < stand.heartbeat.late_beat_ns - beat_ns <= 10 * MS
    assert not stand.heartbeat.taken_ns
    for _ in range(40):
        stand.tick()
    assert stand.heartbeat.reason is TakeoverReason.SILENT
    assert 41 * MS < stand.heartbeat.taken_ns - beat_ns <= 43 * MS
    assert stand.volts() == pytest.approx([50.0] * 3)
    with pytest.raises(SafetyTrip, match=r"stood still for [67]\d ms"):
        stand.amplifier.write(FAR)
    assert stand.amplifier.safe_step()
    assert stand.volts() == pytest.approx([50.0] * 3)
    for _ in range(60):
        stand.tick()
    assert stand.guardian.state is State.WATCHING  # given back
    assert stand.guardian.report()["why"] == "silent"
    stand.tick(alive=False)
    assert stand.guardian.state is State.DONE


def test_a_firmware_that_wakes_during_the_ramp_waits_for_its_end():
    stand = Stand()
    stand.moving()
    while not stand.heartbeat.taken_ns:
        stand.tick()
    stand.tick()
    written = len(stand.path)
    assert not stand.amplifier.safe_step()
    assert len(stand.path) == written
    while not stand.heartbeat.neutral_ns:
        stand.tick()
    assert stand.amplifier.safe_step()


def test_a_command_that_was_under_way_is_undone():
    stand = Stand()
    stand.moving()
    while not stand.heartbeat.neutral_ns:
        stand.tick(alive=False)
    late = DacAmplifier(stand.guardian._output.bus, stand.clock)  # type: ignore[attr-defined]
    late.arm()
    stand.clock.burn_ns(5 * MS)
    late.write(np.array([60.0, 50.0, 50.0]))
    while stand.guardian.state is not State.DONE:
        stand.tick(alive=False)
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_a_dead_bus_ends_in_a_report():
    stand = Stand()
    stand.moving()
    stand.dac.nack_address = True
    while stand.guardian.state is not State.DONE:
        stand.tick(alive=False)
    report = stand.guardian.report()
    assert report["neutral_ns"] is None
    assert "0x0c" in report["problem"].lower()


def test_arming_is_not_silence_and_rest_after_the_ramp_is_not_either():
    stand = Stand()
    stand.heartbeat.set_phase(Phase.ARMING)
    for _ in range(100):
        stand.tick()
    assert stand.heartbeat.reason is TakeoverReason.NOTHING
    stand.moving()
    while not stand.amplifier.safe_step():
        stand.tick()
    assert stand.heartbeat.phase is Phase.IDLE
    for _ in range(100):
        stand.tick()
    assert stand.heartbeat.reason is TakeoverReason.NOTHING


def test_a_refused_command_is_a_beat_too():
    stand = Stand()
    stand.moving()
    stand.dac.nack_address = True
    with pytest.raises(I2cNack):
        stand.amplifier.write(FAR)
    assert stand.heartbeat.beat_ns <= stand.clock.now_ns()
    assert stand.clock.now_ns() - stand.heartbeat.beat_ns < MS


def test_shared_memory_is_seen_through_its_descriptor():
    ours = Heartbeat.shared()
    assert ours.fd is not None
    theirs = Heartbeat(ours.fd)
    ours.beat(12345678901234567)
    ours.set_phase(Phase.RUNNING)
    assert (theirs.beat_ns, theirs.phase) == (12345678901234567, Phase.RUNNING)
    theirs.take_outputs(TakeoverReason.SILENT, 7)
    assert (ours.taken_ns, ours.reason) == (7, TakeoverReason.SILENT)
