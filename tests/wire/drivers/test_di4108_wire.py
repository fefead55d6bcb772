"""DI-4108 driver against the bytes of DATAQ's command protocol (1 Aug 2019). Every literal is from the manual."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.daq.di4108 import Di4108, packet_code, scan_rate
from hal.clock import VirtualClock
from hal.errors import BenchError, Disconnected, ErrorKind, HalTimeout, Overrun, ProtocolError, WrongDevice
from hal.types import ScanConfig, Status, TimeSource
from tests.wire.drivers.scripted_ports import ScriptedSerial

MS = 1_000_000
STOP = [("w", b"stop\r"), ("r", b"stop\r")]
EIGHT = ScanConfig(1000.0, tuple(range(8)), (5.0,) * 8)
CONFIGURE = [
    *STOP,
    *(
        entry
        for line in [
            b"encode 0",
            b"ps 0",
            b"slist 0 256",  # range code 1 (+-5 V) in bits 11..8, channel in bits 3..0
            b"slist 1 257",
            b"slist 2 258",
            b"slist 3 259",
            b"slist 4 260",
            b"slist 5 261",
            b"slist 6 262",
            b"slist 7 263",
            *(b"filter %d 0" % c for c in range(8)),
            b"dec 1",
            b"srate 60000",  # 60 MHz / 60000 = 1 kHz per channel
            b"endo 3",
            b"dout 0",
        ]
        for entry in (("w", line + b"\r"), ("r", line + b"\r"))
    ),
]


def device(*script: tuple[object, ...]) -> tuple[Di4108, ScriptedSerial, VirtualClock]:
    clock = VirtualClock()
    port = ScriptedSerial(clock, script)
    return Di4108(port, clock), port, clock


def scanning(*script: tuple[object, ...]) -> tuple[Di4108, ScriptedSerial, VirtualClock]:
    daq, port, clock = device(*CONFIGURE, ("w", b"start 0\r"), *script)
    daq.configure(EIGHT)
    daq.start()
    return daq, port, clock


def scan(*values: int) -> bytes:
    """Little-endian two's complement words, one per scan-list entry."""
    return b"".join(bytes((v & 0xFF, v >> 8 & 0xFF)) for v in (*values, *(0,) * (8 - len(values))))


def test_probe_reads_identity():
    daq, port, _ = device(
        *STOP,
        ("w", b"info 1\r"),
        ("r", b"info 1 4108\r"),
        ("w", b"info 2\r"),
        ("r", b"info 2 65\r"),
        ("w", b"info 6\r"),
        ("r", b"info 6 5C76A3E800\r"),
    )
    assert daq.probe() == "DI-4108 firmware 1.01 serial 5C76A3E8"
    port.done()


def test_probe_refuses_another_model():
    daq, _, _ = device(*STOP, ("w", b"info 1\r"), ("r", b"info 1 2008\r"))
    with pytest.raises(WrongDevice, match=r"DI-4108.*2008"):
        daq.probe()


def test_probe_of_a_device_left_scanning():
    daq, port, _ = device(
        ("w", b"stop\r"),
        ("r", bytes(range(16)) * 3),
        ("r", b"\x00\x01sto"),
        ("r", b"p\r"),
        ("w", b"info 1\r"),
        ("r", b"\x00info 1"),  # the manual's stray NUL, and an answer in two pieces
        ("r", b" 4108\r"),
        ("w", b"info 2\r"),
        ("r", b"info 2 7B\r"),
        ("w", b"info 6\r"),
        ("r", b"info 6 12345678\r"),
    )
    assert "firmware 1.23" in daq.probe()
    port.done()


def test_silence_is_a_bounded_wait():
    daq, _, clock = device(("w", b"stop\r"))
    with pytest.raises(HalTimeout, match="no echo of 'stop'"):
        daq.probe()
    assert clock.now_ns() == 500 * MS


def test_configure_sends_the_manuals_words():
    daq, port, _ = device(*CONFIGURE)
    info = daq.configure(EIGHT)
    port.done()
    assert info.rate_hz == 1000.0
    assert info.lsb_V == (5.0 / 32768,) * 8
    assert info.buffer_scans == 128  # 1024-sample FIFO
    assert [c.name for c in daq.channels()] == [f"ai{i}" for i in range(8)]


