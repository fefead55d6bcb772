"""CAN nodes of the bench against the frame table of issue 2, and the bus they share."""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest

from sim_devices.devices.can_piezo_node import CanPiezoNode, NodeState, crc8_sae_j1850
from sim_devices.devices.can_stop_button import CanStopButton
from sim_devices.devices.can_telemetry_listener import CanTelemetryListener
from sim_devices.transports.can_hub import CanHub, frame_ns

MS = 1_000_000
ARM, SAFE = b"\x01\xfe", b"\x00\xff"


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        (b"123456789", 0x4B),  # catalogue check value
        # AUTOSAR SWS CRC Library, table of CRC-8-SAE-J1850 test patterns
        (bytes.fromhex("00000000"), 0x59),
        (bytes.fromhex("f20183"), 0x37),
        (bytes.fromhex("0faa0055"), 0x79),
        (bytes.fromhex("00ff5511"), 0xB8),
        (bytes.fromhex("332255aabbccddeeff"), 0xCB),
        (bytes.fromhex("926b55"), 0x8C),
        (bytes.fromhex("ffffffff"), 0x74),
    ],
)
def test_crc_vectors(data: bytes, crc: int) -> None:
    assert crc8_sae_j1850(data) == crc


def setpoint(counter: int, *codes: int) -> bytes:
    body = struct.pack("<3HB", *codes, counter)
    return body + bytes((crc8_sae_j1850(body),))


def armed() -> tuple[CanPiezoNode, list[tuple[int, float, int]]]:
    seen: list[tuple[int, float, int]] = []
    node = CanPiezoNode(on_output=lambda c, v, t: seen.append((c, v, t)))
    node.receive(0x122, ARM, 0)
    assert node.state is NodeState.ARMED
    return node, seen


def test_setpoint_bytes() -> None:
    node, seen = armed()
    # 0, 25 V (16384 units), 100 V little endian; counter 7; CRC over bytes 0..6
    node.receive(
        0x120, bytes.fromhex("0000 0040 ffff 07") + bytes((crc8_sae_j1850(bytes.fromhex("00000040ffff07")),)), 5
    )
    assert seen == [(0, 0.0, 5), (1, pytest.approx(16384 * 100 / 65535), 5), (2, 100.0, 5)]


def test_status_and_heartbeat_frames() -> None:
    node, _ = armed()
    node.receive(0x120, setpoint(9, 1, 2, 3), 1)
    node.take()
    node.advance_to(10 * MS)
    assert node.take() == [(0x121, bytes.fromhex("0100 0200 0300 01 09"))]
    counts = {0x121: 0, 0x701: 0}
    for k in range(11, 1011):
        node.advance_to(k * MS)
        for can_id, _data in node.take():
            counts[can_id] += 1
    assert counts == {0x121: 100, 0x701: 10}  # 100 Hz, 10 Hz


def test_setpoints_are_ignored_until_armed_and_arming_needs_the_complement() -> None:
    node = CanPiezoNode()
    node.receive(0x120, setpoint(1, 0, 0, 0), 0)
    node.receive(0x122, b"\x01\x01", 0)
    assert node.state is NodeState.DISARMED
    assert node.output_V == [0x8000 * 100 / 65535] * 3


def test_bad_crc_short_frames_and_repeated_counters_are_counted_and_ignored() -> None:
    node, seen = armed()
    good = setpoint(1, 10, 10, 10)
    node.receive(0x120, good[:7] + bytes((good[7] ^ 1,)), 0)
    node.receive(0x120, good[:7], 0)
    node.receive(0x120, good, 0)
    node.receive(0x120, setpoint(1, 20, 20, 20), 0)
    assert (node.rejected, node.accepted) == (3, 1)
    assert len(seen) == 3
    node.receive(0x120, setpoint(4, 30, 30, 30), 0)
    assert node.counter_gaps == 1


