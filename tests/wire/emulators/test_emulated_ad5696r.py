"""The emulated AD5696R against its data sheet (rev. B): Table 7, Table 8, read and readback sequences."""

from __future__ import annotations

import pytest

from sim_devices.devices.ad5696r import Ad5696r


def test_power_on_state_follows_rstsel() -> None:
    assert Ad5696r(midscale=True).output_V == [2.5] * 4  # gain 2: half of 5 V
    assert Ad5696r(midscale=False).output_V == [0.0] * 4
    assert Ad5696r(gain=1).output_V == [1.25] * 4


@pytest.mark.parametrize(("address", "channel"), [(0x1, 0), (0x2, 1), (0x4, 2), (0x8, 3)])
def test_write_and_update_one_channel(address: int, channel: int) -> None:
    seen: list[tuple[int, float, int]] = []
    dac = Ad5696r(on_output=lambda c, v, t: seen.append((c, v, t)))
    assert dac.write(bytes((0x30 | address, 0x40, 0x00)), 77) == 3  # command 0011
    assert seen == [(channel, 1.25, 77)]
    assert dac.output_V[channel] == 1.25


def test_full_scale_is_one_lsb_below_twice_the_reference() -> None:
    dac = Ad5696r()
    dac.write(b"\x3f\xff\xff", 0)
    assert dac.output_V == [5.0 * 65535 / 65536] * 4


def test_input_registers_wait_for_the_update_command() -> None:
    seen: list[int] = []
    dac = Ad5696r(on_output=lambda c, v, t: seen.append(c))
    for first in (0x11, 0x12, 0x14):  # command 0001, LDAC pin high
        dac.write(bytes((first, 0x10, 0x00)), 1)
    assert dac.output_V[:3] == [2.5] * 3
    dac.write(b"\x27\x00\x00", 2)  # command 0010, channels A, B, C
    assert dac.output_V == [0.3125, 0.3125, 0.3125, 2.5]
    assert seen == [0, 1, 2]


def test_ldac_held_low_makes_input_registers_transparent_unless_masked() -> None:
    dac = Ad5696r(ldac_low=True)
    dac.write(b"\x50\x00\x02", 0)  # command 0101: channel B ignores the pin
    dac.write(b"\x13\x00\x00", 0)  # command 0001 to A and B
    assert dac.output_V == [0.0, 2.5, 2.5, 2.5]


def test_readback_of_the_input_registers_increments_and_wraps() -> None:
    dac = Ad5696r()
    dac.write(b"\x11\x12\x34", 0)
    dac.write(b"\x12\x56\x78", 0)
    dac.write(b"\x04", 0)  # Read Operation: command byte alone selects channel C
    assert dac.read(2, 0) == b"\x80\x00"
    dac.write(b"\x01", 0)
    assert dac.read(6, 0) == bytes.fromhex("1234 5678 8000")  # Multiple DAC Readback Sequence
    dac.write(b"\x08", 0)
    assert dac.read(4, 0) == bytes.fromhex("8000 1234")  # A follows D
    dac.write(b"\x0e", 0)
    assert dac.read(2, 0) == b"\x12\x34"  # several selected: A


def test_power_down_and_up_again() -> None:
    dac = Ad5696r()
    dac.write(b"\x40\x00\x0c", 0)  # command 0100: channel B (DB3, DB2) three-state
    assert dac.output_V == [2.5, 0.0, 2.5, 2.5]
    dac.write(b"\x40\x00\x00", 0)
    assert dac.output_V == [2.5] * 4


def test_reference_setup_and_software_reset() -> None:
    dac = Ad5696r()
    dac.write(b"\x70\x00\x01", 0)  # command 0111, DB0 = 1: reference off
    assert dac.output_V == [0.0] * 4
    dac.write(b"\x3f\x00\x00", 0)
    dac.write(b"\x60\x00\x00", 0)  # command 0110
    assert dac.output_V == [2.5] * 4


def test_incomplete_word_changes_no_output_and_reserved_commands_do_nothing() -> None:
    dac = Ad5696r()
    dac.write(b"\x3f\x00", 0)
    dac.write(b"\x8f\x00\x00", 0)
    assert dac.output_V == [2.5] * 4


def test_no_general_call_and_nack() -> None:
    dac = Ad5696r()
    assert not dac.general_call(b"\x06", 0)
    dac.nack_data = True
    assert dac.write(b"\x3f\x00\x00", 0) == 0
    assert dac.output_V == [2.5] * 4
    dac.nack_address = True
    assert not dac.acknowledges()
