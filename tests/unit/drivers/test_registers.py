"""Declared registers: placing and taking bits, and what the register file does on the wire."""

from __future__ import annotations

import pytest

from drivers.imu.registers import Register, RegisterFile, join, signed
from hal.clock import VirtualClock
from hal.errors import HalTimeout, I2cNack, ProtocolError
from tests.wire.drivers.scripted_ports import ScriptedI2c

CONTROL = Register("CONTROL", 0x10, 0x00, "rw", "p. 1")
STATUS = Register("STATUS", 0x11, 0x00, "r", "p. 2")
MODE = CONTROL.bits(5, 3)
ON = CONTROL.bits(0)


def chip(*script: tuple[int, object]) -> tuple[RegisterFile, ScriptedI2c, VirtualClock]:
    clock = VirtualClock()
    bus = ScriptedI2c(script)
    return RegisterFile(bus, clock, 0x42, "chip"), bus, clock


def test_bits():
    assert (MODE.mask, ON.mask) == (0b00111000, 1)
    assert (MODE.place(5), MODE.take(0xFF), MODE.replace(0xFF, 2)) == (0b101000, 7, 0b11010111)
    assert join((MODE, 3), (ON, 1)) == 0b00011001
    for value in (8, -1):
        with pytest.raises(ValueError, match="3 bit of CONTROL"):
            MODE.place(value)


@pytest.mark.parametrize(("value", "bits", "result"), [(0xFFF, 12, -1), (0x7FF, 12, 2047), (0x80, 8, -128), (0, 8, 0)])
def test_twos_complement(value: int, bits: int, result: int):
    assert signed(value, bits) == result


def test_update_keeps_the_other_bits():
    file, bus, _ = chip((0x42, [("w", b"\x10"), ("r", b"\xc7")]), (0x42, [("w", b"\x10\xd7")]))
    assert file.update(MODE, 2) == 0xD7
    bus.done()


def test_read_only_is_not_written():
    file, _, _ = chip()
    with pytest.raises(ProtocolError, match="STATUS is read-only"):
        file.write(STATUS, 1)


@pytest.mark.parametrize("found", [b"\xc7", b"\xff"])
def test_update_is_checked_in_its_field_only(found: bytes):
    file, _, _ = chip(
        (0x42, [("w", b"\x10"), ("r", b"\xc7")]),
        (0x42, [("w", b"\x10\xd7")]),
        (0x42, [("w", b"\x10"), ("r", found)]),
    )
    with pytest.raises(ProtocolError, match=r"CONTROL \(0x10\) was set to 2"):
        file.update_checked(MODE, 2)


def test_waiting_is_bounded_and_a_nack_is_not_yet():
    busy = (0x42, [("w", b"\x10"), ("r", b"\x01")])
    file, bus, clock = chip((0x42, I2cNack("away")), busy, (0x42, [("w", b"\x10"), ("r", b"\x00")]))
    file.await_field(ON, 0, 0.1, "reset")
    assert clock.now_ns() == 2_000_000
    bus.done()
    file, _, clock = chip(*[busy] * 6)
    with pytest.raises(HalTimeout, match=r"chip: reset not done after 0.05 s"):
        file.await_field(ON, 0, 0.05, "reset", step_s=0.01)
    assert clock.now_ns() == 50_000_000