def test_watchdog_ramps_to_neutral_within_twenty_ms_of_the_last_setpoint() -> None:
    node, seen = armed()
    node.receive(0x120, setpoint(1, 0, 65535, 0x8000), MS)
    node.advance_to(11 * MS - 1)
    assert node.state is NodeState.ARMED
    node.advance_to(11 * MS)
    assert node.state is NodeState.SAFE_RAMP
    node.advance_to(21 * MS)
    assert node.state is NodeState.DISARMED
    assert node.codes == [0x8000] * 3
    ramp = [v for c, v, _ in seen if c == 0]
    assert max(abs(b - a) for a, b in pairwise(ramp)) <= 5.01
    assert node.watchdog_trips == 1


def test_lost_host_heartbeat_and_safe_command_ramp_down() -> None:
    node, _ = armed()
    for k in range(1, 600):
        node.receive(0x120, setpoint(k & 0xFF, 0, 0, 0), k * MS)
        if node.state is not NodeState.ARMED:
            break
    assert k == 500
    node, _ = armed()
    node.receive(0x120, setpoint(1, 0, 0, 0), 0)
    node.receive(0x122, SAFE, MS)
    assert node.state is NodeState.SAFE_RAMP


def test_fault_after_many_bad_frames_is_cleared_by_safe_at_neutral() -> None:
    node, _ = armed()
    for k in range(50):
        node.receive(0x120, b"12345678", k * 100_000)
    assert node.state is NodeState.FAULT
    node.receive(0x122, ARM, 5 * MS)
    assert node.state is NodeState.FAULT
    node.receive(0x122, SAFE, 60 * MS)
    assert node.state is NodeState.DISARMED


def test_stop_button_frames() -> None:
    button = CanStopButton()
    button.advance_to(0)
    assert button.take() == [(0x080, b"\x00\x00")]
    assert button.next_event_ns() == 500 * MS  # released: every 500 ms
    button.advance_to(200 * MS)
    button.press()
    assert button.next_event_ns() == 200 * MS  # at once
    for k in range(200, 401):
        button.advance_to(k * MS)
    assert button.take() == [(0x080, bytes((1, n))) for n in (1, 2, 3)]  # at 200, 300, 400 ms
    button.release()
    button.advance_to(401 * MS)
    assert button.take() == [(0x080, b"\x00\x04")]


def test_telemetry_listener() -> None:
    panel = CanTelemetryListener()
    panel.receive(0x200, bytes.fromhex("f401 0a00 0000 de03"), 5)  # 50.0 um, 1.0 um, 0, 9.90 Hz
    panel.receive(0x201, bytes.fromhex("02 05 0300 0400 e803"), 6)
    panel.receive(0x201, b"\x00", 7)
    assert panel.amplitude_um == (50.0, 1.0, 0.0)
    assert panel.frequency_hz == 9.9
    assert (panel.state, panel.flags, panel.lost_samples, panel.skipped_ticks, panel.worst_tick_us) == (
        2,
        5,
        3,
        4,
        1000,
    )
    assert (panel.malformed, panel.last_ns) == (1, 6)


def test_bus_carries_one_frame_at_a_time_and_nobody_hears_itself() -> None:
    hub = CanHub(500_000)
    panel = CanTelemetryListener()
    button = CanStopButton(start_ns=10**9)
    heard: list[tuple[int, int]] = []
    hub.host = lambda can_id, data, t_ns: heard.append((can_id, t_ns))
    hub.attach(panel)
    hub.attach(button)
    hub.send_from_host(0x200, bytes(8), 0)
    hub.send_from_host(0x201, bytes(8), 0)
    # 8 data bytes at 500 kbit/s: 111 bits unstuffed, 135 at worst (ISO 11898-1)
    assert 222_000 <= frame_ns(8, 500_000) <= 270_000
    hub.advance_to(frame_ns(8, 500_000))
    assert panel.frames == 1
    hub.advance_to(2 * frame_ns(8, 500_000))
    assert panel.frames == 2
    assert heard == []
    hub.advance_to(10**9)
    hub.advance_to(10**9 + frame_ns(2, 500_000))
    assert heard == [(0x080, 10**9 + frame_ns(2, 500_000))]
    hub.silent = True
    hub.send_from_host(0x200, bytes(8), 2 * 10**9)
    hub.advance_to(3 * 10**9)
    assert panel.frames == 2
    assert len(heard) == 1
