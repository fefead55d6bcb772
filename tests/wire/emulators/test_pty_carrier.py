"""The pty carrier under the real pyserial: bytes, the device's own FIFO limit, unplugging. Nothing waits on time."""

from __future__ import annotations

import select
from collections.abc import Iterator

import pytest
import serial

from sim_devices.devices.di4108 import Di4108
from sim_devices.transports.pty_carrier import PtyCarrier
from tests.wire.emulators.held import HeldVoltages

MS = 1_000_000


class Stand:
    def __init__(self) -> None:
        self.truth = HeldVoltages(8)
        self.device = Di4108(self.truth)
        self.carrier = PtyCarrier(self.device)
        self.port = serial.Serial(self.carrier.path, 115200, timeout=2.0, exclusive=True)
        self.t_ns = 0

    def turn(self, dt_ns: int = 0) -> None:
        self.t_ns += dt_ns
        self.carrier.refresh()
        self.device.advance_to(self.t_ns)
        self.carrier.receive(self.t_ns)
        self.carrier.send()

    def settle(self, n: int) -> None:
        """Until ``n`` bytes lie unread: the kernel moves pty data in a worker of its own."""
        for _ in range(5000):
            if self.port.in_waiting >= n:
                return
            select.select([], [], [], 0.001)
        raise AssertionError(f"the pty delivered {self.port.in_waiting} of {n} bytes")

    def command(self, text: bytes) -> bytes:
        self.port.write(text + b"\r")
        self.turn()
        return self.port.read_until(b"\r")

    def start(self) -> None:
        for text in (b"srate 60000", *(b"slist %d %d" % (i, 256 + i) for i in range(8))):
            assert self.command(text) == text + b"\r"
        self.port.write(b"start 0\r")
        self.turn()


@pytest.fixture
def stand() -> Iterator[Stand]:
    stand = Stand()
    yield stand
    stand.carrier.unplug()
    stand.port.close()


def test_commands_and_binary_stream_pass_unchanged(stand: Stand) -> None:
    assert stand.command(b"info 1") == b"info 1 4108\r"
    stand.start()
    # codes that a cooked tty would change: CR, LF, XON, XOFF, ^C, ^D, ^Z, DEL
    codes = [0x0D0A, 0x1113, 0x0304, 0x1A7F, 0x0000, 0x7FFF, -0x8000, -1]
    stand.truth.volts_V[:] = [c * 5.0 / 32768 for c in codes]
    stand.turn(MS)
    assert stand.port.read(16) == b"".join((c & 0xFFFF).to_bytes(2, "little") for c in codes)


def test_the_devices_fifo_overflows_not_the_pty(stand: Stand) -> None:
    stand.start()
    for k in range(1, 129):
        stand.turn(MS)
        stand.settle(16 * k)
    stand.turn()
    assert stand.device.fifo_samples == 1024
    assert stand.device.scanning
    stand.turn(MS)
    assert not stand.device.scanning
    data = stand.port.read(2055)
    assert data.endswith(b"stop 01")
    assert len(data) == 2055
    stand.port.timeout = 0
    assert stand.port.read(1) == b""


def test_a_host_that_reads_keeps_the_fifo_empty(stand: Stand) -> None:
    stand.start()
    for _ in range(300):
        stand.turn(MS)
        assert len(stand.port.read(16)) == 16
    stand.carrier.refresh()
    assert stand.device.fifo_samples == 0


def test_a_host_that_drains_late_loses_nothing(stand: Stand) -> None:
    stand.start()
    total = 0
    for _ in range(5):
        for _ in range(100):
            stand.turn(MS)
        total += len(stand.port.read(1600))
    assert total == 5 * 1600
    assert stand.device.overflows == 0


def test_unplugging_is_what_pyserial_calls_a_lost_device(stand: Stand) -> None:
    stand.start()
    stand.carrier.unplug()
    stand.carrier.unplug()
    with pytest.raises(serial.SerialException):
        stand.port.read(1)
    with pytest.raises(serial.SerialException):
        stand.port.write(b"stop\r")
    assert stand.carrier.fileno() == -1
    stand.turn(MS)  # the device goes on without a host
