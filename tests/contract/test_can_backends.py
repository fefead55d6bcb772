"""The CAN contract on python-can: in process, across sockets, and as bytes of a serial adapter on a pty."""

from __future__ import annotations

import os
import select
import socket
import tty
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from hal.backends import open_can
from hal.backends.unix_can import UnixCan
from hal.clock import MonotonicClock
from hal.contracts import CanBus
from hal.errors import BenchError, DeviceNotFound, Disconnected, HalTimeout
from hal.types import CanFrame, CanStats, PortInfo
from sim_devices.transports.can_hub import EXTENDED, CanHub
from sim_devices.transports.can_socket import CanSocketServer
from tests.contract.can_contract import CanContract, CanPair, content

GROUP = "239.74.163.2"


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def two(uri: str) -> Iterator[CanPair]:
    clock = MonotonicClock()
    buses: list[CanBus] = [open_can(uri, 500_000, clock) for _ in range(2)]
    yield CanPair(buses[0], buses[1], clock)
    for bus in buses:
        bus.close()


class TestVirtual(CanContract):
    @pytest.fixture
    def pair(self) -> Iterator[CanPair]:
        yield from two("virtual-can://contract")


class TestUdpMulticast(CanContract):
    @pytest.fixture
    def pair(self) -> Iterator[CanPair]:
        yield from two(f"udp-multicast://{GROUP}:{free_udp_port()}")

    def test_another_group_on_the_same_port_is_not_heard(self):
        port = free_udp_port()
        clock = MonotonicClock()
        here = open_can(f"udp-multicast://{GROUP}:{port}", 500_000, clock)
        there = open_can(f"udp-multicast://239.74.163.3:{port}", 500_000, clock)
        there.send(CanFrame(0x100, b"other"), 0.5)
        assert there.stats().tx == 1
        assert here.recv(0.05) is None
        here.close()
        there.close()

    def test_a_plain_python_can_node_is_understood(self):
        """The emulated world may use python-can directly: no mark, no drop count, but its frames count as others'."""
        port = free_udp_port()
        here = open_can(f"udp-multicast://{GROUP}:{port}", 500_000, MonotonicClock())
        with can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False) as plain:
            plain.send(can.Message(arbitration_id=0x321, data=b"hi", is_extended_id=False))
            frame = here.recv(1.0)
            assert frame is not None
            assert (frame.can_id, frame.data) == (0x321, b"hi")
            here.send(CanFrame(0x322, b"ho"), 0.5)
            heard = [plain.recv(1.0), plain.recv(1.0)]
            assert [m.arbitration_id for m in heard if m] == [0x321, 0x322]
        here.close()

    def test_what_the_queue_dropped_is_counted(self, pair: CanPair, monkeypatch: pytest.MonkeyPatch):
        """A gap in the sender's count: here two frames that never arrive, because their sender skips two numbers."""
        pair.far.send(CanFrame(0x100, b"1"), 0.5)
        pair.far._sent += 2  # type: ignore[attr-defined]
        pair.far.send(CanFrame(0x100, b"4"), 0.5)
        while pair.bus.recv(0.2) is not None:
            pass
        assert pair.bus.stats().dropped == 2


