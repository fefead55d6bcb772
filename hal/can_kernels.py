"""Send and receive CAN frames in compiled code without the interpreter (Linux, x86-64).

Frames travel over a non-blocking socket that carries ``struct can_frame`` (``hal.can_wire``): a raw CAN socket of the
kernel or that of an emulated bus. In virtual time two functions of Python stand for any bus. Nothing blocks.
"""

# pyright: basic
# the calls of numba's intrinsics have no types

from __future__ import annotations

import errno
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.can_carrier import PYTHON
from hal.can_wire import DATA_AT, ERROR, FRAME_BYTES, LENGTH_AT, MAX_DATA, REMOTE
from hal.compiled import kernel
from hal.fd_kernels import EAGAIN, now_ns, read_fd, write_fd
from hal.python_call import call_python

KIND, SEND_CALL, RECEIVE_CALL, RECEIVED_NS, FIELDS = range(5)
"""Places in ``CanLine.words``. ``SEND_CALL`` and ``RECEIVE_CALL``: addresses of the functions of ``PYTHON``, which
return what ``send`` and ``receive`` return; ``RECEIVED_NS``: when the frame in ``received`` came."""
NO_ROOM, GONE = -errno.EAGAIN, -errno.ECONNRESET
NOTHING, CAME, ODD = range(3)
"""Results of ``receive``. ODD: a remote, error or FD frame, or damage; it is to be passed over."""
ROOM = 80
"""Room for ``struct canfd_frame``, 72 bytes, which a socket may deliver."""
IDENTIFIER_BYTES = 4


class CanLine(NamedTuple):
    """Holds the frame to be sent, (16,), and the one that was received, (ROOM,)."""

    words: NDArray[np.int64]
    outgoing: NDArray[np.uint8]
    received: NDArray[np.uint8]


def new_line(kind: int, calls: tuple[int, int] = (0, 0)) -> CanLine:
    """Return the memory of a line. ``calls``: see ``SEND_CALL``."""
    return CanLine(np.array([kind, *calls, 0]), np.zeros(FRAME_BYTES, np.uint8), np.zeros(ROOM, np.uint8))


@kernel
def put_head(line: CanLine, can_id: int, n: int) -> None:
    """Begin ``outgoing``: a data frame with the base identifier ``can_id`` and ``n`` data bytes, from DATA_AT on."""
    for i in range(IDENTIFIER_BYTES):
        line.outgoing[i] = can_id >> 8 * i & 0xFF
    line.outgoing[LENGTH_AT] = n


@kernel
def send(line: CanLine, fd: int) -> int:
    """Send ``outgoing``. Return 0, or a negative errno: NO_ROOM when the queue of the adapter is full."""
    if line.words[KIND] == PYTHON:
        return call_python(line.words[SEND_CALL])  # pyright: ignore[reportCallIssue]
    done = write_fd(fd, line.outgoing, FRAME_BYTES, 0)
    if done < 0:
        return done
    return 0 if done == FRAME_BYTES else NO_ROOM


@kernel
def receive(line: CanLine, fd: int) -> int:
    """Receive a frame to ``received`` without waiting. Return NOTHING, CAME, ODD or a negative errno."""
    if line.words[KIND] == PYTHON:
        return call_python(line.words[RECEIVE_CALL])  # pyright: ignore[reportCallIssue]
    n = read_fd(fd, line.received, 0, ROOM)
    if n == -EAGAIN:
        return NOTHING
    if n <= 0:
        return n if n < 0 else GONE
    line.words[RECEIVED_NS] = now_ns()
    is_data = n == FRAME_BYTES and identifier(line) & (REMOTE | ERROR) == 0 and line.received[LENGTH_AT] <= MAX_DATA
    return CAME if is_data else ODD


@kernel
def identifier(line: CanLine) -> int:
    """Return the identifier of the received frame with its flags."""
    word = 0
    for i in range(IDENTIFIER_BYTES):
        word |= np.int64(line.received[i]) << 8 * i
    return int(word)


@kernel
def data_of(line: CanLine) -> NDArray[np.uint8]:
    """Return the data bytes of the received frame."""
    return line.received[DATA_AT : DATA_AT + line.received[LENGTH_AT]]
