"""Trace, fault and share middleware: what goes through, what is written down, what is counted."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Sequence

import numpy as np
import pytest

from drivers.daq.di4108 import Di4108
from hal.clock import VirtualClock
from hal.errors import BenchError, BusError, Disconnected, ErrorKind, I2cNack, ProtocolError
from hal.middleware.faults import FaultCan, FaultI2c, FaultPlan, FaultSerial
from hal.middleware.faults.can import BABBLE_ID
from hal.middleware.share import SharedCan
from hal.middleware.trace import Entry, TraceCan, TraceI2c, TraceSerial, read_transcript
from hal.types import CanFrame, I2cOp, I2cRead, I2cWrite, ScanConfig
from tests.wire.drivers.scripted_ports import ScriptedCan, ScriptedI2c, ScriptedSerial, serial_script

MS = 1_000_000
STOP = [("w", b"stop\r"), ("r", b"stop\r")]


class Stream:
    """A serial port that delivers ``data``, ``chunk`` bytes at a time, one chunk per millisecond."""

    def __init__(self, clock: VirtualClock, data: bytes, chunk: int = 16) -> None:
        self.clock = clock
        self.chunks = deque(data[i : i + chunk] for i in range(0, len(data), chunk))
        self.written = b""

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        if timeout_s < 0.001 or not self.chunks:
            self.clock.burn_ns(round(timeout_s * 1e9))
            return 0
        self.clock.burn_ns(MS)
        data = self.chunks.popleft()
        buf[: len(data)] = data
        return len(data)

    def write(self, data: bytes, timeout_s: float) -> None:
        self.written += data

    def drain_input(self) -> int:
        return 0

    def info(self):
        return ScriptedSerial(self.clock, []).info()

    def close(self) -> None:
        pass


def everything(port: FaultSerial) -> bytes:
    buf = bytearray(64)
    data = b""
    while n := port.read_into(memoryview(buf), 0.01):
        data += bytes(buf[:n])
    return data


class TestTrace:
    def test_serial_transcript(self):
        clock = VirtualClock(77)
        sink = io.StringIO()
        port = TraceSerial(ScriptedSerial(clock, [("w", b"stop\r"), ("at", 1077), ("r", b"st")]), clock, sink)
        port.write(b"stop\r", 1.0)
        buf = bytearray(8)
        assert port.read_into(memoryview(buf), 1.0) == 2
        assert port.read_into(memoryview(buf), 0.0) == 0
        assert sink.getvalue() == "# transcript serial scripted://\n0 w 73746f700d\n1000 r 7374\n"

    def test_i2c_transcript_with_failure(self):
        clock = VirtualClock()
        sink = io.StringIO()
        script = [(0x48, [("w", b"\x01"), ("r", b"\x85\x83")]), (0x0C, I2cNack("no"))]
        bus = TraceI2c(ScriptedI2c(script), clock, sink)
        assert bus.transfer(0x48, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x85\x83"
        with pytest.raises(I2cNack):
            bus.transfer(0x0C, [I2cRead(2)])
        assert sink.getvalue().splitlines()[1:] == ["0 x 48 w01 r8583", "0 x 0c r???? ! address not acknowledged"]

    def test_can_transcript(self):
        clock = VirtualClock()
        sink = io.StringIO()
        can = ScriptedCan(clock)
        bus = TraceCan(can, clock, sink)
        bus.send(CanFrame(0x120, b"\x01\x02"), 0.0)
        can.queue.append(CanFrame(0x1ABCDEF0, b"", extended=True))
        bus.recv(0.0)
        assert bus.recv(0.0) is None
        assert sink.getvalue().splitlines()[1:] == ["0 t 120 0102", "0 r 1abcdef0 "]

    def test_parse_is_the_inverse(self):
        assert read_transcript(["# transcript serial x", "", "5 w 00ff", "7 x 48 w01 r8583"]) == [
            Entry(5, "w", ("00ff",)),
            Entry(7, "x", ("48", "w01", "r8583")),
        ]
        with pytest.raises(BenchError, match="line 2"):
            read_transcript(["0 w 00", "zero w 00"])

    def test_a_recorded_session_replays_as_a_golden_transcript(self):
        """Record a driver's session, then run the driver again on nothing but the transcript."""
        script = [
            *STOP,
            *(
                e
                for text, answer in ((b"info 1", b" 4108"), (b"info 2", b" 65"), (b"info 6", b" 12345678"))
                for e in (("w", text + b"\r"), ("r", text + answer + b"\r"))
            ),
        ]
        clock = VirtualClock()
        sink = io.StringIO()
        first = Di4108(TraceSerial(ScriptedSerial(clock, script), clock, sink), clock).probe()
        replayed = ScriptedSerial(clock, serial_script(sink.getvalue()))
        assert Di4108(replayed, clock).probe() == first
        replayed.done()