def test_wrong_echo_is_an_error():
    daq, _, _ = device(*STOP, ("w", b"encode 0\r"), ("r", b"encode 1\r"))
    with pytest.raises(ProtocolError, match=r"'encode 0'.*'encode 1'"):
        daq.configure(EIGHT)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (ScanConfig(1000.0, (0, 0), (5.0, 5.0)), "different numbers"),
        (ScanConfig(1000.0, (8,), (5.0,)), "0..7"),
        (ScanConfig(1000.0, (), ()), "1 to 8"),
        (ScanConfig(1000.0, (0,), (3.0,)), "range_V = 3.0"),
        (ScanConfig(1000.0, (0, 1), (5.0,)), "1 ranges for 2"),
        (ScanConfig(1.0, (0,), (5.0,)), "outside"),
        (ScanConfig(float("nan"), (0,), (5.0,)), "positive"),
    ],
)
def test_impossible_configurations_touch_no_wire(config: ScanConfig, message: str):
    daq, _, _ = device()
    with pytest.raises(BenchError, match=message):
        daq.configure(config)


@pytest.mark.parametrize(
    ("rate_hz", "expected"),
    [(1000.0, (60000, 1)), (2000.0, (30000, 1)), (100.0, (60000, 10)), (160_000.0, (375, 1))],
)
def test_rate_divisors(rate_hz: float, expected: tuple[int, int]):
    srate, dec, real_hz = scan_rate(rate_hz)
    assert (srate, dec) == expected
    assert real_hz == pytest.approx(rate_hz, rel=1e-9)


@pytest.mark.parametrize(
    ("rate_hz", "width", "code"),
    [(1000.0, 8, 0), (1000.0, 3, 0), (4000.0, 8, 0), (8000.0, 8, 0), (16_000.0, 8, 1), (160_000.0, 8, 4), (1e9, 8, 7)],
)
def test_a_packet_fills_within_a_scan_or_125_us(rate_hz: float, width: int, code: int):
    assert packet_code(rate_hz, width) == code


def test_words_of_a_scan():
    daq, port, _ = scanning(
        ("at", 10 * MS), ("r", bytes.fromhex("0000 0100 ffff ff7f 0080 3412 cdab 0040".replace(" ", "")))
    )
    out = np.zeros((4, 8), dtype=np.int16)
    block = daq.read_scans(out, 0.01)
    assert out[0].tolist() == [0, 1, -1, 32767, -32768, 0x1234, 0xABCD - 65536, 0x4000]
    assert (block.n, block.t0_ns, block.dt_ns, block.seq0) == (1, 10 * MS, MS, 0)
    assert block.source is TimeSource.DEVICE_CLOCK
    assert block.status is Status.OK
    port.done()


def test_split_and_bunched_packets():
    daq, port, _ = scanning(
        ("at", 10 * MS),
        ("r", scan(1)[:5]),
        ("r", scan(1)[5:]),
        ("at", 13 * MS),
        ("r", scan(2) + scan(3) + scan(4)),
    )
    out = np.zeros((8, 8), dtype=np.int16)
    assert daq.read_scans(out, 0.01).n == 1
    assert out[0, 0] == 1
    block = daq.read_scans(out, 0.01)
    assert (block.n, block.seq0, block.t0_ns) == (3, 1, 11 * MS)
    assert out[:3, 0].tolist() == [2, 3, 4]
    port.done()


def test_more_scans_than_room_are_kept():
    daq, _, _ = scanning(("at", 10 * MS), ("r", b"".join(scan(i) for i in range(5))))
    out = np.zeros((2, 8), dtype=np.int16)
    seen = []
    while (block := daq.read_scans(out, 0.0)).n:
        seen += out[: block.n, 0].tolist()
    assert seen == [0, 1, 2, 3, 4]
    assert daq.scans == 5


def test_no_data_is_a_timeout_not_an_error():
    daq, _, clock = scanning()
    t0 = clock.now_ns()
    assert daq.read_scans(np.zeros((4, 8), dtype=np.int16), 0.005).n == 0
    assert clock.now_ns() - t0 == 5 * MS


