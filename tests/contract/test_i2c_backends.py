"""The I2C contract on the emulated world's socket and on the real smbus2 (its ioctl and its os.open replaced)."""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import smbus2
import smbus2.smbus2

from hal.backends import open_i2c
from hal.backends.unix_i2c import UnixI2c
from hal.contracts import I2cBus
from hal.errors import (
    BenchError,
    BusError,
    Closed,
    DeviceNotFound,
    Disconnected,
    ErrorKind,
    HalError,
    HalTimeout,
    I2cNack,
    ProtocolError,
)
from hal.types import I2cRead, I2cWrite
from tests.contract.i2c_contract import MEMORY, REFUSING, I2cContract, RegisterDevice


def read_exactly(connection: socket.socket, n: int) -> bytes:
    data = b""
    while len(data) < n:
        if not (part := connection.recv(n - len(data))):
            raise EOFError
        data += part
    return data


def serve(listener: socket.socket, device: RegisterDevice) -> None:
    """The protocol in the docstring of unix_i2c, written a second time."""
    connection, _ = listener.accept()
    try:
        while True:
            address, count, asked_ns = struct.unpack("<BBq", read_exactly(connection, 10))
            assert asked_ns <= time.monotonic_ns()
            reply = b""
            status = {MEMORY: 0, REFUSING: 2}.get(address, 1)
            for _ in range(count):
                kind, length = struct.unpack("<BH", read_exactly(connection, 3))
                if kind == 0:
                    data = read_exactly(connection, length)
                    if status == 0:
                        device.write(data)
                elif status == 0:
                    reply += device.read(length)
            device.stop()
            if address == 0x7F:
                return
            connection.sendall(struct.pack("<BH", status, len(reply)) + reply)
    except EOFError:
        pass
    finally:
        connection.close()


class TestUnixSocket(I2cContract):
    @pytest.fixture
    def bus(self, tmp_path: Path) -> Iterator[I2cBus]:
        path = tmp_path / "i2c0.sock"
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            listener.bind(str(path))
            listener.listen(1)
            server = threading.Thread(target=serve, args=(listener, RegisterDevice()))
            server.start()
            bus = open_i2c(f"unix-i2c://{path}", 400_000)
            yield bus
            bus.close()
            server.join()

    def test_dead_world_is_a_disconnect(self, bus: I2cBus):
        with pytest.raises(Disconnected, match="gone"):
            bus.transfer(0x7F, [I2cRead(1)])


def test_stuck_world_is_a_bounded_wait_and_is_connected_to_anew(tmp_path: Path):
    """What hung comes back: the late answer to a request that was given up is not taken for the next one's."""
    path = tmp_path / "stuck.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen(4)  # connects, but nobody answers yet
        bus = UnixI2c(str(path), timeout_s=0.05)
        with pytest.raises(HalTimeout, match=r"no answer within 0\.05 s"):
            bus.transfer(MEMORY, [I2cRead(1)])
        late, _ = listener.accept()
        late.close()
        server = threading.Thread(target=serve, args=(listener, RegisterDevice()))
        server.start()
        assert len(bus.transfer(MEMORY, [I2cWrite(b"\x00"), I2cRead(1)])) == 1
        bus.close()
        server.join()
        with pytest.raises(Closed):
            bus.transfer(MEMORY, [I2cRead(1)])


def test_an_answer_of_another_length_is_no_answer_and_the_next_request_connects_anew(tmp_path: Path):
    path = tmp_path / "shifted.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen(4)
        bus = UnixI2c(str(path), timeout_s=1.0)
        shifted, _ = listener.accept()
        shifted.sendall(bytes.fromhex("00 0000"))  # what somebody else's write was answered
        with pytest.raises(ProtocolError, match="0 bytes were read where 1 were asked for"):
            bus.transfer(MEMORY, [I2cWrite(b"\x00"), I2cRead(1)])
        shifted.close()
        server = threading.Thread(target=serve, args=(listener, RegisterDevice()))
        server.start()
        assert len(bus.transfer(MEMORY, [I2cWrite(b"\x00"), I2cRead(1)])) == 1
        bus.close()
        server.join()


def test_a_world_that_has_gone_stays_a_disconnect(tmp_path: Path):
    path = tmp_path / "gone.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen(1)
        bus = UnixI2c(str(path), timeout_s=0.05)
    for _ in range(3):
        with pytest.raises(Disconnected, match="the emulated bus has gone"):
            bus.transfer(MEMORY, [I2cRead(1)])


