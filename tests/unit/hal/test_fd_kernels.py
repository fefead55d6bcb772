"""Compiled calls of libc over a socket pair and a pty: data, no data, peers that go, signals, full pipes."""

from __future__ import annotations

import errno
import os
import pty
import signal
import socket
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import pytest

from hal import fd_kernels as fds
from hal.compiled import thread_kernel

NOT_AT_ALL = 0


class Pair(NamedTuple):
    """``ours``: non-blocking descriptor under test; ``peer``: the other end, blocking; ``kind``: what they are."""

    ours: int
    peer: int
    kind: str


@pytest.fixture(params=["socket", "pty"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    if request.param == "socket":
        a, b = (end.detach() for end in socket.socketpair())
    else:
        b, a = pty.openpty()
        tty.setraw(a)
        tty.setraw(b)
    os.set_blocking(a, False)
    yield Pair(a, b, request.param)
    for fd in (a, b):
        with suppress(OSError):  # a test may have closed it
            os.close(fd)


def soon_ns(seconds: float = 10.0) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def read(fd: int, room: int = 64) -> int | bytes:
    """Wait, then read: the bytes, or the negative errno."""
    polls = np.array([fds.poll_word(fd, fds.POLLIN)])
    assert fds.wait_fds(polls, soon_ns()) == 1
    assert fds.is_ready(polls[0])
    buffer = np.zeros(room + 2, np.uint8)
    n = fds.read_fd(fd, buffer, 1, room + 1)
    assert buffer[0] == buffer[-1] == 0, "nothing is written beside the place that was given"
    return n if n <= 0 else bytes(buffer[1 : 1 + n])


def write(fd: int, data: bytes, until_ns: int = NOT_AT_ALL) -> int:
    return fds.write_fd(fd, np.frombuffer(data, np.uint8).copy(), len(data), until_ns)


def test_every_byte_value_both_ways(pair: Pair) -> None:
    data = bytes(range(256))
    os.write(pair.peer, data)
    got = b""
    while len(got) < 256:
        piece = read(pair.ours)
        assert isinstance(piece, bytes)
        got += piece
    assert got == data
    assert write(pair.ours, data) == 256
    back = b""
    while len(back) < 256:
        back += os.read(pair.peer, 256)
    assert back == data


def test_nothing_there_is_told_at_once(pair: Pair) -> None:
    assert fds.read_fd(pair.ours, np.zeros(8, np.uint8), 0, 8) == -errno.EAGAIN
    polls = np.array([fds.poll_word(pair.ours, fds.POLLIN)])
    assert fds.wait_fds(polls, NOT_AT_ALL) == 0
    assert not fds.is_ready(polls[0])


def test_waiting_ends_when_the_time_is_up_and_not_before(pair: Pair) -> None:
    until_ns = soon_ns(0.02)
    assert fds.wait_fds(np.array([fds.poll_word(pair.ours, fds.POLLIN)]), until_ns) == 0
    assert time.monotonic_ns() >= until_ns


def test_a_peer_that_closes_is_seen(pair: Pair) -> None:
    os.close(pair.peer)
    assert read(pair.ours) == 0
    said = write(pair.ours, b"x")
    assert said == (-errno.EPIPE if pair.kind == "socket" else -errno.EIO)  # Python ignores SIGPIPE


def test_of_several_the_ready_one_is_told(pair: Pair) -> None:
    other, far = socket.socketpair()
    with other, far:
        os.write(pair.peer, b"x")
        polls = np.array([fds.poll_word(fd, fds.POLLIN) for fd in (other.fileno(), pair.ours)])
        assert fds.wait_fds(polls, soon_ns()) == 1
        assert [fds.is_ready(word) for word in polls] == [False, True]


def test_a_full_pipe_takes_what_it_can_and_the_rest_later(pair: Pair) -> None:
    data = np.random.default_rng(1).integers(0, 256, 1 << 20).astype(np.uint8).tobytes()
    taken = write(pair.ours, data)
    assert 0 < taken < len(data)
    until_ns = soon_ns(0.02)
    taken += write(pair.ours, data[taken:], until_ns)  # a pty's worker makes room a little later
    assert taken < len(data)
    assert time.monotonic_ns() >= until_ns
    got = bytearray()

    def drain() -> None:
        while len(got) < len(data):
            got.extend(os.read(pair.peer, 1 << 16))

    reader = threading.Thread(target=drain)
    reader.start()
    with_the_gil_free(pair.ours, np.frombuffer(data[taken:], np.uint8).copy())
    reader.join()
    assert bytes(got) == data


@thread_kernel
def _write_free(fd: int, data: np.ndarray, until_ns: int) -> int:
    return fds.write_fd(fd, data, len(data), until_ns)


@thread_kernel
def _wait_free(polls: np.ndarray, until_ns: int) -> int:
    return fds.wait_fds(polls, until_ns)


@thread_kernel
def _sleep_free(t_ns: int) -> None:
    fds.sleep_until_ns(t_ns)


def with_the_gil_free(fd: int, data: np.ndarray) -> None:
    """The reader is a Python thread: it gets to run only because the kernel releases the GIL."""
    assert _write_free(fd, data, soon_ns(60.0)) == len(data)


def test_signals_change_neither_a_wait_nor_a_sleep(pair: Pair) -> None:
    """EINTR is repeated with what is left of the time. The signals arrive while the kernel runs without the GIL."""
    told: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: told.append(number))
    signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
    try:
        until_ns = soon_ns(0.05)
        assert _wait_free(np.array([fds.poll_word(pair.ours, fds.POLLIN)]), until_ns) == 0
        assert time.monotonic_ns() >= until_ns
        until_ns = soon_ns(0.05)
        _sleep_free(until_ns)
        assert time.monotonic_ns() >= until_ns
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert told


def test_a_closed_descriptor_is_an_error_and_no_wait() -> None:
    a, b = socket.socketpair()
    fd = a.detach()
    os.close(fd)
    b.close()
    assert fds.read_fd(fd, np.zeros(8, np.uint8), 0, 8) == -errno.EBADF
    assert write(fd, b"x", soon_ns()) == -errno.EBADF
    polls = np.array([fds.poll_word(fd, fds.POLLIN)])
    assert fds.wait_fds(polls, soon_ns()) == 1  # POLLNVAL: the read tells what it is


def test_the_clock_is_pythons() -> None:
    before_ns = time.monotonic_ns()
    assert before_ns <= fds.now_ns() <= time.monotonic_ns()
