"""One of two commands the amplifier, never both: exact in virtual time, at every length and phase of a stall."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from drivers.piezo.dac_amplifier import DacAmplifier
from firmware_py.guardian.amplifier import GuardedAmplifier
from firmware_py.guardian.guardian import LAST_RESORT_NS, STEP_NS, STUCK_COMMAND_NS, Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat, Phase, TakeoverReason
from hal.clock import VirtualClock
from hal.errors import SafetyTrip
from hal.middleware.faults import FaultI2c, FaultPlan
from hal.types import I2cOp, I2cWrite, PortInfo
from sim_devices.devices.ad5696r import Ad5696r
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.transports.lockstep import LockstepI2cBus
from tests.unit.guardian.handle import begin_command
from tests.unit.guardian.test_guardian import Held

MS = 1_000_000
LEASE_MS = 40.0
FAR_V = np.array([90.0, 10.0, 60.0])


class Spy:
    """I2cBus that notes who began to send a command, and when."""

    def __init__(self, bus: Any, who: str, log: list[tuple[int, str]], clock: VirtualClock) -> None:
        self._bus, self._who, self._log, self._clock = bus, who, log, clock

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        if len([op for op in ops if isinstance(op, I2cWrite)]) > 1:
            self._log.append((self._clock.now_ns(), self._who))
        return self._bus.transfer(address, ops)

    def info(self) -> PortInfo:
        return self._bus.info()

    def close(self) -> None:
        self._bus.close()


class Stand:
    """Firmware and guardian at one DAC, the guardian stepping by itself half a tick beside the firmware."""

    def __init__(self, *, end: Callable[[], None] | None = None, guardian_steps: bool = True) -> None:
        self.clock = VirtualClock()
        self.path: list[tuple[int, int, float]] = []
        self.sent: list[tuple[int, str]] = []
        self.alive = True
        line = I2cLine(400_000)
        self.dac = Ad5696r(on_output=lambda channel, volts, t_ns: self.path.append((t_ns, channel, 20.0 * volts)))
        line.attach(0x0C, self.dac)
        bus = LockstepI2cBus("i2c0", line, self.clock, lambda: None)
        self.slow = FaultI2c(Spy(bus, "firmware", self.sent, self.clock), self.clock, FaultPlan())
        self.heartbeat = Heartbeat()
        self.guardian = Guardian(
            self.heartbeat, DacAmplifier(Spy(bus, "guardian", self.sent, self.clock), self.clock), self.clock,
            notice_ms=8.0, limit_ms=LEASE_MS + 1.0, kill_firmware=end,
        )  # fmt: skip
        self.amplifier = GuardedAmplifier(
            DacAmplifier(self.slow, self.clock), Held(self), self.clock, lease_ms=LEASE_MS
        )
        self.clock.burn_ns(STEP_NS)
        self.heartbeat.note_guardian_alive(self.clock.now_ns())
        self.amplifier.arm()
        if guardian_steps:
            self.clock.at(self.clock.now_ns() + STEP_NS // 2, self._step)

    def _step(self, t_ns: int) -> None:
        self.guardian.step(self.alive)
        if self.guardian.state is not State.DONE:
            self.clock.at(t_ns + STEP_NS, self._step)

    def tick(self) -> None:
        self.clock.advance_to((self.clock.now_ns() // STEP_NS + 1) * STEP_NS)

    def run(self, ticks: int, wish_V: Callable[[int], np.ndarray] = lambda k: FAR_V) -> str:
        """Ticks of the firmware: commands, and after a refusal its way to the safe state. The refusal, or empty."""
        refusal, at_neutral = "", False
        for k in range(ticks):
            if refusal:
                at_neutral = at_neutral or self.amplifier.safe_step()
            else:
                try:
                    self.amplifier.write(wish_V(k))
                except SafetyTrip as error:
                    refusal = str(error)
            self.tick()
        return refusal

    def volts(self) -> list[float]:
        return [20.0 * v for v in self.dac.output_V[:3]]

    def commands_of(self, who: str) -> list[int]:
        return [t_ns for t_ns, sender in self.sent if sender == who]


def alternating(k: int) -> np.ndarray:
    return np.array([50.0, 50.0, 50.0]) + (15.0 if k % 2 else -15.0)


@pytest.mark.parametrize("phase_us", [0, 50, 180, 300, 371, 600, 990])
@pytest.mark.parametrize("stall_ms", [35.0, 39.0, 39.7, 40.0, 40.4, 41.0, 41.6, 42.1, 45.0, 50.0, 57.0, 70.0])
def test_nobody_moves_the_outputs_beside_the_guardian(stall_ms: float, phase_us: int):
    stand = Stand()
    stand.run(5, alternating)
    at_ns = (stand.clock.now_ns() // STEP_NS + 3) * STEP_NS + phase_us * 1000
    stand.clock.at(at_ns, lambda _: stand.clock.burn_ns(round(stall_ms * MS)))
    refusal = stand.run(130, alternating)
    report = stand.guardian.report()
    taken_ns = report["taken_ns"]
    if not taken_ns:  # too short: the firmware has gone on as if nothing had been
        assert not refusal
        assert stall_ms <= LEASE_MS
        return
    assert "lost the outputs to the guardian" in refusal
    assert max(stand.commands_of("firmware")) < taken_ns
    assert report["why"] == "silent"
    assert stand.guardian.exclusive
    assert stand.volts() == pytest.approx([50.0] * 3)
    for channel in range(3):
        ramp = np.array([v for t_ns, c, v in stand.path if c == channel and t_ns > taken_ns])
        assert np.all(np.diff(np.abs(ramp - 50.0)) <= 1e-9)  # nothing but nearer and nearer
        assert np.abs(np.diff(ramp)).max() <= 20.0


@pytest.mark.parametrize("phase_us", [0, 180, 371, 600, 990])
@pytest.mark.parametrize("stall_ms", [40.4, 41.0, 45.0, 70.0, 500.0])
def test_outputs_come_back_in_a_handshake_three_times(stall_ms: float, phase_us: int):
    """Between the guardian's taking and the firmware's arming nobody but the guardian commands; then only the
    firmware does."""
    stand = Stand()
    for _ in range(3):
        stand.run(5, alternating)
        began_ns = stand.clock.now_ns()
        at_ns = (began_ns // STEP_NS + 3) * STEP_NS + phase_us * 1000
        stand.clock.at(at_ns, lambda _: stand.clock.burn_ns(round(stall_ms * MS)))
        assert "lost the outputs to the guardian" in stand.run(130, alternating)
        assert not stand.heartbeat.taken_ns, "it gives them back 50 ms after neutral"
        report = stand.guardian.report()
        stand.amplifier.arm()
        armed_ns = stand.clock.now_ns()
        assert all(not report["taken_ns"] <= t_ns < armed_ns - 3 * MS for t_ns in stand.commands_of("firmware"))
        assert not stand.run(20, alternating)
        assert max(stand.commands_of("guardian")) < armed_ns
        assert stand.guardian.state is State.WATCHING
        ramp = [v for t_ns, channel, v in stand.path if channel == 0 and report["taken_ns"] < t_ns <= armed_ns]
        assert np.all(np.diff(np.abs(np.array(ramp) - 50.0)) <= 1e-9)


def test_outputs_that_are_wanted_at_once_are_waited_for():
    stand = Stand()
    stand.run(5, alternating)
    stand.clock.burn_ns(50 * MS)
    assert stand.run(25, alternating)
    report = stand.guardian.report()
    assert stand.heartbeat.taken_ns
    stand.amplifier.arm()
    assert stand.clock.now_ns() - report["neutral_ns"] > 50 * MS
    assert not stand.run(5, alternating)


def test_a_firmware_that_dies_after_it_got_its_outputs_back_is_brought_to_neutral():
    stand = Stand()
    stand.run(5, alternating)
    stand.clock.burn_ns(50 * MS)
    assert stand.run(130, alternating)
    stand.amplifier.arm()
    assert not stand.run(5, alternating)
    stand.alive = False
    for _ in range(30):
        stand.tick()
    assert stand.guardian.report()["why"] == "died"
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_a_guardian_that_keeps_the_outputs_or_had_to_be_ended_ends_the_run():
    stand = Stand(guardian_steps=False)
    stand.run(5)
    stand.heartbeat.note_guardian_alive(stand.clock.now_ns())
    stand.heartbeat.take_outputs(TakeoverReason.SILENT, stand.clock.now_ns())
    with pytest.raises(SafetyTrip, match="does not give the outputs back"):
        stand.amplifier.arm()
    stand = Stand(guardian_steps=False)
    stand.run(5)
    stand.clock.burn_ns(50 * MS)
    assert stand.run(42)
    with pytest.raises(SafetyTrip, match="no guardian watches over them"):
        stand.amplifier.arm()


def test_a_command_that_stands_before_the_wire_ends_the_firmware_before_the_guardian_moves():
    ended: list[int] = []
    stand = Stand(end=lambda: ended.append(stand.clock.now_ns()))
    stand.run(5, alternating)
    late_ns = 0

    def die(_: int) -> None:
        stand.alive = False  # what a kill does: nothing of the firmware runs any more
        raise KeyboardInterrupt

    stand.slow.arm(FaultPlan(delay=1.0, delay_s=0.2))
    stand.clock.at(stand.clock.now_ns() + 60 * MS, die)
    with pytest.raises(KeyboardInterrupt):
        stand.run(1, lambda k: FAR_V)
    late_ns = stand.clock.now_ns()
    assert len(ended) == 1
    assert STUCK_COMMAND_NS < ended[0] - stand.heartbeat.taken_ns <= STUCK_COMMAND_NS + 2 * MS
    assert stand.commands_of("guardian") == []  # it waits for the death
    while stand.guardian.state is not State.DONE:
        stand.tick()
    assert min(stand.commands_of("guardian")) >= late_ns
    assert stand.volts() == pytest.approx([50.0] * 3)
    assert stand.guardian.report()["firmware_ended"]
    assert stand.guardian.exclusive


def test_who_may_not_end_the_firmware_waits_for_its_command_and_undoes_it_in_the_end():
    stand = Stand()
    stand.run(5, alternating)
    stand.slow.arm(FaultPlan(delay=1.0, delay_s=0.08))
    began_ns = stand.clock.now_ns()
    stand.run(1, lambda k: FAR_V)  # comes out 80 ms late, before the last resort
    assert stand.commands_of("firmware")[-1] > stand.heartbeat.taken_ns
    assert all(t_ns > stand.commands_of("firmware")[-1] for t_ns in stand.commands_of("guardian"))
    assert stand.run(60)
    assert stand.guardian.exclusive
    assert stand.volts() == pytest.approx([50.0] * 3)
    assert stand.clock.now_ns() - began_ns < 160 * MS


def test_outputs_do_not_wait_for_ever_and_the_report_says_so():
    stand = Stand()
    stand.run(5, alternating)
    stand.slow.arm(FaultPlan(delay=1.0, delay_s=0.4))
    stand.run(1, lambda k: FAR_V)
    first_ns = min(stand.commands_of("guardian"))
    assert LAST_RESORT_NS <= first_ns - stand.heartbeat.taken_ns < LAST_RESORT_NS + 2 * MS
    assert not stand.guardian.report()["exclusive"]


def test_neutral_that_a_late_command_has_left_is_not_told():
    """The guardian was at neutral while the command was under way: what counts is that it finds the outputs there
    again."""
    stand = Stand()
    stand.run(5, alternating)
    stand.slow.arm(FaultPlan(delay=1.0, delay_s=0.4))
    stand.amplifier.write(FAR_V)
    stand.slow.arm(FaultPlan())
    arrived_ns = stand.clock.now_ns()
    assert stand.heartbeat.neutral_ns < arrived_ns
    assert stand.volts() != pytest.approx([50.0] * 3)
    while not stand.amplifier.safe_step():
        stand.tick()
    assert stand.volts() == pytest.approx([50.0] * 3)
    told_ns = stand.clock.now_ns()
    assert arrived_ns < stand.guardian.report()["neutral_ns"] <= told_ns
    assert stand.commands_of("firmware")[-1] <= arrived_ns
    for _ in range(70):
        stand.tick()
    assert max(t_ns for t_ns, _, _ in stand.path) <= told_ns


def test_a_command_that_has_arrived_is_no_reason_to_end_anybody():
    ended: list[int] = []
    stand = Stand(end=lambda: ended.append(1))
    stand.run(5, alternating)
    at_ns = (stand.clock.now_ns() // STEP_NS + 1) * STEP_NS + 100_000  # in the middle of a transfer
    stand.clock.at(at_ns, lambda _: stand.clock.burn_ns(60 * MS))
    assert stand.run(100, alternating)
    assert ended == []
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_a_guardian_that_does_not_come_is_ended_and_the_firmware_ramps():
    stand = Stand(guardian_steps=False)
    stand.run(5)
    stand.clock.burn_ns(50 * MS)
    assert stand.run(42)
    assert stand.guardian.state is State.DONE
    assert stand.commands_of("guardian") == []
    assert stand.volts() == pytest.approx([50.0] * 3)


def test_close_does_not_wait_for_a_guardian_that_is_gone():
    stand = Stand(guardian_steps=False)
    stand.run(5)
    stand.clock.burn_ns(50 * MS)
    with pytest.raises(SafetyTrip):
        stand.amplifier.write(FAR_V)
    stand.amplifier.close()
    assert stand.guardian.state is State.DONE
    assert stand.volts() == pytest.approx([50.0] * 3)
    assert stand.heartbeat.phase is Phase.IDLE


@pytest.mark.parametrize("repeats", [False, True])
def test_the_word_in_shared_memory_carries_codes_and_flag(repeats: bool):
    heartbeat = Heartbeat.shared()
    assert heartbeat.fd is not None
    assert heartbeat.command_in_flight is None
    begin_command(heartbeat, (0xFFFF, 0, 0x8001), repeats=repeats)
    assert Heartbeat(heartbeat.fd).command_in_flight == ((0xFFFF, 0, 0x8001), repeats)
    heartbeat.end_command()
    assert Heartbeat(heartbeat.fd).command_in_flight is None