class TestFaultSerial:
    data = bytes(range(256)) * 40

    def damaged(self, plan: FaultPlan) -> tuple[bytes, FaultSerial]:
        clock = VirtualClock()
        port = FaultSerial(Stream(clock, self.data), clock, plan)
        return everything(port), port

    def test_no_fault_changes_nothing(self):
        data, port = self.damaged(FaultPlan())
        assert data == self.data
        assert "injected faults" in port.info().description

    def test_loss_is_counted_and_deterministic(self):
        data, port = self.damaged(FaultPlan(seed=3, loss=0.01))
        assert len(data) == len(self.data) - port.counts.lost
        assert 60 <= port.counts.lost <= 150
        assert self.damaged(FaultPlan(seed=3, loss=0.01))[0] == data
        assert self.damaged(FaultPlan(seed=4, loss=0.01))[0] != data

    def test_corruption_flips_one_bit_each(self):
        data, port = self.damaged(FaultPlan(seed=3, corruption=0.01))
        differences = [a ^ b for a, b in zip(data, self.data, strict=True) if a != b]
        assert len(differences) == port.counts.corrupted > 0
        assert all(d.bit_count() == 1 for d in differences)

    def test_silence_takes_both_directions_for_its_time(self):
        clock = VirtualClock()
        stream = Stream(clock, self.data)
        port = FaultSerial(stream, clock, FaultPlan(silent_after_s=0.1, silent_for_s=0.05))
        data = everything(port)
        # a read that finds only silence waits out its time
        while stream.chunks:
            data += everything(port)
        assert 48 * 16 <= port.counts.silenced <= 52 * 16
        assert len(data) + port.counts.silenced == len(self.data)
        quiet = FaultSerial(stream, clock, FaultPlan(silent_after_s=0.0))
        quiet.write(b"lost", 1.0)
        assert stream.written == b""
        assert quiet.counts.silenced == 4

    def test_delay_holds_up_the_caller(self):
        clock = VirtualClock()
        port = FaultSerial(Stream(clock, bytes(16)), clock, FaultPlan(delay=1.0, delay_s=0.25))
        port.read_into(memoryview(bytearray(16)), 0.01)
        assert clock.now_ns() == 251 * MS
        assert port.counts.delayed == 1

    def test_unplugged(self):
        clock = VirtualClock()
        port = FaultSerial(Stream(clock, self.data), clock, FaultPlan(disconnect_after_s=0.1))
        with pytest.raises(Disconnected, match="injected"):
            everything(port)
        with pytest.raises(Disconnected):
            port.write(b"x", 0.1)
        assert clock.now_ns() == 100 * MS
        assert port.counts.disconnected

    def test_bytes_doubled_cut_off_and_swapped(self):
        clock = VirtualClock()
        twice = FaultSerial(Stream(clock, b"ab"), clock, FaultPlan(duplication=1.0))
        assert everything(twice) == b"aabb"
        assert twice.counts.duplicated == 2
        cut = FaultSerial(Stream(clock, b"abcdefgh", chunk=8), clock, FaultPlan(truncation=1.0))
        got = everything(cut)
        assert b"abcdefgh".startswith(got)
        assert cut.counts.lost == 8 - len(got) > 0
        swapped = FaultSerial(Stream(clock, b"ab", chunk=2), clock, FaultPlan(reorder=1.0))
        assert everything(swapped) == b"ba"
        assert swapped.counts.reordered == 1

    def test_what_does_not_fit_waits_and_can_be_dropped(self):
        clock = VirtualClock()
        port = FaultSerial(Stream(clock, b"ab", chunk=1), clock, FaultPlan(duplication=1.0))
        small = bytearray(1)
        assert port.read_into(memoryview(small), 0.01) == 1
        assert port.drain_input() == 1
        assert port.read_into(memoryview(small), 0.01) == 1
        assert small == b"b"

    def test_the_daq_driver_finds_byte_loss(self):
        """One lost byte per about ten scans: the driver must stop rather than deliver shifted channels."""
        clock = VirtualClock()
        scan = np.arange(100, 108, dtype="<i2").tobytes()
        faulty = FaultSerial(Stream(clock, scan * 500), clock, FaultPlan(seed=5, loss=0.006))
        daq = Di4108(faulty, clock)
        config = ScanConfig(1000.0, tuple(range(8)), (5.0,) * 8)
        daq._command = lambda text: None  # type: ignore[method-assign]
        daq.stop = lambda: None  # type: ignore[method-assign]
        daq.configure(config)
        daq.start()
        out = np.zeros((64, 8), dtype=np.int16)
        with pytest.raises(ProtocolError, match="bytes were lost") as caught:  # noqa: PT012
            for _ in range(500):
                block = daq.read_scans(out, 0.01)
                assert (out[: block.n] == np.arange(100, 108)).all()
        assert caught.value.kind is ErrorKind.FRAMING
        assert faulty.counts.lost >= 1