class AdapterFarEnd:
    """The other end of an slcan adapter's serial line: LAWICEL bytes, as a CAN node would cause them."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self.buffer = b""
        self.commands: list[bytes] = []

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        head = f"T{frame.can_id:08X}" if frame.extended else f"t{frame.can_id:03X}"
        os.write(self.fd, f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode())

    def recv(self, timeout_s: float) -> CanFrame | None:
        while True:
            while b"\r" in self.buffer:
                line, _, self.buffer = self.buffer.partition(b"\r")
                if line[:1] in b"tT" and line:
                    digits = 3 if line[:1] == b"t" else 8
                    return CanFrame(
                        int(line[1 : 1 + digits], 16), bytes.fromhex(line[2 + digits :].decode()), digits == 8
                    )
                self.commands.append(line)
            if not select.select([self.fd], [], [], timeout_s)[0]:
                return None
            self.buffer += os.read(self.fd, 4096)

    def stats(self) -> CanStats:
        return CanStats()

    def info(self) -> PortInfo:
        return PortInfo("test://", "far end", emulated=True)

    def close(self) -> None:
        os.close(self.fd)


class TestSlcan(CanContract):
    burst = 200  # a real adapter's line is slow, and 20 kB is what a pty holds

    @pytest.fixture
    def pair(self) -> Iterator[CanPair]:
        master, slave = os.openpty()
        tty.setraw(slave)
        clock = MonotonicClock()
        far = AdapterFarEnd(master)
        bus = open_can(f"slcan://{os.ttyname(slave)}", 500_000, clock)
        yield CanPair(bus, far, clock)
        bus.close()
        os.close(slave)
        os.close(master)

    def test_opening_bytes(self, pair: CanPair):
        pair.bus.send(CanFrame(0x123, b"\x01\x02"), 0.5)
        assert isinstance(pair.far, AdapterFarEnd)
        pair.far.recv(1.0)
        assert b"S6" in pair.far.commands  # 500 kbit/s
        assert pair.far.commands[-1] == b"O"

    def test_acknowledgements_do_not_hide_frames(self, pair: CanPair):
        assert isinstance(pair.far, AdapterFarEnd)
        os.write(pair.far.fd, b"\rz\r\rt10021122\r\rt1011FF\rz\r")
        assert [content(pair.bus.recv(1.0)), content(pair.bus.recv(1.0))] == [
            (0x100, b"\x11\x22", False),
            (0x101, b"\xff", False),
        ]

    def test_pulled_adapter_is_a_disconnect(self):
        master, slave = os.openpty()
        tty.setraw(slave)
        bus = open_can(f"slcan://{os.ttyname(slave)}", 500_000)
        os.close(master)
        with pytest.raises(Disconnected):
            bus.recv(0.1)
        bus.close()
        os.close(slave)


class FarNode:
    """A node of an emulated bus, which the test pumps: what it hears is kept, what it sends goes to the host."""

    def __init__(self, folder: Path) -> None:
        self._hub = CanHub(10**9)
        self._hub.attach(self)
        self.server = CanSocketServer(self._hub, folder / "can.sock")
        self._t_ns = 0
        self._heard: list[CanFrame] = []
        self._own: list[tuple[int, bytes]] = []

    def receive(self, can_id: int, data: bytes, t_ns: int) -> None:
        self._heard.append(CanFrame(can_id & ~EXTENDED, data, bool(can_id & EXTENDED)))

    def take(self) -> list[tuple[int, bytes]]:
        own, self._own = self._own, []
        return own

    def next_event_ns(self) -> int | None:
        return None

    def advance_to(self, t_ns: int) -> None:
        pass

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        while self._pump(0.0):  # accepts who has connected
            pass
        self._own.append((frame.can_id | (EXTENDED if frame.extended else 0), frame.data))
        for _ in range(2):
            self._advance()

    def recv(self, timeout_s: float) -> CanFrame | None:
        while not self._heard and self._pump(timeout_s):
            pass
        return self._heard.pop(0) if self._heard else None

    def _pump(self, timeout_s: float) -> bool:
        ready = select.select(self.server.filenos(), (), (), timeout_s)[0]
        for fileno in ready:
            self.server.pump(fileno, self._t_ns)
        self._advance()
        return bool(ready)

    def _advance(self) -> None:
        self._t_ns += 1_000_000_000
        self._hub.advance_to(self._t_ns)

    def stats(self) -> CanStats:
        return CanStats()

    def info(self) -> PortInfo:
        return PortInfo("test://", "far end", emulated=True)

    def close(self) -> None:
        self.server.close()


class TestUnix(CanContract):
    burst = 100
    """As many as a Unix socket holds for a host that does not read (net.unix.max_dgram_qlen does not bind it)."""

    @pytest.fixture
    def pair(self, tmp_path: Path) -> Iterator[CanPair]:
        far = FarNode(tmp_path)
        clock = MonotonicClock()
        bus = open_can(far.server.uri, 500_000, clock)
        yield CanPair(bus, far, clock)
        bus.close()
        far.close()

    def test_a_second_connection_hears_the_node_and_not_the_first(self, pair: CanPair):
        assert isinstance(pair.bus, UnixCan)
        second = pair.bus.for_thread(())
        pair.bus.send(CanFrame(0x100, b"mine"), 0.5)
        assert content(pair.far.recv(2.0)) == (0x100, b"mine", False)
        pair.far.send(CanFrame(0x121, b"all"), 0.5)
        assert content(pair.bus.recv(2.0)) == content(second.recv(2.0)) == (0x121, b"all", False)
        assert second.recv(0.01) is None
        second.close()

    def test_a_host_that_does_not_read_loses_frames_and_holds_nobody_up(self, pair: CanPair):
        assert isinstance(pair.far, FarNode)
        for _ in range(100_000):
            pair.far.send(CanFrame(0x121, b""), 0.0)
            if pair.far.server.lost:
                break
        assert pair.far.server.lost == 1

    def test_a_world_that_does_not_read_is_a_timeout(self, pair: CanPair):
        def send_many() -> None:
            for _ in range(100_000):
                pair.bus.send(CanFrame(0x120, b""), 0.0)

        with pytest.raises(HalTimeout, match="queue is full"):
            send_many()

    def test_a_world_that_has_gone_is_a_disconnect(self, pair: CanPair):
        pair.far.recv(0.0)
        pair.far.close()
        with pytest.raises(Disconnected):
            pair.bus.recv(0.1)


def test_no_socketcan_here_or_no_such_interface():
    with pytest.raises(DeviceNotFound, match="socketcan://nosuch0"):
        open_can("socketcan://nosuch0", 500_000)


def test_absent_adapter():
    with pytest.raises(DeviceNotFound):
        open_can("slcan:///dev/ttyNOSUCH0", 500_000)


def test_impossible_bitrate():
    master, slave = os.openpty()
    with pytest.raises(BenchError, match="bitrate"):
        open_can(f"slcan://{os.ttyname(slave)}", 123_456)
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize(
    "uri",
    [
        "can0",
        "pcan://1",
        "socketcan://",
        "udp-multicast://239.1.1.1",
        "udp-multicast://g:p",
        "virtual-can://x?a=1",
        "unix-can://host",
    ],
)
def test_uris_that_are_refused(uri: str):
    with pytest.raises(BenchError):
        open_can(uri, 500_000)