def test_fifo_overflow_delivers_the_good_scans_then_raises():
    daq, _, clock = scanning(("at", 10 * MS), ("r", scan(1)), ("at", 200 * MS), ("r", scan(2) + scan(3) + b"stop 01"))
    out = np.zeros((8, 8), dtype=np.int16)
    assert daq.read_scans(out, 0.01).n == 1
    block = daq.read_scans(out, 0.01)
    assert block.n == 2
    clock.burn_ns(7 * MS)
    with pytest.raises(Overrun, match="stopped itself") as caught:
        daq.read_scans(out, 0.01)
    # scans 1 and 2 were due at 11 and 12 ms, it is now 207 ms
    assert caught.value.lost == 195
    with pytest.raises(Overrun):
        daq.read_scans(out, 0.01)


def test_overflow_tail_in_two_pieces():
    daq, _, _ = scanning(("r", scan(1) + b"sto"), ("r", b"p 01"))
    out = np.zeros((8, 8), dtype=np.int16)
    assert daq.read_scans(out, 0.01).n == 1
    with pytest.raises(Overrun):
        daq.read_scans(out, 0.01)


def test_a_lost_byte_never_shifts_channels():
    whole = [scan(7, 7, 7, 7, 7, 7, 7, 7)] * 8
    broken = [whole[0], whole[1][1:], *whole[2:]]
    daq, port, clock = scanning(*(e for k, w in enumerate(broken) for e in (("at", (10 + k) * MS), ("r", w))))
    out = np.zeros((8, 8), dtype=np.int16)
    assert daq.read_scans(out, 0.01).n == 1
    # a read_scans goes on reading while it has nothing it can trust: here until the fourth suspicious read
    with pytest.raises(ProtocolError, match="bytes were lost") as caught:
        daq.read_scans(out, 0.001)
    assert caught.value.kind is ErrorKind.FRAMING
    assert clock.now_ns() == (10 + 4) * MS
    assert port.script  # it gave up before all of the stream had passed


def test_lost_packets_are_found_by_the_device_clock():
    arrivals = [k for k in range(600) if not 200 <= k < 203]
    daq, _, _ = scanning(*(e for k in arrivals for e in (("at", (10 + k) * MS), ("r", scan(k)))))
    out = np.zeros((8, 8), dtype=np.int16)
    blocks = [daq.read_scans(out, 0.01) for _ in arrivals]
    gaps = [b for b in blocks if b.status & Status.GAP]
    assert [b.lost for b in gaps] == [3]
    assert daq.lost == 3
    assert blocks[-1].seq0 == 599
    assert blocks[-1].t0_ns == (10 + 599) * MS


def test_disconnect_passes_through():
    daq, _, _ = scanning(("raise", Disconnected("gone")))
    with pytest.raises(Disconnected):
        daq.read_scans(np.zeros((4, 8), dtype=np.int16), 0.01)


def test_digital_outputs_echo_only_when_idle():
    daq, port, _ = device(
        ("w", b"dout 1\r"), ("r", b"dout 1\r"), *CONFIGURE[:-2], ("w", b"dout 1\r"), ("r", b"dout 1\r"),
        ("w", b"start 0\r"), ("w", b"dout 2\r"),
    )  # fmt: skip
    daq.write_digital(1)
    daq.configure(EIGHT)
    daq.start()
    daq.write_digital(2)
    port.done()
    with pytest.raises(BenchError, match="only bits 0 and 1"):
        daq.write_digital(4)


@pytest.mark.parametrize("bits", [0, 3])
def test_the_ends_of_the_digital_outputs(bits: int):
    text = f"dout {bits}\r".encode()
    daq, port, _ = device(("w", text), ("r", text))
    daq.write_digital(bits)
    port.done()


@pytest.mark.parametrize("bits", [-1, 4])
def test_beyond_the_digital_outputs_nothing_is_sent(bits: int):
    daq, _, _ = device()
    with pytest.raises(BenchError, match="only bits 0 and 1 are outputs") as caught:
        daq.write_digital(bits)
    assert caught.value.device == daq.name


