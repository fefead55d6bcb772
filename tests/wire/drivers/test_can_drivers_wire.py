"""CAN frames byte by byte from the frame table; the DBC is compared with the drivers' packing through cantools."""

from __future__ import annotations

from itertools import pairwise

import cantools.database
import numpy as np
import pytest

from drivers.can_frames import HostHeartbeat
from drivers.can_telemetry import CanTelemetry
from drivers.dbc import load_database
from drivers.piezo.can_amplifier import CanAmplifier
from drivers.piezo.can_node import ACKNOWLEDGED, COUNTER, encode_setpoint, new_node
from hal.clock import VirtualClock
from hal.errors import BenchError, HalTimeout, ProtocolError, SafetyTrip
from hal.types import CanFrame, ChannelInfo
from tests.wire.drivers.scripted_ports import ScriptedCan

MS = 1_000_000
NEUTRAL = "ff7fff7fff7f"  # 50 V measured: 32767 of 65535, little-endian
DISARMED, ARMED, RAMP, FAULT = "00", "01", "02", "03"


def crc_bit_by_bit(data: bytes) -> int:
    """SAE J1850 as its text says it: shift register, polynomial x8+x4+x3+x2+1, ones before, inverted after."""
    register = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            top = register >> 7 ^ byte >> bit & 1
            register = (register << 1) & 0xFF
            if top:
                register ^= 0x1D
    return register ^ 0xFF


def test_the_shift_register_gives_the_check_value():
    assert crc_bit_by_bit(b"123456789") == 0x4B


@pytest.mark.parametrize("volts", [(0.0, 0.0, 0.0), (100.0, 100.0, 100.0), (1.0, 20.0, 50.0)])
@pytest.mark.parametrize("counter", [0, 42, 255])
def test_the_checksum_of_a_setpoint_is_that_of_the_shift_register(volts: tuple[float, float, float], counter: int):
    node = new_node()
    node.words[COUNTER] = counter
    encode_setpoint(node, volts)
    assert node.setpoint[7] == crc_bit_by_bit(bytes(node.setpoint[:7]))


class Node:
    """The far end: status frames with what the table says, and a memory of what it was told."""

    def __init__(self, can: ScriptedCan) -> None:
        self.can = can
        self.state = DISARMED
        self.obedient = True
        self.accepted = 0
        can.on_send.append(self.hear)

    def hear(self, frame: CanFrame) -> None:
        if frame.can_id == 0x122 and self.obedient:
            assert frame.data[1] == frame.data[0] ^ 0xFF
            self.state = ARMED if frame.data[0] else DISARMED
        if frame.can_id == 0x120 and self.obedient:
            self.accepted = frame.data[6]

    def status(self) -> None:
        self.can.arrive(0x121, f"{NEUTRAL}{self.state}{self.accepted:02x}")

    def every_10_ms(self, t_ns: int) -> None:
        self.status()
        self.can.clock.at(t_ns + 10 * MS, self.every_10_ms)


def stand(**options: float) -> tuple[CanAmplifier, ScriptedCan, Node, VirtualClock]:
    clock = VirtualClock()
    can = ScriptedCan(clock)
    node = Node(can)
    clock.at(5 * MS, node.every_10_ms)
    return CanAmplifier(can, clock, **options), can, node, clock


def armed(**options: float) -> tuple[CanAmplifier, ScriptedCan, Node, VirtualClock]:
    amplifier, can, node, clock = stand(**options)
    amplifier.arm()
    can.sent.clear()
    clock.burn_ns(MS)
    return amplifier, can, node, clock


def test_setpoint_frame():
    amplifier, can, _, _ = armed(slew_V_per_s=1e9)
    counter = amplifier.node.words[COUNTER]
    assert amplifier.write(np.array([0.0, 100.0, 50.0])) == 0
    frame = next(data for can_id, data in can.sent if can_id == 0x120)
    body = bytes.fromhex("0000ffff0080") + bytes((counter,))  # 50 V = 32767.5, rounded up
    assert frame == (body + bytes((crc_bit_by_bit(body),))).hex()


def test_counter_wraps():
    amplifier, can, _, clock = armed()
    for _ in range(300):
        amplifier.write(np.full(3, 50.0))
        clock.burn_ns(MS)
    counters = [bytes.fromhex(data)[6] for can_id, data in can.sent if can_id == 0x120]
    assert len(counters) == 300
    assert all((b - a) % 256 == 1 for a, b in pairwise(counters))


def test_arm_sends_the_command_and_its_complement():
    amplifier, can, _, _ = stand()
    amplifier.arm()
    assert (0x122, "01fe") in can.sent
    assert amplifier.state == 1


def test_arm_needs_confirmation():
    amplifier, _, node, _ = stand()
    node.obedient = False
    with pytest.raises(SafetyTrip, match="does not confirm 'arm'"):
        amplifier.arm()
    with pytest.raises(SafetyTrip, match="not armed"):
        amplifier.write(np.full(3, 50.0))


