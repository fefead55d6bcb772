"""The emulated DI-4108 against its protocol document (DATAQ, 1 August 2019), transcribed byte by byte."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.devices.di4108 import Di4108
from tests.wire.emulators.held import HeldVoltages

MS = 1_000_000


def make(**options: object) -> tuple[Di4108, HeldVoltages]:
    truth = HeldVoltages(8)
    return Di4108(truth, **options), truth  # type: ignore[arg-type]


def ask(device: Di4108, command: bytes, t_ns: int = 0) -> bytes:
    device.receive(command + b"\r", t_ns)
    return device.take(4096)


def start_eight_channels(device: Di4108, t_ns: int = 0) -> None:
    """Eight channels at +-5 V (range code 1, page 44), 1 kHz: 60e6 / 60000."""
    for command in [b"srate 60000", b"dec 1", *(b"slist %d %d" % (i, 0x100 + i) for i in range(8))]:
        assert ask(device, command, t_ns) == command + b"\r"
    device.receive(b"start 0\r", t_ns)


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        (b"info 0", b"info 0 DATAQ\r"),  # page 20
        (b"info 1", b"info 1 4108\r"),
        (b"info 2", b"info 2 79\r"),  # 0x79 = 121: firmware 1.21, the first with deca (page 52)
        (b"info 9", b"info 9 60000000\r"),  # page 48, dividend
        (b"ps 1", b"ps 1\r"),  # page 21
        (b"encode 0", b"encode 0\r"),  # page 38
        (b"slist 0 258", b"slist 0 258\r"),  # page 39; analog 2 at +-5 V
        (b"slist 0 2562", b"command not found\r"),  # range code 10 is legal for other models only (page 44)
        (b"filter 1 2", b"filter 1 2\r"),  # page 52
        (b"dec 128", b"dec 128\r"),
        (b"deca 3", b"deca 3\r"),
        (b"ffl 20", b"ffl 20\r"),  # page 55
        (b"endo 20", b"endo 20\r"),  # page 57
        (b"dout 4", b"dout 4\r"),  # page 58
        (b"reset 1", b"reset 1\r"),  # page 59
        (b"led 2", b"led 2\r"),
        (b"stop", b"stop\r"),  # page 50, always echoes
    ],
)
def test_echo_of_each_command(command: bytes, reply: bytes) -> None:
    device, _ = make()
    assert ask(device, command) == reply


def test_ps_query_answers_bytes() -> None:
    device, _ = make()
    assert ask(device, b"ps 1") == b"ps 1\r"
    assert ask(device, b"ps") == b"ps 32\r"  # page 21


def test_info_5_keeps_a_description_with_spaces() -> None:
    device, _ = make()
    assert ask(device, b'info 5 "Dev 0"') == b'info 5 "Dev 0"\r'  # page 21
    assert ask(device, b"info 5") == b"info 5 Dev 0\r"


def test_eol_is_kept_for_ascii_mode_and_has_no_effect_before() -> None:
    """Page 38. The vendor's own programs send it before ``encode 1`` and then read lines."""
    device, _ = make()
    assert ask(device, b"eol 1") == b"eol 1\r"
    assert ask(device, b"eol 3") == b"command not found\r"
    assert device.settings.eol == b"\n"
    assert ask(device, b"encode 1") == b"encode 1\r"


@pytest.mark.parametrize(
    "command",
    [
        b"srate 374",
        b"srate 65536",
        b"dec 0",
        b"dec 513",
        b"deca 40001",
        b"filter 8 0",
        b"slist 1",
        b"ps 8",
        b"nonsense",
    ],
)
def test_what_the_manual_excludes_is_refused(command: bytes) -> None:
    device, _ = make()
    assert ask(device, command) == b"command not found\r"


def test_scan_list_is_filled_in_order_and_holds_each_channel_once() -> None:
    device, _ = make()
    assert ask(device, b"slist 2 1") == b"command not found\r"  # page 40: sequentially
    assert ask(device, b"slist 0 1") == b"slist 0 1\r"
    assert ask(device, b"slist 1 1") == b"command not found\r"  # only once
    assert ask(device, b"slist 1 2") == b"slist 1 2\r"
    assert device.settings.words == [1, 2]
    assert ask(device, b"slist 0 3") == b"slist 0 3\r"
    assert device.settings.words == [3]  # page 39: position 0 resets the count


