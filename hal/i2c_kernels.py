"""Make I2C transfers in compiled code without the interpreter (Linux, x86-64).

A ``Transfer`` is a fixed sequence of segments that is sent again and again with other bytes in its writes. It holds
these bytes and where the writes and the answer lie. It goes over one of three
carriers: ``ioctl(I2C_RDWR)`` on an adapter of Linux, the socket of an emulated bus, or a function of Python, which
stands for any bus in virtual time. A transfer blocks as long as the Python one does.

Source: Linux, ``Documentation/i2c/dev-interface.rst`` and ``include/uapi/linux/i2c.h`` (i2c_msg, i2c_rdwr_ioctl_data);
``hal.backends.unix_i2c`` for the socket's format, in which the bytes are kept.
"""

# pyright: basic
# numba's external functions have no types

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from hal.backends.unix_i2c import HEAD, REPLY, SEGMENT
from hal.compiled import kernel
from hal.fd_kernels import EINTR, POLLIN, last_errno, now_ns, poll_word, read_fd, wait_fds, write_fd
from hal.i2c_carrier import LINUX, PYTHON
from hal.python_call import call_python
from hal.scratch import stack_index
from hal.types import I2cOp, I2cRead, I2cWrite

KIND, ADDRESS, N_MESSAGES, N_READ, CALL, FIELDS = range(6)
"""Places in ``Transfer.words``. ``CALL``: address of the function of ``PYTHON``; ``N_READ``: bytes of the answer."""
I2C_RDWR, I2C_M_RD = 0x0707, 0x0001
TIME_AT = 2
"""Place of the time in the head of a request."""
REPLY_SIZE = REPLY.size
POLLED_NS = 10_000_000
"""Time for which an answer on a socket is waited for with ppoll, which sleeps on when the other end takes the request;
a blocking read, which waits after that, is woken by it and sleeps again."""
NO_ANSWER, GONE = -errno.EAGAIN, -errno.ECONNRESET

_ioctl = types.ExternalFunction("ioctl", types.int32(types.int32, types.uintp, types.uintp))


class Transfer(NamedTuple):
    """Holds one transfer. ``request``: as it goes over the socket; ``messages`` (2 n,): the ``struct i2c_msg`` of each
    segment, which point into ``request`` and ``reply``; ``reply``: the socket's head, then the bytes that were read."""

    words: NDArray[np.int64]
    request: NDArray[np.uint8]
    messages: NDArray[np.int64]
    reply: NDArray[np.uint8]


def new_transfer(kind: int, address: int, ops: Sequence[I2cOp], call: int = 0) -> Transfer:
    """Return the memory of a transfer of ``ops`` to the 7-bit ``address``. ``call``: see ``hal.python_call``."""
    request = HEAD.pack(address, len(ops), 0)
    begins: list[int] = []
    for op in ops:
        request += SEGMENT.pack(0, len(op.data)) if isinstance(op, I2cWrite) else SEGMENT.pack(1, op.n)
        begins.append(len(request))
        request += op.data if isinstance(op, I2cWrite) else b""
    n_read = sum(op.n for op in ops if not isinstance(op, I2cWrite))
    data = np.frombuffer(request, np.uint8).copy()
    reply = np.zeros(REPLY.size + n_read, np.uint8)
    messages = np.zeros(2 * len(ops), np.int64)
    answer = reply.ctypes.data + REPLY.size
    for i, (op, begin) in enumerate(zip(ops, begins, strict=True)):
        if isinstance(op, I2cWrite):
            messages[2 * i : 2 * i + 2] = address | len(op.data) << 32, data.ctypes.data + begin
        else:
            messages[2 * i : 2 * i + 2] = address | I2C_M_RD << 16 | op.n << 32, answer
            answer += op.n
    words = np.zeros(FIELDS, np.int64)
    words[KIND], words[ADDRESS], words[N_MESSAGES], words[N_READ], words[CALL] = kind, address, len(ops), n_read, call
    return Transfer(words, data, messages, reply)


def write_at(ops: Sequence[I2cOp], segment: int, byte: int) -> int:
    """Return the place in ``Transfer.request`` of a byte of the write ``ops[segment]``."""
    at = HEAD.size
    for op in ops[:segment]:
        at += SEGMENT.size + (len(op.data) if isinstance(op, I2cWrite) else 0)
    return at + SEGMENT.size + byte


def ops_of(t: Transfer) -> list[I2cOp]:
    """Return the segments as they stand in the memory now."""
    request, at = t.request.tobytes(), HEAD.size
    ops: list[I2cOp] = []
    for _ in range(int(t.words[N_MESSAGES])):
        is_read, n = SEGMENT.unpack_from(request, at)
        at += SEGMENT.size
        if is_read:
            ops.append(I2cRead(n))
        else:
            ops.append(I2cWrite(request[at : at + n]))
            at += n
    return ops


@kernel
def transfer(t: Transfer, fd: int) -> int:
    """Make the transfer; its answer is then in ``t.reply[REPLY.size:]``. Return 0, the status of an emulated bus (above
    0), or a negative errno: -EAGAIN when the socket gave no answer in time."""
    words = t.words
    if words[KIND] == PYTHON:
        return call_python(words[CALL])  # pyright: ignore[reportCallIssue]
    if words[KIND] == LINUX:
        return _transfer_linux(t, fd)
    return _transfer_socket(t, fd)


@kernel
def _transfer_linux(t: Transfer, fd: int) -> int:
    data = stack_index(2)  # pyright: ignore[reportCallIssue]
    data[0], data[1] = t.messages.ctypes.data, t.words[N_MESSAGES]
    while True:
        if _ioctl(fd, I2C_RDWR, data.ctypes.data) >= 0:
            return 0
        failed = last_errno()
        if failed != EINTR:
            return -failed


@kernel
def _transfer_socket(t: Transfer, fd: int) -> int:
    request, reply = t.request, t.reply
    at_ns = now_ns()
    for i in range(8):
        request[TIME_AT + i] = at_ns >> 8 * i & 0xFF
    done = write_fd(fd, request, len(request), 0)
    if done < len(request):
        return done if done < 0 else NO_ANSWER
    polls = stack_index(1)  # pyright: ignore[reportCallIssue]
    polls[0] = poll_word(fd, POLLIN)
    wait_fds(polls, at_ns + POLLED_NS)
    have, wanted = 0, REPLY_SIZE
    while have < wanted:
        n = read_fd(fd, reply, have, wanted)
        if n <= 0:
            return n if n < 0 else GONE
        have += n
        if have == REPLY_SIZE:
            if reply[0] != 0:
                return reply[0]
            wanted = REPLY_SIZE + t.words[N_READ]
            if reply[1] | reply[2] << 8 != t.words[N_READ]:
                return GONE
    return 0