def test_arm_refuses_a_node_in_fault():
    amplifier, _, node, _ = stand()
    node.state = FAULT
    with pytest.raises(SafetyTrip, match="fault"):
        amplifier.arm()


def test_silent_node_is_a_bounded_wait():
    clock = VirtualClock()
    amplifier = CanAmplifier(ScriptedCan(clock), clock)
    with pytest.raises(HalTimeout, match="is the node on"):
        amplifier.probe()
    assert clock.now_ns() == 500 * MS


def test_silence_while_running_is_noticed():
    amplifier, can, _, clock = armed()
    clock._due.clear()  # the node stops talking
    clock.burn_ns(120 * MS)
    can.queue.clear()
    with pytest.raises(HalTimeout, match="no STATUS frame for"):
        amplifier.write(np.full(3, 50.0))


def test_node_that_leaves_the_armed_state_trips():
    amplifier, _, node, clock = armed()
    node.state = RAMP
    clock.burn_ns(20 * MS)
    with pytest.raises(SafetyTrip, match="safe ramp"):
        amplifier.write(np.full(3, 50.0))


def test_setpoints_that_are_not_accepted_are_noticed():
    amplifier, _, node, clock = armed()
    node.obedient = False  # as if every checksum were wrong
    written = 0
    with pytest.raises(ProtocolError, match="not accepted the last"):  # noqa: PT012
        while written < 200:
            amplifier.write(np.full(3, 50.0))
            written += 1
            clock.burn_ns(MS)
    assert 60 <= written <= 80


def test_safe_state_is_asked_for_until_confirmed():
    amplifier, can, node, clock = armed()
    node.obedient = False
    for _ in range(12):
        assert amplifier.safe_step() is False
        clock.burn_ns(MS)
    assert [data for can_id, data in can.sent if can_id == 0x122] == ["00ff"] * 3
    node.obedient = True
    steps = 0
    while not amplifier.safe_step():
        clock.burn_ns(MS)
        steps += 1
    assert steps <= 20
    with pytest.raises(SafetyTrip):
        amplifier.write(np.full(3, 50.0))


def test_unconfirmed_safe_state_is_an_error():
    amplifier, _, node, clock = armed()
    node.obedient = False
    with pytest.raises(HalTimeout, match="does not confirm its safe state"):  # noqa: PT012
        for _ in range(200):
            amplifier.safe_step()
            clock.burn_ns(MS)


def test_close_waits_for_the_safe_state_of_an_armed_node():
    amplifier, can, node, _ = armed()
    amplifier.close()
    assert node.state == DISARMED
    assert (0x122, "00ff") in can.sent
    can.sent.clear()
    amplifier.close()  # it is there: not a frame more
    assert not can.sent


def test_close_says_when_neutral_was_not_seen():
    amplifier, _, node, _ = armed()
    node.obedient = False
    with pytest.raises(HalTimeout, match="the outputs were NOT seen to reach neutral"):
        amplifier.close()


def test_arm_needs_the_measured_voltages_at_neutral():
    amplifier, _, node, _ = stand()
    node.status = lambda: node.can.arrive(0x121, f"0000ffff0080{node.state}{node.accepted:02x}")
    with pytest.raises(SafetyTrip, match="the node measures"):
        amplifier.arm()
    assert not amplifier.guard.armed


def test_readback_of_an_armed_node_holds_the_setpoint_meanwhile():
    amplifier, can, _, _ = armed()
    assert amplifier.readback_V() == pytest.approx([50.0] * 3, abs=1e-3)
    assert {can_id for can_id, _ in can.sent} >= {0x120}


def test_readback_is_measured_by_the_node():
    amplifier, can, _, clock = stand()
    clock.burn_ns(MS)
    can.queue.clear()
    can.clock.at(4 * MS, lambda t_ns: can.arrive(0x121, "0000ffff00800000"))
    assert amplifier.readback_V() == pytest.approx([0.0, 100.0, 50.0008], abs=1e-3)


def test_heartbeat_at_50_hz_keeps_phase_and_sends_no_volley():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    heartbeat = HostHeartbeat(can, clock, load_database())
    assert (heartbeat.state, heartbeat.sent) == (0, 0)
    heartbeat.state = 2
    for _ in range(100):
        heartbeat.beat()
        clock.burn_ns(MS)
    assert can.sent == [(0x700, "02")] * 5
    clock.burn_ns(500 * MS)
    for _ in range(3):
        heartbeat.beat()
    assert len(can.sent) == heartbeat.sent == 6


def test_telemetry_frames():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock)
    telemetry.send_tremor([12.3, 0.0, 1e9], 9.87)
    telemetry.send_state(3, 0x81, 70_000, 258, 999.6)
    assert can.sent == [(0x200, "7b000000ffffdb03"), (0x201, "0381ffff0201e803")]
    telemetry.send_tremor([float("nan"), -1.0, 0.1], 0.0)
    assert can.sent[-1] == (0x200, "ffff000001000000")


