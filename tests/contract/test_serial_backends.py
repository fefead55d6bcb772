"""The serial contract on the real pyserial over a pseudo-terminal, and what only that adapter has."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Iterator

import pytest

from hal.backends import open_serial
from hal.backends.pyserial_port import PyserialPort
from hal.clock import MonotonicClock
from hal.errors import BenchError, DeviceNotFound, HalTimeout
from tests.contract.serial_contract import SerialContract, SerialLink


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    """(descriptor of the far end, path that pyserial opens)"""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for fd in (master, slave):
        with contextlib.suppress(OSError):  # the test may have hung up
            os.close(fd)


def receive(fd: int, n: int) -> bytes:
    data = b""
    while len(data) < n:
        assert select.select([fd], [], [], 2.0)[0], f"only {data!r} arrived"
        data += os.read(fd, n - len(data))
    return data


class TestPyserial(SerialContract):
    @pytest.fixture
    def link(self, pty: tuple[int, str]) -> Iterator[SerialLink]:
        master, path = pty
        port = open_serial(f"serial://{path}?baud=921600")
        assert isinstance(port, PyserialPort)

        def send(data: bytes) -> None:
            os.write(master, data)
            sent.append(len(data))

        sent: list[int] = []

        def settle() -> None:
            # the kernel moves pty data in a worker: wait until all of it is in the input queue
            for _ in range(2000):
                if port._port.in_waiting >= sum(sent):
                    return
                select.select([], [], [], 0.001)
            raise AssertionError("the pty did not deliver")

        yield SerialLink(port, send, lambda n: receive(master, n), lambda: os.close(master), MonotonicClock(), settle)
        port.close()

    def test_full_buffer_is_a_timeout_that_counts(self, link: SerialLink):
        with pytest.raises(HalTimeout) as caught:
            link.port.write(b"x" * 200_000, 0.05)
        assert 0 < caught.value.partial < 200_000
        assert len(link.receive(caught.value.partial)) == caught.value.partial

    def test_a_long_write_goes_out_when_the_peer_reads(self, link: SerialLink):
        with pytest.raises(HalTimeout) as caught:
            link.port.write(b"y" * 100_000, 0.0)
        assert caught.value.partial > 0

    def test_info_says_that_a_pty_is_emulated(self, link: SerialLink):
        assert link.port.info().emulated


def test_absent_port_says_what_to_do():
    with pytest.raises(DeviceNotFound, match="plugged in"):
        open_serial("serial:///dev/ttyNOSUCH0")


def test_second_opening_says_in_use(pty: tuple[int, str]):
    first = open_serial(f"serial://{pty[1]}")
    with pytest.raises(DeviceNotFound, match="in use"):
        open_serial(f"serial://{pty[1]}")
    first.close()


@pytest.mark.parametrize(
    "uri",
    [
        "/dev/ttyACM0",
        "tcp://host:1",
        "serial://",
        "serial:///dev/x?baud=fast",
        "serial:///dev/x?speed=1",
        "serial://dev/x",
    ],
)
def test_uris_that_are_refused(uri: str):
    with pytest.raises(BenchError):
        open_serial(uri)


def test_unknown_scheme_names_the_allowed_ones():
    with pytest.raises(BenchError, match="serial:///dev/ttyACM0"):
        open_serial("usb://1")