def test_stream_is_little_endian_twos_complement_with_documented_codes() -> None:
    device, truth = make()
    start_eight_channels(device)
    # page 66: volts = full scale * counts / 32768, here 5 V; counts 32767, -32768, 1, -1, 0, clipped both ways
    lsb = 5.0 / 32768
    truth.volts_V[:] = [32767 * lsb, -5.0, lsb, -lsb, 0.0, 7.0, -7.0, 2.5]
    device.advance_to(MS)
    assert device.take(4096) == bytes.fromhex("ff7f 0080 0100 ffff 0000 ff7f 0080 0040")


def test_start_is_silent_and_no_command_echoes_while_scanning_except_stop() -> None:
    device, _ = make()
    start_eight_channels(device)
    assert device.take(10) == b""  # page 49: never echoes
    assert ask(device, b"led 4") == b""  # page 16
    assert device.led == 4
    assert ask(device, b"stop") == b"stop\r"


def test_scan_clock_is_dividend_over_srate_dec_deca() -> None:
    device, _ = make()
    for command in (b"srate 6000", b"dec 10", b"deca 2"):
        ask(device, command)
    device.receive(b"start\r", 5 * MS)
    device.advance_to(5 * MS + 100 * MS)
    assert device.scans == 50  # 60e6 / (6000 * 10 * 2) = 500 Hz
    assert device.next_event_ns() == 5 * MS + 102 * MS