def test_stop_button():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock)
    clock.burn_ns(MS)
    assert telemetry.poll() is False
    assert telemetry.button_silent()
    can.arrive(0x080, "0001")
    assert telemetry.poll() is False
    assert not telemetry.button_silent()
    for sequence in ("0102", "0103"):
        can.arrive(0x080, sequence)
        assert telemetry.poll() is True
    assert telemetry.presses == 1
    can.arrive(0x080, "ff04")  # not a clear 'released'
    assert telemetry.poll() is True
    can.arrive(0x080, "0005")
    assert telemetry.poll() is False
    clock.burn_ns(1600 * MS)
    assert telemetry.button_silent()


def test_only_the_buttons_own_frame_says_something_of_the_button():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock)
    clock.burn_ns(MS)
    for can_id, data in ((0x081, "0101"), (0x080, "01"), (0x080, "010203")):  # another's, too short, too long
        can.arrive(can_id, data)
        assert telemetry.poll() is False
        assert telemetry.button_silent()


def test_presses_are_counted_once_each():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock, name="panel")
    counts = []
    for pressed in (0, 1, 1, 1, 0, 1, 0, 0, 1):
        can.arrive(0x080, f"0{pressed}00")
        telemetry.poll()
        counts.append(telemetry.presses)
    assert counts == [0, 1, 1, 1, 1, 2, 2, 2, 3]
    assert telemetry.channels() == [ChannelInfo("panel.stop", "1", 0.0, 1.0, 1.0)]


def test_the_button_is_silent_only_beyond_its_limit():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock)
    clock.burn_ns(1000 * MS)
    can.arrive(0x080, "0001")
    telemetry.poll()
    clock.burn_ns(1500 * MS)
    assert not telemetry.button_silent()
    clock.burn_ns(1)
    assert telemetry.button_silent()


def test_telemetry_ends_where_the_frame_does():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock)
    telemetry.send_tremor([6554.0, 6554.0, 6554.0], 656.0)
    telemetry.send_state(0, 0, 65_536, 65_536, 65_536.0)
    assert can.sent == [(0x200, "ffff" * 4), (0x201, "0000" + "ffff" * 3)]
    assert telemetry.sent == 2
    assert telemetry.receives() == (0x080,)


def test_a_babbling_bus_does_not_hold_the_tick():
    clock = VirtualClock()
    can = ScriptedCan(clock)
    telemetry = CanTelemetry(can, clock)
    for _ in range(1000):
        can.arrive(0x080, "0101")
    telemetry.poll()
    assert len(can.queue) == 1000 - 32


TABLE = {
    "STOP_BUTTON": (0x080, 2),
    "SETPOINT": (0x120, 8),
    "STATUS": (0x121, 8),
    "COMMAND": (0x122, 2),
    "TELEMETRY_TREMOR": (0x200, 8),
    "TELEMETRY_STATE": (0x201, 8),
    "HOST_HEARTBEAT": (0x700, 1),
    "AMPLIFIER_HEARTBEAT": (0x701, 1),
}


class TestDbc:
    """The file against the frame table: ids, lengths, byte order, units."""

    def test_ids_and_lengths(self):
        database = cantools.database.load_file("drivers/dbc/micron.dbc")
        assert {m.name: (m.frame_id, m.length) for m in database.messages} == TABLE

    def test_setpoint_packing_is_the_dbc(self):
        amplifier, can, _, _ = armed(slew_V_per_s=1e9)
        amplifier.write(np.array([12.5, 87.5, 33.3]))
        data = bytes.fromhex(next(d for can_id, d in can.sent if can_id == 0x120))
        decoded = load_database().get_message_by_name("SETPOINT").decode(data)
        assert [decoded[f"setpoint_{i}"] for i in (1, 2, 3)] == pytest.approx([12.5, 87.5, 33.3], abs=1e-3)
        assert (decoded["counter"], decoded["crc"]) == (data[6], data[7])

    def test_status_unpacking_is_the_dbc(self):
        amplifier, can, _, clock = stand()
        values = {"measured_1": 10.0, "measured_2": 20.0, "measured_3": 90.0, "state": 2, "last_counter": 77}
        data = load_database().get_message_by_name("STATUS").encode(values)
        clock.burn_ns(MS)
        can.arrive(0x121, data.hex())
        amplifier.poll()
        assert amplifier.measured_V == pytest.approx([10.0, 20.0, 90.0], abs=1e-3)
        assert (amplifier.state, amplifier.node.words[ACKNOWLEDGED]) == (2, 77)


def test_impossible_neutral():
    clock = VirtualClock()
    with pytest.raises(BenchError):
        CanAmplifier(ScriptedCan(clock), clock, neutral_V=101.0)
