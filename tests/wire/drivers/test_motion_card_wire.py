"""Motion card: text line and packet of Erat 2018, section 4.2, with errata 112, 113 and 121; BLE of 4.3.2."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.ble_motion_card import BleMotionCard
from drivers.imu.base import ImuSample
from drivers.motion_card import MotionCard
from drivers.motion_card_protocol import (
    LONGEST_LINE,
    ActivationButton,
    CardReading,
    LineParser,
    SpikeFilter,
    decode_battery,
    decode_line,
    decode_packet,
)
from hal.clock import VirtualClock
from hal.errors import HalTimeout, ProtocolError, WrongDevice
from hal.types import PortInfo, Status
from tests.wire.drivers.scripted_ports import ScriptedSerial

G = 9.80665
DEG = math.pi / 180.0
MS = 1_000_000
EXAMPLE = bytes.fromhex("035afaae3f0e000000010000eb4700")  # Fig. 4.13
LINE = b"#:858:-1362:16142:0:1:0:-5305:0:\r\n"  # the same as text
IMU_UUID = "bf470002-767b-467d-a4c0-e8e050c0d96e"
BATTERY_UUID = "00002a19-0000-1000-8000-00805f9b34fb"


# the packet


def test_packet_of_the_document():
    reading = decode_packet(EXAMPLE)
    assert reading == CardReading((858, -1362, 16142, 0, 1, 0, -5305), 0)
    ax, ay, az = reading.values[:3]
    assert math.hypot(ax, ay, az) / 16384 == pytest.approx(0.990, abs=5e-4)  # erratum 112
    assert reading.values[6] / 340 + 36.53 == pytest.approx(20.9, abs=0.05)


@pytest.mark.parametrize("packet", [EXAMPLE[:-1], EXAMPLE + b"\0", EXAMPLE[:-1] + b"\3", b""])
def test_other_packets_are_refused(packet: bytes):
    with pytest.raises(ValueError, match=r"packet has|card status"):
        decode_packet(packet)


def test_battery_level():
    assert decode_battery(b"\x25") == 37  # Fig. 4.13
    for value in (b"\x65", b"", b"\0\0"):
        with pytest.raises(ValueError, match="battery"):
            decode_battery(value)


# the line


def test_line_of_the_document():
    assert decode_line(LINE[:-2], "raw") == decode_packet(EXAMPLE)
    scaled = decode_line(b"#:0.0524:-0.0831:0.9852:0.0:0.0610:0.0:20.93:2:", "scaled")
    assert scaled == CardReading((0.0524, -0.0831, 0.9852, 0.0, 0.061, 0.0, 20.93), 2)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"#:",
        b"#:1:2:3:4:5:6:7:0",
        b"#:1:2:3:4:5:6:7:",
        b"#:1:2:3:4:5:6:7:8:0:",
        b"#:1:2:3:4:5:6:7:3:",
        b"#:1:2:3:4:5:6:7:00:",
        b"#:1::3:4:5:6:7:0:",
        b"#:1:+2:3:4:5:6:7:0:",
        b"#:1: 2:3:4:5:6:7:0:",
        b"#:1:2.5:3:4:5:6:7:0:",
        b"#:1:nan:3:4:5:6:7:0:",
        b"#:1:2_0:3:4:5:6:7:0:",
        b"#:1:32768:3:4:5:6:7:0:",
        b":1:2:3:4:5:6:7:0:",
        "#:1:٣:3:4:5:6:7:0:".encode(),
    ],
)
def test_what_is_no_line(line: bytes):
    with pytest.raises(ValueError, match=r"#:|field|counts|status"):
        decode_line(line, "raw")


def test_a_full_battery():
    assert decode_battery(b"\x64") == 100


def test_of_a_stream_without_ends_the_newest_beginning_is_kept():
    parser = LineParser()
    parser.feed(LINE)
    parser.feed(b"#:9:#:8:" + b"x" * LONGEST_LINE)
    assert parser.discarded_bytes == 8 + LONGEST_LINE, "its last beginning is too long itself"
    parser.feed(b"x" * LONGEST_LINE + b"#:9:" + LINE[:9])
    assert parser.discarded_bytes == 8 + 2 * LONGEST_LINE + 4
    assert parser.feed(LINE[9:]) == [decode_packet(EXAMPLE)]
    assert parser.bad_frames == 2


def test_the_first_half_of_a_beginning_is_kept_too():
    parser = LineParser()
    parser.feed(b"x" * LONGEST_LINE + b"#")
    assert parser.discarded_bytes == LONGEST_LINE
    assert parser.feed(LINE[1:]) == [decode_packet(EXAMPLE)]
    assert parser.bad_frames == 0, "it began in the middle"


def test_after_a_reconnection_the_middle_of_a_line_is_no_bad_frame():
    parser = LineParser()
    parser.feed(LINE + LINE[:5])
    parser.reset()
    assert parser.feed(LINE[7:] + LINE) == [decode_packet(EXAMPLE)]
    assert (parser.frames, parser.bad_frames) == (2, 0)


def test_a_card_that_wakes_up_pressed_is_not_in_its_long_press():
    button = ActivationButton()
    button.update(True, 0)
    assert button.update(False, 100 * 1_000_000) == 1


def test_starting_in_the_middle_is_no_bad_frame():
    parser = LineParser()
    assert parser.feed(LINE[7:] + LINE) == [decode_packet(EXAMPLE)]
    assert (parser.frames, parser.bad_frames, parser.discarded_bytes) == (1, 0, len(LINE) - 9)


def test_a_lost_line_end_costs_one_frame():
    parser = LineParser()
    found = parser.feed(LINE + LINE[:-2] + LINE + LINE)
    assert (len(found), parser.frames, parser.bad_frames) == (3, 3, 1)


def test_noise_without_end_does_not_fill_memory():
    parser = LineParser()
    parser.feed(LINE)
    for _ in range(1000):
        parser.feed(b"x" * 1000)
    assert parser.discarded_bytes == 1_000_000
    assert parser.feed(b"\r\n" + LINE) == [decode_packet(EXAMPLE)]


def test_line_start_without_end_does_not_fill_memory_either():
    parser = LineParser()
    for _ in range(100):
        parser.feed(b"#:" + b"1" * 300)
    assert parser.discarded_bytes > 29_000
    assert parser.feed(b"\r\n" + LINE) == [decode_packet(EXAMPLE)]


counts = st.integers(-32768, 32767)
readings = st.builds(CardReading, st.tuples(*[counts] * 7), st.integers(0, 2))


def line_of(reading: CardReading) -> bytes:
    return ("#:" + ":".join(str(int(v)) for v in (*reading.values, reading.status)) + ":\r\n").encode()


@settings(max_examples=60, deadline=None)
@given(st.lists(readings, max_size=8), st.lists(st.integers(0, 300), max_size=8))
def test_lines_survive_any_cutting(sent: list[CardReading], cuts: list[int]):
    stream = b"".join(map(line_of, sent))
    parser = LineParser()
    found: list[CardReading] = []
    for a, b in zip([0, *sorted(cuts)], [*sorted(cuts), len(stream)], strict=True):
        found += parser.feed(stream[a:b])
    assert found == sent
    assert (parser.frames, parser.bad_frames) == (len(sent), 0)


@settings(max_examples=150, deadline=None)
@given(st.lists(readings, min_size=4, max_size=4), st.integers(0, 400), st.binary(max_size=6), st.integers(0, 60))
def test_a_disturbance_never_costs_a_frame_it_did_not_touch(
    sent: list[CardReading], at: int, noise: bytes, removed: int
):
    """``removed`` bytes from ``at`` on become ``noise``: every line outside arrives, in order."""
    lines = [line_of(reading) for reading in sent]
    stream = b"".join(lines)
    at %= len(stream)
    end = min(at + removed, len(stream))
    parser = LineParser()
    found = parser.feed(stream[:at] + noise + stream[end:])
    ends = np.cumsum([len(line) for line in lines])
    starts = ends - [len(line) for line in lines]
    before = [reading for reading, stop in zip(sent, ends, strict=True) if stop <= at]
    after = [reading for reading, start in zip(sent, starts, strict=True) if start >= max(end, at)]
    assert found[: len(before)] == before
    assert found[len(found) - len(after) :] == after if after else True
    # nothing in between but what the disturbance hit (a changed digit cannot be seen: there is no checksum)
    assert len(found) <= len(sent) + 1


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=400))
def test_noise_never_raises_and_the_next_good_line_is_found(noise: bytes):
    parser = LineParser()
    parser.feed(noise)
    parser.feed(b"\r\n")
    assert parser.feed(LINE)[-1] == decode_packet(EXAMPLE)


# the button


def test_exactly_half_a_second_is_long():
    for held_ms, status in [(1, 1), (499, 1), (500, 2), (501, 2), (3000, 2)]:
        button = ActivationButton()
        button.update(True, 0)
        assert button.update(False, held_ms * MS) == status


def test_the_long_press_acts_while_it_is_held():
    button = ActivationButton()
    assert [button.update(True, t * MS) for t in (0, 499, 500, 900)] == [0, 0, 2, 2]
    assert button.update(False, 901 * MS) == 2


def test_a_short_press_ends_whatever_is_active():
    button = ActivationButton()
    history: list[int] = []
    for start_ms, held_ms in [(0, 100), (1000, 100), (2000, 700), (3000, 100), (4000, 100), (5000, 700)]:
        button.update(True, start_ms * MS)
        history.append(button.update(False, (start_ms + held_ms) * MS))
    assert history == [1, 0, 2, 0, 1, 2]
    assert button.presses == 6


def test_spikes_are_held_back_until_20_ms_after_the_release():
    spikes = SpikeFilter()
    pressed = {30, 40}
    admitted = [t for t in range(0, 100, 10) if spikes.admit(t in pressed, t * MS)]
    assert admitted == [0, 10, 20, 60, 70, 80, 90]
    assert spikes.held == 3


# the card on its port


def card(*script: tuple[object, ...], **options: object) -> tuple[MotionCard, ScriptedSerial, VirtualClock]:
    clock = VirtualClock()
    port = ScriptedSerial(clock, script)
    return MotionCard(port, clock, **options), port, clock


def test_a_reading_in_si():
    motion, port, _ = card(("at", 10 * MS), ("r", LINE))
    out = ImuSample()
    assert motion.read(out) is Status.OK
    assert out.accel_mps2 == pytest.approx(np.array([858, -1362, 16142]) / 16384 * G)
    assert out.gyro_rad_s == pytest.approx([0.0, DEG / 16.4, 0.0])
    assert out.temperature_C == pytest.approx(20.927, abs=1e-3)
    assert out.raw.tolist() == [858, -1362, 16142, 0, 1, 0, -5305]
    assert (out.t_ns, out.seq, motion.card_status) == (10 * MS, 0, 0)
    assert motion.read(out) is Status.STALE
    assert (out.t_ns, out.seq, motion.stale) == (10 * MS, 0, 1)
    port.done()


def test_scaled_text():
    motion, _, _ = card(("r", b"#:0:0:-1.5:90:0:0:25.5:1:\r\n"), fields="scaled")
    out = ImuSample()
    motion.read(out)
    assert out.accel_mps2[2] == pytest.approx(-1.5 * G)
    assert out.gyro_rad_s[0] == pytest.approx(math.pi / 2)
    assert (out.temperature_C, motion.card_status) == (25.5, 1)


def test_readings_that_arrive_together_are_a_period_apart():
    motion, _, _ = card(("at", 100 * MS), ("r", LINE * 3))
    out = ImuSample()
    times: list[int] = []
    for _ in range(3):
        assert motion.read(out) is Status.OK
        times.append(out.t_ns)
    assert times == [80 * MS, 90 * MS, 100 * MS]


def test_readings_nobody_fetched_are_counted():
    motion, _, _ = card(("r", LINE * 60), ("r", LINE * 60), ("r", LINE * 60), ("r", LINE * 60), ("r", LINE * 60))
    for _ in range(5):
        motion._receive(0.0)
    assert motion.waiting() == 256
    out = ImuSample()
    assert motion.read(out) is Status.OVERRUN
    assert (out.lost, out.seq, motion.lost) == (44, 44, 44)


def test_a_click_is_masked_for_20_ms():
    def line(az: int, status: int) -> bytes:
        return f"#:0:0:{az}:0:0:0:0:{status}:\r\n".encode()

    script: list[tuple[object, ...]] = []
    for i, (az, status) in enumerate([(100, 0), (9000, 1), (5000, 1), (101, 1), (102, 1)]):
        script += [("at", i * 10 * MS), ("r", line(az, status))]
    motion, _, _ = card(*script)
    out = ImuSample()
    seen = [(motion.read(out), int(out.raw[2]), motion.card_status) for _ in range(5)]
    assert seen == [
        (Status.OK, 100, 0),
        (Status.STALE, 100, 1),
        (Status.STALE, 100, 1),
        (Status.OK, 101, 1),
        (Status.OK, 102, 1),
    ]
    assert (motion.masked, motion.clicks) == (2, 1)


def test_probe_waits_for_a_line():
    motion, port, _ = card(("r", b"0:5:\r\n"), ("wait",), ("r", LINE))
    with pytest.raises(HalTimeout):
        card()[0].probe(limit_s=0.2)
    with pytest.raises(WrongDevice):
        motion.probe(limit_s=0.2)
    motion, port, _ = card(("r", b"0:5:\r\n"), ("r", LINE))
    assert motion.probe(limit_s=0.2) == "motion card"
    port.done()


def test_probe_at_the_wrong_baud_rate():
    motion, _, _ = card(*[("r", b"\x80\xf8\r\n\x00")] * 12)
    with pytest.raises(WrongDevice, match="baud"):
        motion.probe()


# over the air, with a stand-in for the link


class FakeLink:
    def __init__(self, clock: VirtualClock, battery: bytes = b"\x25") -> None:
        self.clock = clock
        self.battery = battery
        self.subscribed: list[str] = []
        self.queue: deque[tuple[str, bytes, int]] = deque()
        self.closed = False

    def subscribe(self, characteristic: str, timeout_s: float) -> None:
        self.subscribed.append(characteristic)

    def receive(self, timeout_s: float) -> tuple[str, bytes, int] | None:
        if not self.queue:
            self.clock.burn_ns(round(timeout_s * 1e9))
            return None
        return self.queue.popleft()

    def read(self, characteristic: str, timeout_s: float) -> bytes:
        assert characteristic == BATTERY_UUID
        return self.battery

    def info(self) -> PortInfo:
        return PortInfo("fake://", "fake", emulated=True)

    def close(self) -> None:
        self.closed = True


def test_packets_and_battery_over_the_air():
    clock = VirtualClock()
    link = FakeLink(clock)
    link.queue.append((IMU_UUID, EXAMPLE, 5 * MS))
    motion = BleMotionCard(link, clock)
    assert motion.probe() == "motion card, battery 37 %"
    assert link.subscribed == [BATTERY_UUID, IMU_UUID]
    link.queue.extend([(BATTERY_UUID, b"\x24", 6 * MS), (IMU_UUID, EXAMPLE[:14], 7 * MS)])
    out = ImuSample()
    assert motion.read(out) is Status.OK
    assert (out.t_ns, out.raw[2], motion.battery_percent) == (5 * MS, 16142, 36)
    assert (motion.frames, motion.bad_frames) == (1, 1)
    assert motion.read(out) is Status.STALE
    motion.close()
    assert link.closed


def test_silence_and_nonsense_over_the_air():
    clock = VirtualClock()
    with pytest.raises(HalTimeout, match="no packet"):
        BleMotionCard(FakeLink(clock), clock, timeout_s=2.0).probe()
    assert clock.now_ns() == 2_000_000_000
    with pytest.raises(ProtocolError, match="battery level"):
        BleMotionCard(FakeLink(clock, b"\xff"), clock).probe()