def test_scan_instants_do_not_drift_when_the_period_is_not_whole() -> None:
    seen: list[int] = []
    truth = HeldVoltages(8)

    def analog(t_ns: int) -> np.ndarray:
        seen.append(t_ns)
        return truth.volts_V

    device = Di4108(analog)
    ask(device, b"srate 7001")
    device.receive(b"start 0\r", 0)
    for k in range(1, 11):
        device.advance_to(k * 10**8)
        device.take(10_000)
    assert seen == [k * 7001 * 50 // 3 for k in range(1, len(seen) + 1)]  # 7001 / 60 MHz in ns, exactly
    assert len(seen) == 60_000_000 // 7001 == 8570


def test_packet_is_sent_only_when_full() -> None:
    device, _ = make()
    ask(device, b"ps 1")  # 32 bytes: two scans of eight
    start_eight_channels(device)
    device.advance_to(MS)
    assert device.take(100) == b""  # page 21
    device.advance_to(2 * MS)
    assert len(device.take(100)) == 32


def test_fifo_overflow_stops_the_scan_with_stop_01_and_odd_length() -> None:
    device, _ = make()
    start_eight_channels(device)
    device.advance_to(128 * MS)
    assert device.scanning
    assert device.fifo_samples == 1024
    device.advance_to(129 * MS)  # the 129th scan finds no room (page 50)
    assert not device.scanning
    stream = device.take(100_000)
    assert len(stream) == 2 * 1024 + 7
    assert stream.endswith(b"stop 01")
    device.advance_to(500 * MS)
    assert device.take(100) == b""


def test_overflow_counts_what_the_carrier_says_is_unread_and_fills_up_to_the_last_sample() -> None:
    device, _ = make()
    device.unread = 2048 - 6  # room for three samples
    start_eight_channels(device)
    device.advance_to(MS)
    assert device.take(100) == b"\0" * 6 + b"stop 01"


def test_draining_in_time_never_overflows() -> None:
    device, _ = make()
    start_eight_channels(device)
    total = 0
    for k in range(1, 20):
        device.advance_to(k * 127 * MS)
        total += len(device.take(100_000))
    assert total == 19 * 127 * 16


@pytest.mark.parametrize(("mode", "expected"), [(0, 4.0), (1, 2.5), (2, 4.0), (3, 1.0)])
def test_oversampling_modes(mode: int, expected: float) -> None:
    """Page 51: last point, average, maximum, minimum of dec samples."""
    values = iter([1.0, 3.0, 2.0, 4.0])
    volts = np.zeros(8)

    def analog(t_ns: int) -> np.ndarray:
        volts[0] = next(values) if mode else 4.0
        return volts

    device = Di4108(analog)
    for command in (b"srate 15000", b"dec 4", b"filter 0 %d" % mode, b"ps 0", b"slist 0 256"):
        ask(device, command)
    device.receive(b"start\r", 0)
    device.advance_to(MS)
    device.receive(b"stop\r", MS)
    assert np.frombuffer(device.take(2), "<i2")[0] == round(expected * 32768 / 5.0)


def test_digital_rate_and_counter_words() -> None:
    device, _ = make()
    device.digital_levels = 0b1010101
    device.pulse_hz = 1000.0
    # page 44: digital 8, rate 9 with range code 5 (2 kHz), counter 10
    for command in (b"srate 60000", b"slist 0 8", b"slist 1 %d" % (5 << 8 | 9), b"slist 2 10", b"reset 1"):
        assert ask(device, command).endswith(b"\r")
    device.receive(b"start\r", 0)
    device.advance_to(MS)
    device.receive(b"stop\r", MS)
    data = device.take(6)
    assert data[:2] == bytes((0b10, 0b1010101))  # byte 0: D1, D0 inverted; byte 1: D6..D0 (page 61)
    rate, counter = np.frombuffer(data[2:6], "<i2").astype(int)
    assert (rate + 32768) / 65536 * 2000.0 == 1000.0  # page 60
    assert counter + 32768 == 1


def test_switches_follow_endo_and_dout() -> None:
    seen: list[tuple[int, int]] = []
    device, _ = make(on_switches=lambda mask, t_ns: seen.append((mask, t_ns)))
    ask(device, b"dout 3", 1)  # still inputs: no switch moves
    ask(device, b"endo 3", 2)
    ask(device, b"dout 1", 3)
    ask(device, b"dout 0", 4)
    ask(device, b"dout 2", 5)
    assert seen == [(1, 3), (0, 4), (2, 5)]
    device.digital_levels = 0b0100100
    assert ask(device, b"din", 6) == b"din %d\r" % (0b0100100 | 2)


def test_ascii_output() -> None:
    device, truth = make()
    truth.volts_V[:] = [0.5, -1.25, 0, 0, 0, 0, 0, 0]
    for command in (b"encode 1", b"eol 2", b"slist 0 1", b"slist 1 0"):
        ask(device, command)
    device.receive(b"start 0\r", 0)
    first_scan_ns = device.next_event_ns() or 0
    device.receive(b"stop\r", first_scan_ns)
    assert device.take(100) == b"-1.2500,0.5000\r\nstop\r"  # page 71: comma-separated, order of the list


def test_frozen_device_says_nothing_and_goes_on_at_its_next_scan() -> None:
    device, _ = make()
    start_eight_channels(device)
    device.advance_to(MS)
    device.take(100)
    device.frozen = True
    device.advance_to(50 * MS)
    assert device.take(100) == b""
    device.frozen = False
    device.advance_to(52 * MS)
    assert len(device.take(100)) == 32


def test_clock_error_makes_more_scans() -> None:
    device, _ = make(clock_error_ppb=1_000_000)  # 0.1 % fast
    start_eight_channels(device)
    for k in range(1, 11):
        device.advance_to(k * 100 * MS)
        device.take(10_000)
    assert device.scans == 1001


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.binary(max_size=40), st.integers(0, 5 * MS), st.booleans()), max_size=12))
def test_no_bytes_from_the_host_break_it(chunks: list[tuple[bytes, int, bool]]) -> None:
    device, _ = make()
    t_ns = 0
    for data, dt_ns, valid in chunks:
        t_ns += dt_ns
        device.receive((b"slist 0 " if valid else b"") + data + (b"\r" if valid else b""), t_ns)
        device.advance_to(t_ns)
        device.take(64)
        assert device.fifo_samples <= 1024 + 64 * 64  # echoes may add, samples may not


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.sampled_from(["start 0", "stop", "dec 2", "ps 3", "encode 1", "srate 375", "filter 0 1", "slist 0 8"]))
)
def test_legal_commands_in_any_order_keep_the_fifo_bounded(commands: list[str]) -> None:
    device, _ = make()
    for i, command in enumerate(commands):
        device.receive(command.encode() + b"\r", i * 100_000)
    device.advance_to(len(commands) * 100_000 + 2 * MS)
    assert len(device.take(10**6)) <= 2048 + 7 + 32 * max(1, len(commands))
