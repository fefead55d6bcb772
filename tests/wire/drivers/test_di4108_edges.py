"""DI-4108 driver: what it says of itself, larger packets, limits of waiting, a new start. Bytes as in the manual."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from drivers.daq.di4108 import Di4108, scan_rate
from hal.clock import VirtualClock
from hal.errors import BenchError, HalError, HalTimeout, Overrun, ProtocolError, WrongDevice
from hal.types import ChannelInfo, ScanBlock, ScanConfig, TimeSource
from tests.wire.drivers.scripted_ports import ScriptedSerial
from tests.wire.drivers.test_di4108_wire import CONFIGURE, EIGHT, MS, STOP, alike, device, scan, scanning

OUT = np.zeros((64, 8), dtype=np.int16)


def test_the_inputs_are_told_with_range_and_resolution():
    daq, _, _ = device(*CONFIGURE)
    info = daq.configure(EIGHT)
    assert daq.channels()[3] == ChannelInfo("ai3", "V", -5.0, 5.0, 5.0 / 32768)
    assert isinstance(info.buffer_scans, int)
    assert info.simultaneous is False  # one converter behind a multiplexer


def test_fast_scans_come_in_larger_packets():
    """8 inputs at 16 kHz are 16 bytes in 62.5 us: packets of 32, ``ps 1``; half of one is not believed."""
    script = [(kind, data.replace(b"ps 0", b"ps 1").replace(b"srate 60000", b"srate 3750")) for kind, data in CONFIGURE]
    stream = b"".join(alike(k) for k in range(16))
    pieces = [e for i in range(0, 256, 16) for e in (("at", 10 * MS + i * 3_906), ("r", stream[i : i + 16]))]
    daq, port, _ = device(*script, ("w", b"start 0\r"), *pieces)
    assert daq.configure(ScanConfig(16000.0, tuple(range(8)), (5.0,) * 8)).rate_hz == 16000.0
    daq.start()
    assert [daq.read_scans(OUT, 0.01).n for _ in range(8)] == [2] * 8
    port.done()


@pytest.mark.parametrize("rate_hz", [7.3, 99.7, 333.3, 1234.5, 44_100.0, 60e6 / (65535 * 512), 60e6 / 375])
def test_the_divisors_are_the_nearest_that_there_are(rate_hz: float):
    srate, dec, real_hz = scan_rate(rate_hz)
    every = [
        (abs(60e6 / (s * d) - rate_hz), d)
        for d in range(1, 513)
        for s in (math.floor(60e6 / rate_hz / d), math.ceil(60e6 / rate_hz / d))
        if 375 <= s <= 65535
    ]
    assert real_hz == 60e6 / (srate * dec)
    assert abs(real_hz - rate_hz) == pytest.approx(min(every)[0], abs=1e-9)
    # of equals the smallest, which filters least
    assert dec == min(d for miss, d in every if miss < min(every)[0] + 1e-9)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_is_a_positive_number(rate_hz: float):
    with pytest.raises(BenchError, match="not a positive number"):
        scan_rate(rate_hz)


@pytest.mark.parametrize("rate_hz", [1.78, 160_300.0])
def test_the_refusal_of_a_rate_says_what_there_is(rate_hz: float):
    with pytest.raises(BenchError, match=r"is outside 1\.79 \.\. 160000 Hz of the DI-4108"):
        scan_rate(rate_hz)


def test_a_block_of_nothing_has_the_number_of_the_next_scan():
    daq, _, _ = scanning(("at", 10 * MS), ("r", scan(1) + scan(2)), ("wait",))
    assert daq.read_scans(OUT, 0.01).n == 2
    assert daq.read_scans(OUT, 0.01) == ScanBlock(0, 10 * MS, 0, 2, TimeSource.DEVICE_CLOCK)


def test_pieces_of_a_packet_do_not_make_a_wait_longer():
    daq, _, clock = scanning(("at", 2 * MS), ("r", scan(1)[:5]), ("wait",))
    assert daq.read_scans(OUT, 0.005).n == 0
    assert clock.now_ns() == 5 * MS


def test_scans_that_are_there_are_not_waited_for():
    daq, _, clock = scanning(("at", 10 * MS), ("r", scan(1) + scan(2)))
    one = np.zeros((1, 8), dtype=np.int16)
    assert daq.read_scans(one, 0.01).n == 1
    assert daq.read_scans(one, 0.01).n == 1
    assert clock.now_ns() == 10 * MS


def test_a_start_after_an_overflow_begins_anew():
    daq, port, _ = scanning(
        ("at", 10 * MS), ("r", scan(1) + b"stop 01"), ("w", b"start 0\r"), ("at", 30 * MS), ("r", scan(7))
    )
    assert daq.read_scans(OUT, 0.01).n == 1
    with pytest.raises(Overrun, match="read for 128 scans"):
        daq.read_scans(OUT, 0.01)
    daq.start()
    block = daq.read_scans(OUT, 0.03)
    assert (block.n, block.seq0, OUT[0, 0]) == (1, 0, 7)
    port.done()


def test_scans_before_an_overflow_are_handed_out_one_by_one():
    daq, _, _ = scanning(("at", 10 * MS), ("r", scan(1) + scan(2) + scan(3) + b"stop 01"))
    one = np.zeros((1, 8), dtype=np.int16)
    seen = []
    for _ in range(3):
        assert daq.read_scans(one, 0.01).n == 1
        seen.append(int(one[0, 0]))
    assert seen == [1, 2, 3]
    with pytest.raises(Overrun):
        daq.read_scans(one, 0.01)


def test_an_answer_may_come_byte_by_byte_with_strays_in_it():
    answers = [
        (b"info 1\r", b"\ninfo 1 4108\r"),
        (b"info 2\r", b"info 2 65\x00\r"),
        (b"info 6\r", b"info 6 5C76A3E8\r"),
    ]
    script = [e for asked, told in answers for e in (("w", asked), *(("r", bytes((byte,))) for byte in told))]
    daq, port, _ = device(*STOP, *script)
    assert daq.probe() == "DI-4108 firmware 1.01 serial 5C76A3E8"
    port.done()


def test_an_answer_without_end_is_a_bounded_wait():
    more = [e for k in range(1, 20) for e in (("at", k * 100 * MS), ("r", b"x"))]
    daq, _, clock = device(*STOP, ("w", b"info 1\r"), *more)
    with pytest.raises(HalTimeout, match=r"no answer to 'info 1' within 0\.5 s, got b'xxxx") as caught:
        daq.probe()
    assert caught.value.partial == 5
    assert caught.value.device == "daq"
    assert clock.now_ns() <= 600 * MS


def test_scans_that_nobody_fetched_are_gone_with_a_new_start():
    many = b"".join(scan(k) for k in range(1, 6))
    daq, port, _ = scanning(
        ("at", 10 * MS), ("r", many), ("w", b"stop\r"), ("r", b"stop\r\n\x00"), ("w", b"start 0\r"),
        ("at", 30 * MS), ("r", scan(9)),
    )  # fmt: skip
    two = np.zeros((2, 8), dtype=np.int16)
    assert daq.read_scans(two, 0.01).n == 2
    daq.stop()
    daq.start()
    block = daq.read_scans(two, 0.03)
    assert (block.n, block.seq0, two[0, 0]) == (1, 0, 9)
    port.done()


def test_a_device_that_has_stopped_itself_is_not_told_to_stop():
    daq, port, _ = scanning(("at", 10 * MS), ("r", scan(1) + b"stop 01"))
    daq.read_scans(OUT, 0.01)
    daq.close()
    port.done()
    assert port.closed


def test_stop_waits_no_longer_than_its_limit_for_an_echo_that_never_comes():
    """A device that goes on sending scans: bounded by the time, not by what comes."""
    more = [e for k in range(1, 20) for e in (("at", k * 100 * MS), ("r", scan(k)))]
    daq, _, clock = device(("w", b"stop\r"), *more)
    with pytest.raises(HalTimeout, match=r"no echo of 'stop' within 0\.5 s"):
        daq.stop()
    assert clock.now_ns() <= 600 * MS


Script = list[tuple[object, ...]]


def overflown(daq: Di4108) -> None:
    daq.configure(EIGHT)
    daq.start()
    daq.read_scans(OUT, 0.01)


@pytest.mark.parametrize(
    ("script", "call", "error", "says"),
    [
        ([*STOP, ("w", b"info 1\r"), ("r", b"info 1 2008\r")], Di4108.probe, WrongDevice, "found model '2008'"),
        (
            [*STOP, ("w", b"info 1\r"), ("r", b"info 1 4108\r"), ("w", b"info 2\r"), ("r", b"info 2 xy\r")],
            Di4108.probe,
            ProtocolError,
            "firmware version 'xy' is not hexadecimal",
        ),
        ([*STOP, ("w", b"info 1\r"), ("r", b"nonsense\r")], Di4108.probe, ProtocolError, "answer was 'nonsense'"),
        ([("w", b"stop\r")], Di4108.stop, HalTimeout, "no echo of 'stop'"),
        ([], Di4108.channels, BenchError, r"configure\(\) comes first"),
        (
            [],
            lambda daq: daq.configure(ScanConfig(1000.0, (0, 0), (5.0, 5.0))),
            BenchError,
            "1 to 8 different numbers of 0..7",
        ),
        ([], lambda daq: daq.configure(ScanConfig(1000.0, (0,), (5.0, 5.0))), BenchError, "2 ranges for 1 channels"),
        ([], lambda daq: daq.configure(ScanConfig(1000.0, (0,), (3.0,))), BenchError, "range_V = 3.0 is not one of"),
        (
            [*STOP, ("w", b"encode 0\r"), ("r", b"no\r")],
            lambda daq: daq.configure(EIGHT),
            ProtocolError,
            "echo was 'no'",
        ),
        ([*CONFIGURE, ("w", b"start 0\r"), ("r", b"stop 01")], overflown, Overrun, "the device stopped itself"),
        ([], lambda daq: daq.write_digital(4), BenchError, "only bits 0 and 1"),
    ],
)
def test_each_error_names_the_device(
    script: Script, call: Callable[[Di4108], object], error: type[HalError], says: str
):
    clock = VirtualClock()
    daq = Di4108(ScriptedSerial(clock, script), clock, name="daq0")
    with pytest.raises(error, match=says) as caught:
        call(daq)
    assert caught.value.device == "daq0"
