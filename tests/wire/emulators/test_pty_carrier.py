"""The pty carrier under the real pyserial: bytes, the device's own FIFO limit, unplugging. Nothing waits on time."""

from __future__ import annotations

import select
from collections.abc import Iterator

import pytest
import serial

from sim_devices.devices.di4108 import Di4108
from sim_devices.devices.faces import HeldVoltages
from sim_devices.transports.pty_carrier import PtyCarrier

MS = 1_000_000


class Rig:
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
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.carrier.unplug()
    rig.port.close()


def test_commands_and_binary_stream_pass_unchanged(rig: Rig) -> None:
    assert rig.command(b"info 1") == b"info 1 4108\r"
    rig.start()
    # codes that a cooked tty would change: CR, LF, XON, XOFF, ^C, ^D, ^Z, DEL
    codes = [0x0D0A, 0x1113, 0x0304, 0x1A7F, 0x0000, 0x7FFF, -0x8000, -1]
    rig.truth.volts_V[:] = [c * 5.0 / 32768 for c in codes]
    rig.turn(MS)
    assert rig.port.read(16) == b"".join((c & 0xFFFF).to_bytes(2, "little") for c in codes)


def test_the_devices_fifo_overflows_not_the_pty(rig: Rig) -> None:
    rig.start()
    for k in range(1, 129):
        rig.turn(MS)
        rig.settle(16 * k)
    rig.turn()
    assert rig.device.fifo_samples == 1024
    assert rig.device.scanning
    rig.turn(MS)
    assert not rig.device.scanning
    data = rig.port.read(2055)
    assert data.endswith(b"stop 01")
    assert len(data) == 2055
    rig.port.timeout = 0
    assert rig.port.read(1) == b""


def test_a_host_that_reads_keeps_the_fifo_empty(rig: Rig) -> None:
    rig.start()
    for _ in range(300):
        rig.turn(MS)
        assert len(rig.port.read(16)) == 16
    rig.carrier.refresh()
    assert rig.device.fifo_samples == 0


def test_a_host_that_drains_late_loses_nothing(rig: Rig) -> None:
    rig.start()
    total = 0
    for _ in range(5):
        for _ in range(100):
            rig.turn(MS)
        total += len(rig.port.read(1600))
    assert total == 5 * 1600
    assert rig.device.overflows == 0


def test_unplugging_is_what_pyserial_calls_a_lost_device(rig: Rig) -> None:
    rig.start()
    rig.carrier.unplug()
    rig.carrier.unplug()
    with pytest.raises(serial.SerialException):
        rig.port.read(1)
    with pytest.raises(serial.SerialException):
        rig.port.write(b"stop\r")
    assert rig.carrier.fileno() == -1
    rig.turn(MS)  # the device goes on without a host