class KernelBus:
    """Level A of ecosystem.md section 5: the kernel side of /dev/i2c-N. Reads and writes the caller's structs."""

    def __init__(self) -> None:
        self.device = RegisterDevice()
        self.error = 0

    def ioctl(self, fd: int, request: int, argument: object) -> int:
        if request == 0x0705:  # I2C_FUNCS: plain I2C and the SMBus emulation
            assert isinstance(argument, ctypes.c_ulong)
            argument.value = 0x0EFF0001
            return 0
        assert request == 0x0707  # I2C_RDWR
        messages, count = struct.unpack_from("@PI", ctypes.string_at(ctypes.addressof(argument), 16))
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        for i in range(count):
            # struct i2c_msg { u16 addr; u16 flags; u16 len; u8 *buf; }
            raw = ctypes.string_at(messages + 16 * i, 16)
            address, flags, length, buffer = struct.unpack("@HHHxxP", raw)
            if address != MEMORY:
                code = errno.EREMOTEIO if address == REFUSING else errno.ENXIO
                raise OSError(code, os.strerror(code))
            if flags & 1:
                ctypes.memmove(buffer, self.device.read(length), length)
            else:
                self.device.write(ctypes.string_at(buffer, length))
        self.device.stop()
        return 0


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> KernelBus:
    kernel = KernelBus()
    opened = SimpleNamespace(open=lambda path, flags: 99, close=lambda fd: None, O_RDWR=os.O_RDWR)
    monkeypatch.setattr(smbus2.smbus2, "ioctl", kernel.ioctl)
    monkeypatch.setattr(smbus2.smbus2, "os", opened)
    return kernel


class TestSmbus2(I2cContract):
    tells_data_nack = False

    @pytest.fixture
    def bus(self, kernel: KernelBus) -> Iterator[I2cBus]:
        bus = open_i2c("linux-i2c://1", 400_000)
        yield bus
        bus.close()

    def test_one_stop_per_transfer(self, bus: I2cBus, kernel: KernelBus):
        bus.transfer(MEMORY, [I2cWrite(b"\x00"), I2cRead(1), I2cRead(1)])
        assert (kernel.device.starts, kernel.device.stops) == (3, 1)

    @pytest.mark.parametrize(
        ("code", "kind", "error_class"),
        [
            (errno.ENXIO, ErrorKind.NACK_ADDRESS, I2cNack),
            (errno.EREMOTEIO, ErrorKind.NACK_ADDRESS, I2cNack),
            (errno.EAGAIN, ErrorKind.ARBITRATION, BusError),
            (errno.ETIMEDOUT, ErrorKind.TIMEOUT, HalTimeout),
            (errno.ENODEV, ErrorKind.DISCONNECTED, Disconnected),
            (errno.EBADMSG, ErrorKind.CRC, BusError),
            (errno.EIO, ErrorKind.BUS, BusError),
        ],
    )
    def test_kernel_fault_codes(
        self, bus: I2cBus, kernel: KernelBus, code: int, kind: ErrorKind, error_class: type[HalError]
    ):
        kernel.error = code
        with pytest.raises(error_class, match="0x50") as caught:
            bus.transfer(MEMORY, [I2cRead(1)])
        assert caught.value.kind is kind
        assert isinstance(caught.value.__cause__, OSError)


def test_a_linux_bus_belongs_to_one_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A second program of ours would undo the outputs of the first one, every millisecond."""
    monkeypatch.setattr(smbus2.smbus2, "ioctl", KernelBus().ioctl)
    path = tmp_path / "i2c-1"
    path.touch()
    first = open_i2c(f"linux-i2c://{path}")
    with pytest.raises(DeviceNotFound, match="in use by another program of ours, or twice in the bench file") as caught:
        open_i2c(f"linux-i2c://{path}")
    assert caught.value.device == str(path)
    first.transfer(MEMORY, [I2cWrite(b"\x00")])
    beside = open_i2c(f"linux-i2c://{path}", exclusive=False)  # the guardian's
    beside.transfer(MEMORY, [I2cWrite(b"\x00")])
    beside.close()
    first.close()
    open_i2c(f"linux-i2c://{path}").close()


def test_no_i2c_on_this_machine_says_what_to_do():
    with pytest.raises(DeviceNotFound, match="enable I2C"):
        open_i2c("linux-i2c://97")


def test_no_emulated_world(tmp_path: Path):
    with pytest.raises(DeviceNotFound, match="nobody serves"):
        open_i2c(f"unix-i2c://{tmp_path}/no.sock")


@pytest.mark.parametrize(
    "uri", ["i2c://1", "linux-i2c://one", "linux-i2c://", "unix-i2c://host/x", "linux-i2c://1?a=b"]
)
def test_uris_that_are_refused(uri: str):
    with pytest.raises(BenchError):
        open_i2c(uri)
