"""PI E-727 driver: GCS 2.0 texts as in PI's manual E727T0005 and the captures of ecosystem.md section 6b."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest

from drivers.piezo.e727 import E727, RAMP_STEPS
from hal.clock import VirtualClock
from hal.errors import BenchError, Disconnected, HalTimeout, ProtocolError, SafetyTrip, WrongDevice
from tests.wire.drivers.scripted_ports import ScriptedSerial

MS = 1_000_000
IDENTITY = b"(c)2016 Physik Instrumente (PI) GmbH & Co. KG, E-727.3SDA, 0116047977, 13.21.00.02\n"
Script = list[tuple[object, ...]]
PROBE: Script = [
    ("w", b"*IDN?\n"),
    ("r", IDENTITY),
    ("w", b"SAI?\n"),
    ("r", b"1 \n2 \n"),  # every line but the last ends SP LF, so this is not the end
    ("r", b"3\n"),
    ("w", b"ERR?\n"),
    ("r", b"5\n"),  # left over from earlier, forgotten
    ("w", b"SVO 1 0 2 0 3 0\n"),
    ("w", b"ERR?\n"),
    ("r", b"0\n"),
]
AT_NEUTRAL: Script = [
    ("w", b"SVA?\n"),
    ("r", b"1=5.000000000e+01 \n2=5.000000000e+01 \n3=5.000000000e+01\n"),
]
NEUTRAL = b"SVA 1 50.0000 2 50.0000 3 50.0000\n"
QUESTION_STEPS = 2
"""The question where the outputs are, and its answer: a script answers at once."""
ARM: Script = [*PROBE, *AT_NEUTRAL, ("w", NEUTRAL), ("w", NEUTRAL), ("w", b"ERR?\n"), ("r", b"0\n"), *AT_NEUTRAL]


def make(*script: tuple[object, ...], **options: object) -> tuple[E727, ScriptedSerial, VirtualClock]:
    clock = VirtualClock()
    port = ScriptedSerial(clock, script)
    return E727(port, clock, **options), port, clock


def armed(*script: tuple[object, ...], **options: object) -> tuple[E727, ScriptedSerial, VirtualClock]:
    device, port, clock = make(*ARM, *script, **options)
    device.arm()
    clock.burn_ns(20 * MS)
    return device, port, clock


def sva(a: float, b: float, c: float) -> tuple[object, ...]:
    return ("w", f"SVA 1 {a:.4f} 2 {b:.4f} 3 {c:.4f}\n".encode())


def test_probe_reads_identity_axes_and_sets_the_servo():
    device, port, _ = make(*PROBE)
    assert "E-727.3SDA" in device.probe()
    port.done()


def test_from_the_probe_on_nothing_is_loaded_or_compiled_for_a_ramp_to_neutral(monkeypatch: pytest.MonkeyPatch):
    """A run that fails before it arms ramps outputs that another program left; that may not wait for a compiler."""
    device, port, _ = make(*PROBE, *AT_NEUTRAL, ("w", NEUTRAL), *AT_NEUTRAL)
    device.probe()
    monkeypatch.setitem(sys.modules, "drivers.piezo.e727_kernels", None)  # an import fails
    assert [device.safe_step() for _ in range(3)] == [False, False, True]
    port.done()


def test_an_answer_under_way_is_not_taken_for_another_one():
    """Armed again after a hold, while the answer to ``ERR?`` is under way: its "0" was taken for voltages."""
    device, port, _ = armed(("w", b"ERR?\n"), ("r", b"0\n"), *ARM[len(PROBE) :])
    device.link.ask_error()
    device.arm()
    port.done()


def test_the_time_of_the_question_where_the_outputs_are_is_the_ramps():
    """A run that was stopped before it armed was at neutral 22 ms later, with a promise of 21 ms."""
    asked: Script = [("w", b"SVA?\n"), ("at", 8 * MS), ("r", b"1=0.0 \n2=0.0 \n3=0.0\n")]
    at_once_V = 4 * 50 / RAMP_STEPS  # at the slew limit: 20 V in the millisecond of one step
    device, port, clock = make(*asked, *(sva(V, V, V) for V in (at_once_V, 50.0)), *AT_NEUTRAL)
    while not device.safe_step():
        clock.burn_ns(MS)
    assert clock.now_ns() <= (RAMP_STEPS + QUESTION_STEPS) * MS
    port.done()


FEW = b"1=5.000000000e+01 \n2=5.000000000e+01\n"


@pytest.mark.parametrize(
    ("script", "act"),
    [
        ([*PROBE, ("w", b"SVA?\n"), ("r", FEW)], lambda device: device.arm()),
        ([*ARM[:-2], ("w", b"SVA?\n"), ("r", FEW)], lambda device: device.arm()),
        ([("w", b"SVA?\n"), ("r", b"1=5.0e+01\n")], lambda device: device.safe_step()),
        ([("w", b"VOL? 1 2 3\n"), ("r", FEW)], lambda device: device.readback_V()),
    ],
)
def test_an_answer_with_too_few_values_is_an_error_of_the_device(script: Script, act: Callable[[E727], object]) -> None:
    """It was a bare ValueError, which nobody above the HAL catches."""
    device, _, _ = make(*script)
    with pytest.raises(ProtocolError, match=r"answer to '(SVA|VOL)\?.*not 3 finite values") as caught:
        act(device)
    assert caught.value.device == "piezo"


def test_the_range_of_a_servo_stage_needs_three_values() -> None:
    servo = [("w", b"SVO 1 1 2 1 3 1\n") if step == ("w", b"SVO 1 0 2 0 3 0\n") else step for step in PROBE]
    device, _, _ = make(*servo, ("w", b"TMN?\n"), ("r", b"1=0 \n2=0\n"), mode="servo")
    with pytest.raises(ProtocolError, match=r"answer to 'TMN\?'"):
        device.probe()


def test_probe_refuses_another_controller():
    device, _, _ = make(("w", b"*IDN?\n"), ("r", b"(c)2015 Physik Instrumente, E-709.CHG, 1, 2\n"))
    with pytest.raises(WrongDevice, match=r"E-727.*E-709"):
        device.probe()


def test_probe_needs_three_axes():
    device, _, _ = make(*PROBE[:2], ("w", b"SAI?\n"), ("r", b"1\n"))
    with pytest.raises(WrongDevice, match="axes 1, 2, 3"):
        device.probe()


def test_silence_is_a_bounded_wait():
    device, _, clock = make(("w", b"*IDN?\n"))
    with pytest.raises(HalTimeout, match="IDN"):
        device.probe()
    assert clock.now_ns() == 500 * MS


def test_set_command_error_is_told_in_words():
    device, _, _ = make(*PROBE[:-1], ("r", b"303\n"))
    with pytest.raises(ProtocolError, match=r"error 303.*open-loop motion with the servo on"):
        device.probe()


def test_arm_verifies_what_the_controller_was_told():
    device, port, _ = make(*ARM[:-1], ("r", b"1=5.0e+01 \n2=5.0e+01 \n3=4.9e+01\n"))
    with pytest.raises(SafetyTrip, match="self-test"):
        device.arm()
    port.done()


def test_newest_value_goes_out_at_the_command_rate():
    device, port, clock = armed(sva(51, 50, 50), sva(61, 50, 50), sva(71, 50, 50), slew_V_per_s=1e9)
    for k in range(25):
        device.write(np.array([51.0 + k, 50.0, 50.0]))
        clock.burn_ns(MS)
    port.done()  # 100 Hz: ticks 0, 10, 20
    assert (device.commands, device.superseded) == (1 + 3, 22)  # one was the arming ramp's


def test_a_bad_value_trips_in_its_own_tick():
    device, port, clock = armed(sva(51, 50, 50))
    device.write(np.array([51.0, 50.0, 50.0]))
    clock.burn_ns(MS)
    with pytest.raises(SafetyTrip, match="channel 2"):
        device.write(np.array([51.0, 50.0, np.nan]))
    port.done()


def test_errors_are_asked_for_without_waiting():
    # one command was the arming ramp's: the 20th of all asks
    commands = [sva(50, 50, 50)] * 19
    device, port, clock = armed(*commands, ("w", b"ERR?\n"), ("wait",), ("r", b"30"), ("r", b"2\n"), rate_hz=200.0)
    for _ in range(91):
        device.write(np.full(3, 50.0))
        clock.burn_ns(MS)
    # asked in tick 90; nothing, then half an answer, then the rest
    assert port.script[0] == ("wait",)
    device.write(np.full(3, 50.0))
    device.write(np.full(3, 50.0))
    with pytest.raises(ProtocolError, match=r"error 302.*voltage out of limits"):
        device.write(np.full(3, 50.0))
    port.done()


def test_an_error_answer_that_never_comes_is_a_lost_link():
    class Deaf(ScriptedSerial):
        def write(self, data: bytes, timeout_s: float) -> None:
            if self.script:
                super().write(data, timeout_s)

    clock = VirtualClock()
    device = E727(Deaf(clock, ARM), clock, rate_hz=200.0)
    device.arm()
    clock.burn_ns(20 * MS)
    ticks = 0
    with pytest.raises(HalTimeout, match="link lost"):  # noqa: PT012
        while ticks < 1000:
            device.write(np.full(3, 50.0))
            clock.burn_ns(MS)
            ticks += 1
    assert 590 <= ticks <= 600  # asked after 19 commands of 5 ms, then 500 ms


def test_partial_writes_are_finished_before_anything_else():
    class Narrow(ScriptedSerial):
        """Takes ten bytes at a time once ``narrow``, as a full transmit queue does."""

        narrow = False
        taken = b""

        def write(self, data: bytes, timeout_s: float) -> None:
            if not self.narrow:
                super().write(data, timeout_s)
                return
            self.taken += data[:10]
            if len(data) > 10:
                raise HalTimeout("full", partial=10)

    clock = VirtualClock()
    port = Narrow(clock, ARM)
    device = E727(port, clock, rate_hz=200.0, slew_V_per_s=1e9)
    device.arm()
    clock.burn_ns(20 * MS)
    port.narrow = True
    for k in range(40):
        device.write(np.array([50.0 + k, 50.0, 50.0]))
        clock.burn_ns(MS)
    lines = port.taken.split(b"\n")
    assert all(line.startswith(b"SVA 1 ") and line.endswith(b" 2 50.0000 3 50.0000") for line in lines[:-1])
    assert len(lines) >= 8


def test_safe_ramp_ends_exactly_at_neutral():
    steps = [sva(*(v + (50 - v) * k / RAMP_STEPS for v in (60, 40, 50))) for k in (1, 6, RAMP_STEPS)]
    device, port, clock = armed(sva(60, 40, 50), *steps, *AT_NEUTRAL, rate_hz=200.0, slew_V_per_s=1e9)
    device.write(np.array([60.0, 40.0, 50.0]))
    clock.burn_ns(5 * MS)
    done = []
    for _ in range(RAMP_STEPS + QUESTION_STEPS):
        done.append(device.safe_step())
        clock.burn_ns(MS)
    assert done == [False] * (RAMP_STEPS + QUESTION_STEPS - 1) + [True]
    port.done()


def away(*script: tuple[object, ...]) -> tuple[E727, ScriptedSerial, VirtualClock]:
    """Return a controller one volt away from neutral, whose ramp is over; ``script`` follows its last step."""
    steps = [sva(51 - k / RAMP_STEPS, 50, 50) for k in (1, RAMP_STEPS)]
    device, port, clock = armed(sva(51, 50, 50), *steps, *script)
    device.write(np.array([51.0, 50.0, 50.0]))
    clock.burn_ns(10 * MS)
    for _ in range(RAMP_STEPS):
        assert not device.safe_step()
        clock.burn_ns(MS)
    return device, port, clock


def test_neutral_is_reached_when_the_controller_says_so_and_not_when_the_port_has_taken_it():
    """A line may hold back what its port has taken: 18 V from neutral, a run said that neutral was confirmed."""
    whole = AT_NEUTRAL[1][1]
    assert isinstance(whole, bytes)
    device, port, _ = away(AT_NEUTRAL[0], ("wait",), ("r", whole[:30]), ("r", whole[30:]))
    assert [device.safe_step() for _ in range(4)] == [False, False, False, True]
    port.done()


def test_another_answer_than_neutral_is_an_error_and_neutral_is_sent_anew():
    device, port, _ = away(AT_NEUTRAL[0], ("r", b"1=5.1e+01 \n2=5.0e+01 \n3=5.0e+01\n"), ("w", NEUTRAL), *AT_NEUTRAL)
    assert not device.safe_step()
    with pytest.raises(ProtocolError, match=r"neutral is .* the controller answers \[51.0, 50.0, 50.0\]"):
        device.safe_step()
    assert [device.safe_step() for _ in range(3)] == [False, False, True]
    port.done()


def test_an_answer_that_does_not_come_is_asked_for_again():
    """The first answer is lost. It once kept every later step from being made."""
    device, port, clock = away(AT_NEUTRAL[0], ("wait",), ("w", NEUTRAL), *AT_NEUTRAL)
    assert not device.safe_step()
    clock.burn_ns(501 * MS)
    with pytest.raises(HalTimeout, match="no answer to 'SVA"):
        device.safe_step()
    assert [device.safe_step() for _ in range(3)] == [False, False, True]
    port.done()


def test_closing_waits_for_the_answer_as_well():
    device, port, _ = away(AT_NEUTRAL[0], ("wait",), AT_NEUTRAL[1])
    assert not device.safe_step()
    device.close()
    port.done()


def test_close_brings_the_outputs_to_neutral_first():
    steps = [sva(60 + (50 - 60) * k / RAMP_STEPS, 50, 50) for k in (1, 6, RAMP_STEPS)]
    device, port, clock = armed(sva(60, 50, 50), *steps, *AT_NEUTRAL, rate_hz=200.0, slew_V_per_s=1e9)
    device.write(np.array([60.0, 50.0, 50.0]))
    clock.burn_ns(5 * MS)
    device.close()
    port.done()
    assert port.closed
    device.close()  # nothing is left to be done, nothing is sent


def test_close_says_when_neutral_was_not_reached_and_closes_all_the_same():
    device, port, clock = armed(sva(60, 50, 50), rate_hz=200.0, slew_V_per_s=1e9)
    device.write(np.array([60.0, 50.0, 50.0]))
    clock.burn_ns(5 * MS)

    def cut(data: bytes, timeout_s: float) -> None:
        raise Disconnected("the cable is out", device="tty")

    port.write = cut
    with pytest.raises(Disconnected, match="the cable is out; the outputs were NOT brought to neutral"):
        device.close()
    assert port.closed


def test_servo_mode_commands_micrometres():
    um = b"1=7.500000000e+00 \n2=7.500000000e+00 \n3=7.500000000e+00\n"
    neutral = b"MOV 1 7.5000 2 7.5000 3 7.5000\n"
    device, port, clock = make(
        *PROBE[:7],
        ("w", b"SVO 1 1 2 1 3 1\n"),
        ("w", b"ERR?\n"),
        ("r", b"0\n"),
        ("w", b"TMN?\n"),
        ("r", b"1=0.0e+00 \n2=0.0e+00 \n3=0.0e+00\n"),
        ("w", b"TMX?\n"),
        ("r", b"1=1.5e+01 \n2=1.5e+01 \n3=1.5e+01\n"),
        ("w", b"MOV?\n"),
        ("r", um),
        ("w", neutral),
        ("w", neutral),
        ("w", b"ERR?\n"),
        ("r", b"0\n"),
        ("w", b"MOV?\n"),
        ("r", um),
        ("w", b"MOV 1 9.0000 2 7.5000 3 7.5000\n"),
        mode="servo",
        slew_V_per_s=1e9,
    )
    device.arm()
    clock.burn_ns(20 * MS)
    device.write(np.array([60.0, 50.0, 50.0]))
    port.done()


def test_readback_asks_for_output_voltages():
    device, port, _ = make(("w", b"VOL? 1 2 3\n"), ("r", b"1=1.0e+01 \n2=2.0e+01 \n3=3.0e+01\n"))
    assert device.readback_V().tolist() == [10.0, 20.0, 30.0]
    port.done()


def test_garbled_answer_names_itself():
    device, _, _ = make(("w", b"VOL? 1 2 3\n"), ("r", b"what\n"))
    with pytest.raises(ProtocolError, match="what"):
        device.readback_V()


@pytest.mark.parametrize("options", [{"rate_hz": 201.0}, {"rate_hz": 0.0}, {"neutral_V": 120.0}])
def test_impossible_settings(options: dict[str, object]):
    with pytest.raises(BenchError):
        make(**options)
