"""The emulated ADS1115 against its data sheet (SBAS444), transactions transcribed as literals."""

from __future__ import annotations

import pytest

from sim_devices.devices.ads1115 import Ads1115
from tests.wire.emulators.held import HeldVoltages

WAKE_UP_NS = 25_000


def make(rate_error: float = 0.0) -> tuple[Ads1115, HeldVoltages]:
    truth = HeldVoltages(4)
    return Ads1115(truth, rate_error=rate_error), truth


def register(device: Ads1115, pointer: int, t_ns: int = 0) -> int:
    assert device.write(bytes((pointer,)), t_ns) == 1
    return int.from_bytes(device.read(2, t_ns), "big")


def test_reset_values() -> None:
    device, _ = make()
    # Register Map: conversion 0000h, config 8583h, Lo_thresh 8000h, Hi_thresh 7FFFh
    assert [register(device, p) for p in range(4)] == [0x0000, 0x8583, 0x8000, 0x7FFF]


def test_quick_start_example_continuous_ain0_ain1() -> None:
    """Data sheet, Quickstart Guide: write 01 84 83, then pointer 00, then read two bytes (AIN0 - AIN1, 128 SPS)."""
    device, truth = make()
    truth.volts_V[:2] = [1.5, 0.5]
    assert device.write(bytes.fromhex("018483"), 0) == 3
    assert device.write(bytes.fromhex("00"), 1) == 1
    assert device.read(2, 1) == b"\x00\x00"  # nothing converted yet
    t_ns = WAKE_UP_NS + 7_812_500  # 1 / 128 s
    assert device.read(2, t_ns - 1) == b"\x00\x00"
    assert device.read(2, t_ns) == round(1.0 * 32768 / 2.048).to_bytes(2, "big")
    assert device.conversions == 1
    device.advance_to(t_ns + 10 * 7_812_500)
    assert device.conversions == 11  # goes on without being asked


@pytest.mark.parametrize(
    ("code", "rate_hz"), [(0, 8), (1, 16), (2, 32), (3, 64), (4, 128), (5, 250), (6, 475), (7, 860)]
)
def test_conversion_time_is_one_over_the_data_rate(code: int, rate_hz: int) -> None:
    device, _ = make()
    config = 0xC003 | 0x0100 | code << 5  # OS, AIN0, single shot
    device.write(bytes((1, config >> 8, config & 0xFF)), 0)
    done_ns = WAKE_UP_NS + round(1e9 / rate_hz)
    assert register(device, 1, done_ns - 1) & 0x8000 == 0  # OS reads 0 while converting
    assert register(device, 1, done_ns) & 0x8000
    assert device.next_event_ns() is None  # powered down again
    assert device.conversions == 1


def test_data_rate_error_within_ten_percent() -> None:
    device, _ = make(rate_error=-0.1)
    device.write(bytes.fromhex("01c1e3"), 0)  # single shot, 860 SPS
    assert device.next_event_ns() == WAKE_UP_NS + round(1e9 / 774)
    with pytest.raises(ValueError, match="10 %"):
        make(rate_error=0.11)


@pytest.mark.parametrize(
    ("mux", "volts"),
    [(0, 0.1 - 0.2), (1, 0.1 - 0.8), (2, 0.2 - 0.8), (3, 0.4 - 0.8), (4, 0.1), (5, 0.2), (6, 0.4), (7, 0.8)],
)
def test_multiplexer(mux: int, volts: float) -> None:
    device, truth = make()
    truth.volts_V[:] = [0.1, 0.2, 0.4, 0.8]
    config = 0x8000 | mux << 12 | 2 << 9 | 0x0100 | 7 << 5 | 3  # +-2.048 V
    device.write(bytes((1, config >> 8, config & 0xFF)), 0)
    assert register(device, 0, 10**7) == round(volts * 32768 / 2.048) & 0xFFFF


@pytest.mark.parametrize(
    ("pga", "full_scale_V"), [(0, 6.144), (1, 4.096), (2, 2.048), (3, 1.024), (4, 0.512), (5, 0.256), (7, 0.256)]
)
def test_gain_and_clipping(pga: int, full_scale_V: float) -> None:
    device, truth = make()
    for volts, code in ((full_scale_V / 2, 0x4000), (full_scale_V * 2, 0x7FFF), (-full_scale_V * 2, 0x8000)):
        truth.volts_V[0] = volts
        config = 0xC000 | pga << 9 | 0x0100 | 7 << 5 | 3
        device.write(bytes((1, config >> 8, config & 0xFF)), device.conversions * 10**7)
        assert register(device, 0, device.conversions * 10**7 + 5 * 10**6) == code


