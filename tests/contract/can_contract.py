"""What every CanBus must do. An adapter's test class inherits this and gives ``pair``: two ends of one bus."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from hal.contracts import CanBus, Clock
from hal.errors import Closed, HalError
from hal.types import CanFrame


@dataclass
class CanPair:
    """``bus`` is under test, ``far`` another node: a CanBus of its own or a stand-in with send and recv."""

    bus: CanBus
    far: CanBus
    clock: Clock


def content(frame: CanFrame | None) -> tuple[int, bytes, bool] | None:
    return None if frame is None else (frame.can_id, frame.data, frame.extended)


class CanContract:
    burst = 1000
    """Frames that must survive unread."""

    @pytest.fixture
    def pair(self):
        raise NotImplementedError

    @pytest.mark.parametrize(
        ("can_id", "data", "extended"),
        [
            (0x123, b"\x01\x02\x03", False),
            (0x000, b"", False),
            (0x7FF, bytes(range(8)), False),
            (0x1ABCDEF0, b"\xff" * 8, True),
            (0x010, b"\x00", True),
        ],
    )
    def test_frames_both_ways(self, pair: CanPair, can_id: int, data: bytes, extended: bool):
        frame = CanFrame(can_id, data, extended)
        pair.bus.send(frame, 0.5)
        assert content(pair.far.recv(2.0)) == (can_id, data, extended)
        pair.far.send(frame, 0.5)
        assert content(pair.bus.recv(2.0)) == (can_id, data, extended)

    def test_does_not_hear_itself(self, pair: CanPair):
        pair.bus.send(CanFrame(0x100, b"mine"), 0.5)
        assert pair.far.recv(2.0) is not None
        assert pair.bus.recv(0.01) is None

    def test_equal_frames_of_both_nodes_are_told_apart(self, pair: CanPair):
        frame = CanFrame(0x100, b"same")
        pair.bus.send(frame, 0.5)
        pair.far.send(frame, 0.5)
        assert content(pair.bus.recv(2.0)) == (0x100, b"same", False)
        assert pair.bus.recv(0.01) is None

    def test_order_is_kept_in_a_burst(self, pair: CanPair):
        for i in range(self.burst):
            pair.far.send(CanFrame(0x200, i.to_bytes(4, "little")), 0.5)
        got = []
        while (frame := pair.bus.recv(0.2)) is not None:
            got.append(int.from_bytes(frame.data, "little"))
        assert got == list(range(self.burst))
        assert pair.bus.stats().rx == self.burst
        assert pair.bus.stats().dropped == 0

    def test_poll_and_timeout(self, pair: CanPair):
        before_ns = pair.clock.now_ns()
        assert pair.bus.recv(0.0) is None
        assert pair.clock.now_ns() - before_ns < 1_000_000_000
        before_ns = pair.clock.now_ns()
        assert pair.bus.recv(0.02) is None
        assert pair.clock.now_ns() - before_ns >= 0.02 * 1e9 * 0.99

    def test_time_is_on_the_bench_clock(self, pair: CanPair):
        before_ns = pair.clock.now_ns()
        pair.far.send(CanFrame(0x101, b""), 0.5)
        frame = pair.bus.recv(2.0)
        after_ns = pair.clock.now_ns()
        assert frame is not None
        # wall clock and bench clock are compared at reception: allow what lies between two clock readings
        assert before_ns - 2_000_000 <= frame.t_ns <= after_ns

    def test_counts(self, pair: CanPair):
        for _ in range(3):
            pair.bus.send(CanFrame(0x102, b""), 0.5)
        assert pair.bus.stats().tx == 3

    def test_nine_bytes_are_refused(self, pair: CanPair):
        with pytest.raises(HalError):
            pair.bus.send(CanFrame(0x100, bytes(9)), 0.5)

    def test_info_names_the_bus(self, pair: CanPair):
        assert "://" in pair.bus.info().uri

    def test_close_twice_then_use(self, pair: CanPair):
        pair.bus.close()
        pair.bus.close()
        with pytest.raises(Closed):
            pair.bus.send(CanFrame(0x100, b""), 0.1)
        with pytest.raises(Closed):
            pair.bus.recv(0.0)
