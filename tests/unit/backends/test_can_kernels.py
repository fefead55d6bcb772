"""Compiled CAN frames over a socket pair: the far end is python-can's own code for sockets of the kernel."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator

import can
import numpy as np
import pytest
from can.interfaces.socketcan import socketcan
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.backends.python_can import SocketCan, open_socketcan
from hal.can_carrier import SOCKET, CanCarrier
from hal.can_kernels import CAME, GONE, NO_ROOM, NOTHING, ODD, data_of, identifier, new_line, put_head, receive, send
from hal.can_wire import DATA_AT, EXTENDED, pack_frame, unpack_frame
from hal.clock import MonotonicClock
from hal.errors import Disconnected, HalTimeout
from hal.types import CanFrame

LEN8_DLC_AT = 7
"""Place of ``len8_dlc``, which counts for 8 bytes with a raw DLC of 9 to 15 alone; python-can fills it always."""


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[socket.socket, can.BusABC]]:
    """Our end, and a ``SocketcanBus`` whose socket is the far one."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    near.setblocking(False)
    monkeypatch.setattr(socketcan, "create_socket", lambda: far)
    monkeypatch.setattr(socketcan, "bind_socket", lambda made, channel: None)
    bus = can.Bus(interface="socketcan", channel="pair")
    with near:
        yield near, bus
    bus.shutdown()


def messages() -> st.SearchStrategy[can.Message]:
    base = st.tuples(st.integers(0, 0x7FF), st.just(False))
    extended = st.tuples(st.integers(0, 0x1FFF_FFFF), st.just(True))
    return st.builds(
        lambda of, data: can.Message(arbitration_id=of[0], is_extended_id=of[1], data=data),
        st.one_of(base, extended), st.binary(max_size=8),
    )  # fmt: skip


@settings(deadline=None)
@given(messages())
def test_frames_are_packed_as_python_can_packs_them(message: can.Message):
    frame = CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id)
    packed = socketcan.build_can_frame(message)
    ours = bytearray(pack_frame(frame))
    ours[LEN8_DLC_AT] = packed[LEN8_DLC_AT]
    assert ours == packed
    assert unpack_frame(packed, 0) == frame


def test_a_sent_frame_is_what_python_can_receives(pair: tuple[socket.socket, can.BusABC]):
    near, far = pair
    line = new_line(SOCKET)
    put_head(line, 0x120, 3)
    line.outgoing[DATA_AT : DATA_AT + 3] = 1, 2, 255
    assert send(line, near.fileno()) == 0
    message = far.recv(1.0)
    assert message is not None
    assert (message.arbitration_id, message.is_extended_id, bytes(message.data)) == (0x120, False, b"\x01\x02\xff")


def test_what_python_can_sends_is_received(pair: tuple[socket.socket, can.BusABC]):
    near, far = pair
    line = new_line(SOCKET)
    assert receive(line, near.fileno()) == NOTHING
    far.send(can.Message(arbitration_id=0x121, data=b"\x07\x08", is_extended_id=False))
    far.send(can.Message(arbitration_id=0x121, data=b"", is_extended_id=True))
    far.send(can.Message(arbitration_id=0x121, is_remote_frame=True, dlc=8, is_extended_id=False))
    assert receive(line, near.fileno()) == CAME
    assert (identifier(line), bytes(data_of(line))) == (0x121, b"\x07\x08")
    assert receive(line, near.fileno()) == CAME
    assert (identifier(line), bytes(data_of(line))) == (0x121 | EXTENDED, b"")
    assert receive(line, near.fileno()) == ODD
    assert receive(line, near.fileno()) == NOTHING


def test_a_full_queue_and_a_closed_bus_do_not_block(pair: tuple[socket.socket, can.BusABC]):
    near, far = pair
    line = new_line(SOCKET)
    put_head(line, 0x120, 8)
    taken = 0
    while (result := send(line, near.fileno())) == 0:
        taken += 1
    assert result == NO_ROOM
    assert taken > 2
    far.shutdown()
    while (result := receive(line, near.fileno())) == CAME:
        pass
    assert result in (GONE, -errno.ECONNRESET)
    assert send(line, near.fileno()) < 0


def test_a_bus_of_the_kernel_is_opened_again_for_the_thread(monkeypatch: pytest.MonkeyPatch):
    """Its sockets are pairs here, which take no filters: what is asked of the kernel is looked at."""
    far: list[socket.socket] = []
    filters: list[object] = []

    def create_socket() -> socket.socket:
        near, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        far.append(other)
        return near

    monkeypatch.setattr(socketcan, "create_socket", create_socket)
    monkeypatch.setattr(socketcan, "bind_socket", lambda made, channel: None)
    monkeypatch.setattr(socketcan.SocketcanBus, "_apply_filters", lambda bus, asked: filters.append(asked))
    bus = open_socketcan("can7", MonotonicClock())
    assert isinstance(bus, SocketCan)
    assert isinstance(bus, CanCarrier)
    own = bus.for_thread((0x121,))
    assert own.fileno() != bus.fileno()
    assert filters[-1] == [{"can_id": 0x121, "can_mask": 0x7FF, "extended": False}]
    line = new_line(own.CARRIER)
    assert receive(line, own.fileno()) == NOTHING, "it never waits"
    far[1].send(pack_frame(CanFrame(0x121, b"x")))
    assert receive(line, own.fileno()) == CAME
    assert isinstance(own.failure(NO_ROOM), HalTimeout)
    assert isinstance(own.failure(-errno.ENETDOWN), Disconnected)
    for each in (own, bus):
        each.close()
    for end in far:
        end.close()


@pytest.mark.parametrize("packed", [b"", bytes(15), bytes(72), bytes((0, 0, 0, 0, 9)) + bytes(11)])
def test_damage_is_no_frame(packed: bytes):
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    near.setblocking(False)
    assert unpack_frame(packed, 0) is None
    if packed:
        far.send(packed)
        assert receive(new_line(SOCKET), near.fileno()) == ODD
    near.close()
    far.close()


def test_the_line_keeps_nothing_of_an_earlier_frame():
    line = new_line(SOCKET)
    put_head(line, 0x7FF, 8)
    put_head(line, 0x001, 1)
    assert np.array_equal(line.outgoing[:5], [1, 0, 0, 0, 1])