def test_result_is_the_mean_over_the_conversion() -> None:
    device, truth = make()
    truth.volts_V[0] = 1.0
    device.write(bytes.fromhex("01c5e3"), 0)  # AIN0, +-2.048 V, single shot, 860 SPS
    truth.volts_V[0] = 0.5
    assert register(device, 0, 10**7) == round(0.75 * 32768 / 2.048)


def test_config_write_during_a_conversion_lets_it_end() -> None:
    device, truth = make()
    truth.volts_V[:] = [1.0, 0.25, 0, 0]
    device.write(bytes.fromhex("01c5e3"), 0)
    device.write(bytes.fromhex("01d5e3"), 100_000)  # AIN1; OS has no effect while converting
    assert register(device, 0, 10**7) == round(1.0 * 32768 / 2.048)
    assert device.conversions == 1


def test_conversion_register_is_read_only_and_thresholds_are_not() -> None:
    device, _ = make()
    device.write(bytes.fromhex("001234"), 0)
    device.write(bytes.fromhex("021234"), 0)
    device.write(bytes.fromhex("035678"), 0)
    assert [register(device, p) for p in (0, 2, 3)] == [0, 0x1234, 0x5678]


def test_general_call_reset() -> None:
    device, _ = make()
    device.write(bytes.fromhex("018483"), 0)
    assert device.general_call(b"\x06", 10)  # Reset and Power-Up
    assert device.next_event_ns() is None
    assert [register(device, p) for p in range(4)] == [0x0000, 0x8583, 0x8000, 0x7FFF]


def test_comparator_asserts_after_the_queue_and_releases_below_the_low_threshold() -> None:
    device, truth = make()
    device.write(bytes.fromhex("022000"), 0)  # Lo 0x2000 = 0.512 V at +-2.048 V
    device.write(bytes.fromhex("034000"), 0)  # Hi 0x4000 = 1.024 V
    truth.volts_V[0] = 1.5
    device.write(bytes.fromhex("0144e1"), 0)  # continuous, AIN0, 860 SPS, queue: two conversions
    period_ns = round(1e9 / 860)
    device.advance_to(WAKE_UP_NS + period_ns)
    assert not device.alert_asserted
    device.advance_to(WAKE_UP_NS + 2 * period_ns)
    assert device.alert_asserted
    truth.volts_V[0] = 0.7  # between the thresholds: stays
    device.advance_to(WAKE_UP_NS + 5 * period_ns)
    assert device.alert_asserted
    truth.volts_V[0] = 0.2
    device.advance_to(WAKE_UP_NS + 8 * period_ns)
    assert not device.alert_asserted


def test_conversion_ready_mode() -> None:
    device, _ = make()
    device.write(bytes.fromhex("020000"), 0)  # Lo MSB 0
    device.write(bytes.fromhex("038000"), 0)  # Hi MSB 1: ALERT/RDY signals every conversion
    device.write(bytes.fromhex("01c1e0"), 0)
    assert not device.alert_asserted
    device.advance_to(10**7)
    assert device.alert_asserted


def test_nack_hooks_and_freeze() -> None:
    device, _ = make()
    device.nack_address = True
    assert not device.acknowledges()
    device.nack_data = True
    assert device.write(b"\x01\xc1\xe3", 0) == 0
    device.nack_data = False
    device.write(b"\x01\xc1\xe3", 0)
    device.frozen = True
    assert register(device, 1, 10**9) & 0x8000 == 0  # never ready


@pytest.mark.parametrize(("looks", "tolerance_V"), [(1, 0.2501), (4, 0.126), (8, 0.0626)])
def test_a_step_within_a_conversion_is_averaged(looks: int, tolerance_V: float) -> None:
    """1 V from the 30th part of a hundred on: a mean of 0.7 V, to half of one look's part."""
    length_ns = 1_162_791
    step_ns = WAKE_UP_NS + round(0.3 * length_ns)
    device = Ads1115(lambda t_ns: [float(t_ns >= step_ns), 0.0, 0.0, 0.0], looks=looks)
    device.write(bytes.fromhex("01c1e3"), 0)  # AIN0, single shot, 6.144 V, 860 SPS
    device.advance_to(WAKE_UP_NS + length_ns)
    assert device.conversions == 1
    assert register(device, 0, 2_000_000) * 6.144 / 32768 == pytest.approx(0.7, abs=tolerance_V)
