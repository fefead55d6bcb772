"""What every SerialPort must do. An adapter's test class inherits this and gives ``link``: a port and its far end.

class TestMine(SerialContract):
    @pytest.fixture
    def link(self):
        yield SerialLink(port, send=..., receive=..., hang_up=..., clock=...)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from hal.contracts import Clock, SerialPort
from hal.errors import Closed, Disconnected, HalError


@dataclass
class SerialLink:
    """``send(bytes)`` at the far end, ``receive(n)`` what the port has written, ``hang_up()`` at the far end.

    ``settle()`` returns when what was sent has reached the port's input.
    """

    port: SerialPort
    send: Callable[[bytes], None]
    receive: Callable[[int], bytes]
    hang_up: Callable[[], None]
    clock: Clock
    settle: Callable[[], None] = lambda: None


def read_all(port: SerialPort, n: int, timeout_s: float = 1.0) -> bytes:
    """``n`` bytes in as many reads as it takes."""
    buf = bytearray(n)
    done = 0
    while done < n:
        got = port.read_into(memoryview(buf)[done:], timeout_s)
        assert got > 0, f"only {done} of {n} bytes arrived"
        done += got
    return bytes(buf)


class SerialContract:
    @pytest.fixture
    def link(self):
        raise NotImplementedError

    def test_every_byte_value_both_ways(self, link: SerialLink):
        data = bytes(range(256))
        link.send(data)
        assert read_all(link.port, 256) == data
        link.port.write(data, 1.0)
        assert link.receive(256) == data

    def test_read_returns_what_is_there(self, link: SerialLink):
        link.send(b"abc")
        link.settle()
        buf = bytearray(16)
        assert link.port.read_into(memoryview(buf), 1.0) == 3
        assert buf[:4] == b"abc\0"

    def test_read_never_exceeds_the_buffer(self, link: SerialLink):
        link.send(b"abcdef")
        link.settle()
        buf = bytearray(4)
        assert link.port.read_into(memoryview(buf), 1.0) == 4
        assert buf == b"abcd"
        assert read_all(link.port, 2) == b"ef"

    def test_poll_returns_at_once(self, link: SerialLink):
        before_ns = link.clock.now_ns()
        assert link.port.read_into(memoryview(bytearray(4)), 0.0) == 0
        # a bound against hanging, not a measurement: this machine is shared
        assert link.clock.now_ns() - before_ns < 1_000_000_000

    def test_timeout_is_per_call_and_not_early(self, link: SerialLink):
        for timeout_s in (0.02, 0.005):
            before_ns = link.clock.now_ns()
            assert link.port.read_into(memoryview(bytearray(4)), timeout_s) == 0
            assert link.clock.now_ns() - before_ns >= timeout_s * 1e9 * 0.99

    def test_drain_counts(self, link: SerialLink):
        link.send(b"x" * 100)
        link.settle()
        assert link.port.drain_input() == 100
        assert link.port.read_into(memoryview(bytearray(4)), 0.0) == 0

    def test_hang_up_is_a_disconnect(self, link: SerialLink):
        link.hang_up()
        with pytest.raises(Disconnected):
            link.port.read_into(memoryview(bytearray(4)), 1.0)
        with pytest.raises(Disconnected):
            link.port.write(b"x", 0.1)

    def test_info_names_the_port(self, link: SerialLink):
        info = link.port.info()
        assert "://" in info.uri
        assert info.description

    def test_close_twice_then_use(self, link: SerialLink):
        link.port.close()
        link.port.close()
        with pytest.raises(HalError) as caught:
            link.port.read_into(memoryview(bytearray(4)), 0.0)
        assert isinstance(caught.value, Closed)
        with pytest.raises(Closed):
            link.port.write(b"x", 0.1)
