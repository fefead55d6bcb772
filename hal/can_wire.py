"""Packs CAN frames as the kernel does: ``struct can_frame``, 16 bytes, one frame in each read and write of a socket.

Source: Linux, ``include/uapi/linux/can.h`` and ``Documentation/networking/can.rst``.
"""

from __future__ import annotations

import struct

from hal.types import CanFrame

FRAME = struct.Struct("=IB3x8s")
FRAME_BYTES = FRAME.size
LENGTH_AT, DATA_AT = 4, 8
"""Places of the number of data bytes and of the first of them."""
MAX_DATA = 8
EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
"""Flags in the identifier's word."""


def pack_frame(frame: CanFrame) -> bytes:
    """Return the bytes of ``frame``, which has at most 8 data bytes."""
    return FRAME.pack(frame.can_id | (EXTENDED if frame.extended else 0), len(frame.data), frame.data)


def unpack_frame(packed: bytes, t_ns: int) -> CanFrame | None:
    """Return the data frame in ``packed``. Return None for a remote or error frame, an FD frame and damage."""
    if len(packed) != FRAME_BYTES:
        return None
    word, n, data = FRAME.unpack(packed)
    if word & (REMOTE | ERROR) or n > MAX_DATA:
        return None
    return CanFrame(word & ~EXTENDED, data[:n], bool(word & EXTENDED), t_ns)
