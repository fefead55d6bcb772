"""Reads, writes, waits and sleeps on file descriptors in compiled code, without the interpreter (Linux, x86-64).

A compiled loop calls these kernels instead of ``os.read`` and ``select``. Descriptors must be non-blocking. A call
that a signal interrupts is repeated; every other failure is returned as a negative errno and never raised. Nothing is
allocated. Times are those of CLOCK_MONOTONIC in ns, which is also ``time.monotonic_ns``.
Source: POSIX.1-2017 (read, write, clock_nanosleep), Linux man page poll(2).
"""

# pyright: basic
# numba's external functions have no types

from __future__ import annotations

import errno
import select
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from hal.compiled import kernel
from hal.scratch import stack_index

POLLIN, POLLOUT = select.POLLIN, select.POLLOUT
EINTR, EAGAIN = errno.EINTR, errno.EAGAIN
CLOCK_MONOTONIC, TIMER_ABSTIME = 1, 1
SECOND_NS = 1_000_000_000
FD_MASK, EVENTS_SHIFT, REVENTS_SHIFT = 0xFFFF_FFFF, 32, 48

# found by name in the process, so that compiled code can be cached; pointers of ctypes could not
_read = types.ExternalFunction("read", types.intp(types.int32, types.uintp, types.uintp))
_write = types.ExternalFunction("write", types.intp(types.int32, types.uintp, types.uintp))
_ppoll = types.ExternalFunction("ppoll", types.int32(types.uintp, types.uintp, types.uintp, types.uintp))
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))
_clock_nanosleep = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, types.uintp, types.uintp)
)
_errno_location = types.ExternalFunction("__errno_location", types.CPointer(types.int32)())


@kernel
def last_errno() -> int:
    """Return the errno of the last call of this thread that failed."""
    return numba.carray(  # pyright: ignore[reportPrivateImportUsage]
        _errno_location(), 1
    )[0]


@kernel
def now_ns() -> int:
    """Return the time."""
    t = stack_index(2)  # pyright: ignore[reportCallIssue]
    _clock_gettime(CLOCK_MONOTONIC, t.ctypes.data)
    return t[0] * SECOND_NS + t[1]


@kernel
def sleep_until_ns(t_ns: int) -> None:
    """Sleep until ``t_ns``. Return at once when that time has passed."""
    t = stack_index(2)  # pyright: ignore[reportCallIssue]
    t[0], t[1] = t_ns // SECOND_NS, t_ns % SECOND_NS
    while _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, t.ctypes.data, 0) == EINTR:
        pass


@kernel
def read_fd(fd: int, buffer: NDArray[np.uint8], begin: int, end: int) -> int:
    """Read what is there, at most to ``buffer[begin:end]``. Return the number of bytes, 0 at the end of the stream (the
    peer has closed it), or a negative errno: -EAGAIN when nothing is there."""
    while True:
        n = _read(fd, buffer.ctypes.data + begin, end - begin)
        if n >= 0:
            return n
        failed = last_errno()
        if failed != EINTR:
            return -failed


@kernel
def wait_fds(polls: NDArray[np.int64], until_ns: int) -> int:
    """Wait until one of ``polls`` (n,) of ``poll_word`` is ready, or ``until_ns``. Return how many are ready, 0 when
    the time is up, or a negative errno; ``is_ready`` tells which. Errors and hang-ups count as
    ready: a read tells more."""
    t = stack_index(2)  # pyright: ignore[reportCallIssue]
    while True:
        left_ns = max(0, until_ns - now_ns())
        t[0], t[1] = left_ns // SECOND_NS, left_ns % SECOND_NS
        n = _ppoll(polls.ctypes.data, len(polls), t.ctypes.data, 0)
        if n >= 0:
            return n
        failed = last_errno()
        if failed != EINTR:
            return -failed


def _fence(ordering: str) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence(ordering)
        return context.get_dummy_value()

    return types.none(), generate


@intrinsic
def release_fence(typing_context: Any) -> Any:
    """Keep what was stored before in front of what is stored after, for the compiler and the processor."""
    return _fence("release")


@intrinsic
def full_fence(typing_context: Any) -> Any:
    """Keep all that was loaded and stored before in front of what comes after, for the compiler and the processor."""
    return _fence("seq_cst")


@kernel
def poll_word(fd: int, events: int) -> int:
    """Return the ``struct pollfd`` of ``fd`` as one little-endian word. ``events``: POLLIN, POLLOUT or both."""
    return (fd & FD_MASK) | events << EVENTS_SHIFT


@kernel
def is_ready(word: int) -> bool:
    """Return True if ``word`` of ``wait_fds`` has an event, an error or a hang-up."""
    return word >> REVENTS_SHIFT != 0


@kernel
def write_fd(fd: int, data: NDArray[np.uint8], n: int, until_ns: int) -> int:
    """Write ``data[:n]`` (bytes) and wait for room until ``until_ns``, or not at all if that is 0.

    Return the number of bytes written, fewer than ``n`` when the time is up, or a negative errno: some bytes may have
    been written then."""
    done = 0
    while done < n:
        written = _write(fd, data.ctypes.data + done, n - done)
        if written >= 0:
            done += written
            continue
        failed = last_errno()
        if failed == EAGAIN:
            polls = stack_index(1)  # pyright: ignore[reportCallIssue]
            polls[0] = poll_word(fd, POLLOUT)
            ready = wait_fds(polls, until_ns)
            if ready < 0:
                return ready
            if ready == 0:
                break
        elif failed != EINTR:
            return -failed
    return done
