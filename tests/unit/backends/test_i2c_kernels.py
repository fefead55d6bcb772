"""Compiled I2C transfers: over the socket of an emulated bus, and by a function of Python."""

from __future__ import annotations

import socket
import threading

import pytest

from hal.backends.unix_i2c import UnixI2c
from hal.compiled import thread_kernel
from hal.errors import Disconnected, ErrorKind, HalTimeout, I2cNack
from hal.i2c_carrier import PYTHON, SOCKET, I2cCarrier
from hal.i2c_kernels import (
    GONE,
    NO_ANSWER,
    REPLY_SIZE,
    Transfer,
    new_transfer,
    ops_of,
    transfer,
    write_at,
)
from hal.python_call import python_call
from hal.types import I2cRead, I2cWrite

OPS = (I2cWrite(b"\x10\xaa\xbb"), I2cWrite(b"\x01"), I2cRead(4))


@thread_kernel
def transfer_beside(t: Transfer, fd: int) -> int:
    return transfer(t, fd)


def exchange(answers: list[bytes], *, ends: bool = False) -> tuple[list[bytes], list[int], Transfer]:
    """Make as many transfers as there are ``answers``. Return the requests, the results and the memory."""
    near, far = socket.socketpair()
    near.settimeout(None)
    requests: list[bytes] = []

    def serve() -> None:
        for answer in answers:
            requests.append(far.recv(100))
            for byte in answer:  # in pieces
                far.sendall(bytes((byte,)))
        if ends:
            far.close()

    t = new_transfer(SOCKET, 0x0C, OPS)
    server = threading.Thread(target=serve)
    server.start()
    with near, far:
        results = []
        for code in range(len(answers) + ends):
            t.request[write_at(OPS, 0, 1)] = code
            results.append(transfer_beside(t, near.fileno()))
        server.join()
    return requests, results, t


def test_the_bytes_are_those_of_the_python_client():
    requests, results, t = exchange([b"\x00\x04\x00wxyz"])
    assert results == [0]
    assert t.reply[REPLY_SIZE:].tobytes() == b"wxyz"
    head, time_ns, segments = requests[0][:2], requests[0][2:10], requests[0][10:]
    assert head == b"\x0c\x03"
    assert int.from_bytes(time_ns, "little") > 0
    assert segments == b"\x00\x03\x00\x10\x00\xbb" + b"\x00\x01\x00\x01" + b"\x01\x04\x00"
    assert ops_of(t) == [I2cWrite(b"\x10\x00\xbb"), I2cWrite(b"\x01"), I2cRead(4)]


def test_the_status_and_the_end_are_results():
    _, results, _ = exchange([b"\x00\x04\x00wxyz", b"\x02\x00\x00"], ends=True)
    assert results[:2] == [0, 2]
    assert results[2] < 0


def test_an_answer_of_another_length_is_no_answer():
    assert exchange([b"\x00\x02\x00wx"])[1] == [GONE]


def test_a_function_of_python_is_a_bus():
    results = [0, 7]
    address, kept = python_call(lambda: results.pop(0))
    t = new_transfer(PYTHON, 0x0C, OPS, address)
    assert [transfer(t, -1), transfer(t, -1)] == [0, 7]
    del kept


def test_failures_are_the_errors_of_the_python_client(tmp_path):
    path = str(tmp_path / "bus")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path)
        server.listen()
        bus = UnixI2c(path)
        assert isinstance(bus, I2cCarrier)
        thread = bus.for_thread()
        assert thread.fileno() != bus.fileno()
        for code, kind in ((1, I2cNack), (2, I2cNack), (NO_ANSWER, HalTimeout), (GONE, Disconnected)):
            assert isinstance(thread.failure(code, 0x0C), kind)
        assert thread.failure(2, 0x0C).kind is ErrorKind.NACK_DATA
        thread.close()
        bus.close()


@pytest.mark.parametrize("byte", [0, 2])
def test_a_place_in_the_request_is_where_the_byte_stands(byte: int):
    t = new_transfer(SOCKET, 0x0C, OPS)
    assert t.request[write_at(OPS, 0, byte)] == OPS[0].data[byte]