class TestFaultI2c:
    ops = (I2cWrite(b"\x00"), I2cRead(2))

    def bus(self, plan: FaultPlan, n: int = 200) -> tuple[FaultI2c, VirtualClock]:
        clock = VirtualClock()
        return FaultI2c(ScriptedI2c([(0x48, [("w", b"\x00"), ("r", b"\x12\x34")])] * n), clock, plan), clock

    def test_nacks_are_counted_by_kind(self):
        bus, _ = self.bus(FaultPlan(seed=1, nack=0.1, loss=0.1))
        kinds = []
        for _ in range(200):
            try:
                assert bus.transfer(0x48, self.ops) == b"\x12\x34"
            except I2cNack as error:
                kinds.append(error.kind)
        assert kinds.count(ErrorKind.NACK_DATA) == bus.counts.nacked > 5
        assert kinds.count(ErrorKind.NACK_ADDRESS) == bus.counts.lost > 5

    def test_corruption_flips_one_bit(self):
        bus, _ = self.bus(FaultPlan(corruption=1.0))
        data = bus.transfer(0x48, self.ops)
        assert (int.from_bytes(data, "big") ^ 0x1234).bit_count() == 1

    def test_silence_and_unplugging(self):
        bus, clock = self.bus(FaultPlan(silent_after_s=0.1, silent_for_s=0.1, disconnect_after_s=0.3))
        assert bus.transfer(0x48, self.ops)
        clock.burn_ns(150 * MS)
        with pytest.raises(I2cNack, match="silence"):
            bus.transfer(0x48, self.ops)
        clock.burn_ns(100 * MS)
        assert bus.transfer(0x48, self.ops)
        clock.burn_ns(100 * MS)
        with pytest.raises(Disconnected):
            bus.transfer(0x48, self.ops)

    def test_a_written_byte_suffers_and_the_register_does_not(self):
        class Echo(ScriptedI2c):
            def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
                heard.append([op.data for op in ops if isinstance(op, I2cWrite)])
                return b""

        heard: list[list[bytes]] = []
        bus = FaultI2c(Echo([]), VirtualClock(), FaultPlan(write_corruption=1.0))
        bus.transfer(0x0C, [I2cWrite(b"\x31\x12\x34")])
        assert heard[0][0][:1] == b"\x31"
        assert (int.from_bytes(heard[0][0][1:], "big") ^ 0x1234).bit_count() == 1
        bus.transfer(0x0C, [I2cWrite(b"\x31")])
        assert heard[1] == [b"\x31"], "a register alone has no data to damage"

    def test_a_transfer_that_happens_twice(self):
        bus, _ = self.bus(FaultPlan(duplication=1.0), n=2)
        assert bus.transfer(0x48, self.ops) == b"\x12\x34"
        assert bus.counts.duplicated == 1
        bus._bus.done()  # type: ignore[attr-defined]

    def test_one_address_suffers_alone(self):
        clock = VirtualClock()
        script = [(0x48, [("w", b"\x00"), ("r", b"\x12\x34")])]
        bus = FaultI2c(ScriptedI2c(script), clock, FaultPlan(loss=1.0), only=0x0C)
        assert bus.transfer(0x48, self.ops) == b"\x12\x34"
        with pytest.raises(I2cNack, match="0x0C"):
            bus.transfer(0x0C, self.ops)
        bus.arm(FaultPlan(), only=None)
        assert bus.counts.lost == 1, "counts go on"


