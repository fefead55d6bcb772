"""Piezo amplifier behind an AD5696R (data sheet rev. B, Tables 7 and 8): every byte of every transfer."""

from __future__ import annotations

import re

import numpy as np
import pytest

from drivers.output_guard import RAMP_STEPS
from drivers.output_guard_steps import SLEW_LIMITED
from drivers.piezo.dac_amplifier import DacAmplifier
from hal.clock import VirtualClock
from hal.errors import BenchError, I2cNack, ProtocolError, SafetyTrip, WrongDevice
from tests.wire.drivers.scripted_ports import ScriptedI2c

MS = 1_000_000
A = 0x0C
PROBE = [
    (A, [("w", b"\x70\x00\x00")]),  # internal reference on
    (A, [("w", b"\x50\x00\x0f")]),  # LDAC pin ignored
    (A, [("w", b"\x40\x00\x00")]),  # normal operation
    (A, [("w", b"\x18\x5a\xa5")]),  # input register D
    (A, [("w", b"\x08"), ("r", b"\x5a\xa5")]),
    (A, [("w", b"\x18\x00\x00")]),
    (A, [("w", b"\x08"), ("r", b"\x00\x00")]),
    (A, [("w", b"\x18\xa5\x5a")]),
    (A, [("w", b"\x08"), ("r", b"\xa5\x5a")]),
]
NEUTRAL = bytes.fromhex("800080008000")


def update(a: int, b: int, c: int) -> tuple[int, object]:
    words = [bytes((0x11 + (0, 1, 3)[i], v >> 8, v & 0xFF)) for i, v in enumerate((a, b, c))]
    return (A, [*(("w", w) for w in words), ("w", b"\x27\x00\x00")])


def readback(data: bytes) -> tuple[int, object]:
    return (A, [("w", b"\x01"), ("r", data)])


def make(*script: tuple[int, object], **options: float) -> tuple[DacAmplifier, ScriptedI2c, VirtualClock]:
    clock = VirtualClock()
    bus = ScriptedI2c(script)
    return DacAmplifier(bus, clock, A, **options), bus, clock


def armed(*script: tuple[int, object], **options: float) -> tuple[DacAmplifier, ScriptedI2c, VirtualClock]:
    amplifier, bus, clock = make(
        *PROBE,
        readback(NEUTRAL),
        update(0x8000, 0x8000, 0x8000),
        readback(NEUTRAL),
        *script,
        **({"slew_V_per_s": 10_000.0} | options),
    )
    amplifier.arm()
    clock.burn_ns(MS)
    return amplifier, bus, clock


def test_probe_moves_nothing():
    amplifier, bus, _ = make(*PROBE)
    assert amplifier.probe() == "AD5696R at 0x0C, 0 .. 100 V"
    amplifier.close()
    bus.done()


def test_probe_refuses_a_12_bit_part():
    amplifier, _, _ = make(*PROBE[:4], (A, [("w", b"\x08"), ("r", b"\x5a\xa0")]))
    with pytest.raises(WrongDevice, match=r"0x5AA5.*0x5AA0"):
        amplifier.probe()


def test_arm_ramps_from_where_the_dac_is():
    steps = [update(*([round(0x8000 * k / RAMP_STEPS)] * 3)) for k in range(1, RAMP_STEPS + 1)]
    amplifier, bus, clock = make(*PROBE, readback(bytes(6)), *steps, readback(NEUTRAL))
    amplifier.arm()
    assert clock.now_ns() == (RAMP_STEPS - 1) * MS
    bus.done()


def test_arm_fails_when_the_readback_differs():
    amplifier, _, _ = make(
        *PROBE, readback(NEUTRAL), update(0x8000, 0x8000, 0x8000), readback(bytes.fromhex("800080007fff"))
    )
    with pytest.raises(SafetyTrip, match="self-test"):
        amplifier.arm()
    with pytest.raises(SafetyTrip, match="not armed"):
        amplifier.write(np.full(3, 50.0))


def test_all_three_in_one_transfer():
    # 100 V / 65536 per code
    amplifier, bus, _ = armed(update(0x8000 + 655, 0x8000 - 655, 0x8000 + 1))
    assert amplifier.write(np.array([51.0, 49.0, 50.0015])) == 0
    bus.done()


def test_clipping_is_reported_and_counted():
    amplifier, bus, _ = armed(update(0xFFFF, 0x0000, 0x8000), slew_V_per_s=1e9)
    assert amplifier.write(np.array([100.0, -1.0, 50.0])) == 0b011
    assert amplifier.guard.clipped == 2
    bus.done()


def test_slew_limit_follows_the_clock():
    # 10 V/ms: one tick allows 10 V = 6553.6 codes
    amplifier, bus, clock = armed(update(39322, 26214, 0x8000), update(0xFFFF, 0x0000, 0x8000))
    assert amplifier.write(np.array([99.0, 1.0, 50.0])) == 0b011
    assert amplifier.guard.state.words[SLEW_LIMITED] == 2
    clock.burn_ns(4 * MS)
    assert amplifier.write(np.array([99.9984, 0.0, 50.0])) == 0
    bus.done()


def test_a_stall_buys_no_large_step():
    amplifier, bus, clock = armed(update(0x8000 + 3277, 0x8000, 0x8000), slew_V_per_s=1000.0)
    clock.burn_ns(1000 * MS)
    assert amplifier.write(np.array([99.0, 50.0, 50.0])) == 0b001  # 5 ms worth: 5 V
    bus.done()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_trips(bad: float):
    amplifier, bus, _ = armed()
    with pytest.raises(SafetyTrip, match="channel 1"):
        amplifier.write(np.array([50.0, bad, 50.0]))
    bus.done()