def test_stop_drains_what_is_on_its_way():
    daq, port, _ = scanning(("w", b"stop\r"), ("r", scan(1) * 3), ("r", scan(2) + b"stop\r"))
    daq.stop()
    port.done()
    daq.close()
    daq.close()
    assert port.closed


def everything(daq: Di4108, reads: int) -> list[int]:
    """Input 0 of all scans that come within ``reads`` reads; all inputs of a scan must be alike."""
    out, found = np.zeros((1024, 8), dtype=np.int16), list[int]()
    for _ in range(reads):
        n = daq.read_scans(out, 0.001).n
        assert (out[:n] == out[:n, :1]).all(), "channels were shifted"
        found += out[:n, 0].tolist()
    return found


def alike(k: int) -> bytes:
    return scan(*(k,) * 8)


@pytest.mark.parametrize("piece", [1, 2, 7, 16, 250, 4095])
def test_a_backlog_comes_in_pieces_that_end_anywhere(piece: int):
    """The host stood still for 3 s; one read of a tty gives at most 4095 bytes, one byte more is there 5 us later."""
    scans = 3001 if piece > 100 else 501
    stream = b"".join(alike(k) for k in range(1, scans))
    pieces = [stream[i : i + piece] for i in range(0, len(stream), piece)]
    backlog = [e for i, p in enumerate(pieces) for e in (("at", 3010 * MS + i * 5000), ("r", p))]
    begins = 3011 + len(pieces) * 5000 // MS
    after = [e for k in range(9) for e in (("at", (begins + k) * MS), ("r", alike(scans + k)))]
    daq, port, _ = scanning(("at", 10 * MS), ("r", alike(0)), *backlog, *after)
    assert everything(daq, len(pieces) + 20) == list(range(scans + 9))
    port.done()


def test_a_packet_may_come_byte_by_byte():
    stream = b"".join(alike(k) for k in range(50))
    daq, port, _ = scanning(
        *(e for i in range(len(stream)) for e in (("at", 10 * MS + i * 62_500), ("r", stream[i : i + 1])))
    )
    assert everything(daq, 60) == list(range(50))
    port.done()


@pytest.mark.parametrize("lost", [5, 4000, 4095, 20_000, 47_990])
def test_a_byte_lost_in_a_backlog_is_known_behind_it_and_shifts_nothing(lost: int):
    stream = b"".join(alike(k) for k in range(1, 3001))
    stream = stream[:lost] + stream[lost + 1 :]
    backlog = [("r", stream[i : i + 4095]) for i in range(0, len(stream), 4095)]
    after = [e for k in range(3001, 3020) for e in (("at", (10 + k) * MS), ("r", alike(k)))]
    daq, _, clock = scanning(("at", 10 * MS), ("r", alike(0)), ("at", 3010 * MS), *backlog, *after)
    found = list[int]()
    with pytest.raises(ProtocolError, match="bytes were lost"):
        found += everything(daq, 30)
    assert clock.now_ns() <= (3010 + 4) * MS


def test_more_backlog_than_there_is_room_for_is_an_overrun():
    stream = b"".join(alike(k % 3000) for k in range(1, 16_500))
    daq, _, _ = scanning(
        ("at", 10 * MS),
        ("r", alike(0)),
        ("at", 16_510 * MS),
        *(("r", stream[i : i + 4095]) for i in range(0, 264_000, 4095)),
    )
    with pytest.raises(Overrun, match="backlog of more than 256 kB") as caught:
        everything(daq, 3)
    assert caught.value.lost == 16_500


def test_a_clock_that_steps_is_told_in_the_blocks():
    times = [(10 + k) * MS + (400_000 if k >= 300 else 0) for k in range(320)]
    daq, _, _ = scanning(*(e for k, t_ns in enumerate(times) for e in (("at", t_ns), ("r", scan(k)))))
    out = np.zeros((8, 8), dtype=np.int16)
    told = [k for k in range(320) if daq.read_scans(out, 0.01).status & Status.SHIFTED]
    assert told == list(range(311, 320))