class TestFaultCan:
    def test_loss_corruption_and_silence(self):
        clock = VirtualClock()
        can = ScriptedCan(clock)
        bus = FaultCan(can, clock, FaultPlan(seed=2, loss=0.2, corruption=0.2))
        for _ in range(100):
            can.arrive(0x121, "0011")
        frames = []
        while (frame := bus.recv(0.0)) is not None:
            frames.append(frame.data)
        assert len(frames) == 100 - bus.counts.lost
        assert sum(data != b"\x00\x11" for data in frames) == bus.counts.corrupted > 5
        assert bus.stats().dropped == bus.counts.lost > 5

    def test_silent_bus_sends_nothing(self):
        clock = VirtualClock()
        can = ScriptedCan(clock)
        bus = FaultCan(can, clock, FaultPlan(silent_after_s=0.0))
        bus.send(CanFrame(0x120, b""), 0.0)
        can.arrive(0x121, "00")
        assert bus.recv(0.001) is None
        assert can.sent == []
        assert bus.counts.silenced == 2

    def test_a_bus_that_is_off_refuses_until_the_plan_ends(self):
        clock = VirtualClock()
        can = ScriptedCan(clock)
        bus = FaultCan(can, clock, FaultPlan(bus_off_after_s=0.001))
        bus.send(CanFrame(0x120, b""), 0.0)
        clock.burn_ns(MS)
        with pytest.raises(BusError, match="bus-off"):
            bus.send(CanFrame(0x120, b""), 0.0)
        bus.arm(FaultPlan())
        bus.send(CanFrame(0x120, b""), 0.0)
        assert len(can.sent) == 2
        assert bus.counts.lost == 1

    def test_babble_and_error_frames_come_at_their_rates(self):
        clock = VirtualClock()
        bus = FaultCan(ScriptedCan(clock), clock, FaultPlan(babble_hz=100.0, error_frames_hz=200.0))
        heard = 0
        for _ in range(100):
            clock.burn_ns(MS)
            frame = bus.recv(0.0)
            heard += frame is not None and frame.can_id == BABBLE_ID
        assert heard == bus.counts.babbled == 10
        assert bus.stats().error_frames == bus.counts.error_frames == 20

    def test_frames_shortened_doubled_and_out_of_order(self):
        clock = VirtualClock()
        can = ScriptedCan(clock)
        bus = FaultCan(can, clock, FaultPlan(truncation=1.0))
        can.arrive(0x121, "0011")
        frame = bus.recv(0.0)
        assert frame is not None
        assert frame.data == b"\x00"
        bus.arm(FaultPlan(duplication=1.0))
        can.arrive(0x121, "22")
        assert [f.data for f in (bus.recv(0.0), bus.recv(0.0)) if f] == [b"\x22", b"\x22"]
        bus.arm(FaultPlan(reorder=1.0))
        can.arrive(0x121, "01")
        can.arrive(0x121, "02")
        assert [f.data for f in (bus.recv(0.0), bus.recv(0.0)) if f] == [b"\x02", b"\x01"]
        assert (bus.counts.truncated, bus.counts.duplicated, bus.counts.reordered) == (1, 1, 1)


class TestShare:
    def test_each_view_gets_its_own_frames_in_order(self):
        clock = VirtualClock()
        can = ScriptedCan(clock)
        shared = SharedCan(can)
        piezo, button = shared.view([0x121, 0x701]), shared.view([0x080])
        for i, can_id in enumerate((0x121, 0x080, 0x555, 0x701, 0x121)):
            can.arrive(can_id, f"{i:02x}")
        assert button.recv(0.0) == CanFrame(0x080, b"\x01")
        assert [piezo.recv(0.0).data for _ in range(3)] == [b"\x00", b"\x03", b"\x04"]
        assert piezo.recv(0.0) is None
        assert shared.unclaimed == 1
        assert (piezo.stats().rx, button.stats().rx) == (3, 1)
        piezo.send(CanFrame(0x120, b"\x01"), 0.0)
        assert can.sent == [(0x120, "01")]
        assert (piezo.stats().tx, button.stats().tx) == (1, 0)
        piezo.close()

    def test_one_id_one_driver(self):
        shared = SharedCan(ScriptedCan(VirtualClock()))
        shared.view([0x121])
        with pytest.raises(BenchError, match="0x121"):
            shared.view([0x080, 0x121])

    def test_a_view_nobody_reads_stays_bounded_and_says_so(self):
        clock = VirtualClock()
        can = ScriptedCan(clock)
        shared = SharedCan(can)
        idle, busy = shared.view([1]), shared.view([2])
        for _ in range(1500):
            can.arrive(1, "00")
        assert busy.recv(0.0) is None
        assert idle.stats().dropped == 1500 - 1024