def test_safe_ramp_takes_its_steps_and_disarms():
    far = update(0xFFFF, 0x0000, 0x8000)
    ramp = [
        update(*(round((v + (50.0 - v) * k / RAMP_STEPS) * 655.36) for v in (100.0 - 100.0 / 65536, 0.0, 50.0)))
        for k in range(1, RAMP_STEPS + 1)
    ]
    amplifier, bus, _ = armed(far, *ramp, readback(NEUTRAL), slew_V_per_s=1e9)
    amplifier.write(np.array([100.0, 0.0, 50.0]))
    assert [amplifier.safe_step() for _ in range(RAMP_STEPS)] == [False] * (RAMP_STEPS - 1) + [True]
    bus.done()
    with pytest.raises(SafetyTrip):
        amplifier.write(np.full(3, 50.0))


def test_a_failed_step_is_offered_again():
    first = update(0x8000 + 6144, 0x8000, 0x8000)  # 59.375 V
    amplifier, bus, _ = armed(update(0x8000 + 6554, 0x8000, 0x8000), (A, I2cNack("busy")), first, slew_V_per_s=1e9)
    amplifier.write(np.array([60.0, 50.0, 50.0]))
    with pytest.raises(I2cNack):
        amplifier.safe_step()
    assert amplifier.safe_step() is False
    bus.done()


def test_close_goes_to_neutral_first():
    ramp = [update(0x8000 + round(6553.6 * (1.0 - k / RAMP_STEPS)), 0x8000, 0x8000) for k in range(1, RAMP_STEPS + 1)]
    amplifier, bus, clock = armed(update(0x8000 + 6554, 0x8000, 0x8000), *ramp, readback(NEUTRAL), slew_V_per_s=1e9)
    amplifier.write(np.array([60.0, 50.0, 50.0]))
    t0 = clock.now_ns()
    amplifier.close()
    assert clock.now_ns() - t0 < 20 * MS
    amplifier.close()
    bus.done()


def test_the_ramp_is_over_when_the_dac_says_so():
    jumps = [update(0x8000, 0x8000, 0x8000), readback(bytes.fromhex("8000800033b0"))] * 2
    amplifier, bus, _ = armed(*jumps, slew_V_per_s=1e9)
    for _ in range(2):
        with pytest.raises(SafetyTrip, match=r"13232"):
            amplifier.safe_step()
    bus.done()


@pytest.mark.parametrize(
    ("held", "says"),
    [
        ("800080008000a55a", ""),
        ("8000800080008000", "has restarted .*0x8000 instead of 0xA55A"),
        ("8000c0008000a55a", r"output 2 holds 75\.000 V and was told 50\.000 V"),
    ],
)
def test_verify_reads_all_four_registers(held: str, says: str):
    amplifier, bus, _ = armed(readback(bytes.fromhex(held)))
    found = amplifier.verify()
    assert re.search(says, found) if says else found == ""
    bus.done()


def test_readback_is_in_volts():
    amplifier, bus, _ = make(readback(bytes.fromhex("00008000c000")))
    assert amplifier.readback_V() == pytest.approx([0.0, 50.0, 75.0])
    bus.done()


@pytest.mark.parametrize("options", [{"neutral_V": 101.0}, {"neutral_V": -1.0}, {"lo_V": 60.0}, {"hi_V": 100.1}])
def test_impossible_settings(options: dict[str, float]):
    with pytest.raises(BenchError):
        make(**options)


def read_with(update_: tuple[int, object], held: bytes) -> tuple[int, object]:
    """An update and its read-back in one transfer."""
    address, segments = update_
    return (address, [*segments, ("w", b"\x01"), ("r", held)])  # type: ignore[misc]


def test_read_back_is_part_of_the_transfer_and_a_wrong_bit_is_named():
    told = (0x8000, 0x8400, 0x8000)
    script = (
        read_with(update(*told), bytes.fromhex("800084008000")),
        read_with(update(*told), bytes.fromhex("8000c4008000")),
        readback(bytes.fromhex("8000c4008000")),  # the ramp begins where the outputs are
    )
    amplifier, _, clock = armed(*script, read_back=True, slew_V_per_s=20_000.0)
    volts = np.array([50.0, 0x8400 * 100.0 / 65536.0, 50.0])
    assert amplifier.write(volts) == 0
    clock.burn_ns(MS)
    with pytest.raises(ProtocolError, match=r"output 2 holds 76\.562 V and was told 51\.562 V"):
        amplifier.write(volts)
    clock.burn_ns(MS)
    with pytest.raises(AssertionError):  # the script ends before the first step of the ramp
        amplifier.safe_step()
    assert amplifier.guard.last_V[1] == pytest.approx(0xC400 * 100.0 / 65536.0)


def test_a_command_that_is_read_back_took_force_before_the_reading():
    amplifier, _, clock = armed(
        read_with(update(0x8000, 0x8000, 0x8000), NEUTRAL), update(0x8000, 0x8000, 0x8000), read_back=True
    )
    amplifier.write(np.full(3, 50.0))
    assert clock.now_ns() - next(amplifier.guard.sent_commands()).sent_ns == 200_000
