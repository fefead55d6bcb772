"""Encodes messages between a host and its guest: a JSON head with float64 arrays. Nothing in them can run."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from hal.arrays import Array

_SIZES = struct.Struct("<QQ")
MOST_HEAD = 1 << 24


class FrameError(ValueError):
    """The bytes are no message."""


def frame_parts(head: Mapping[str, Any], arrays: Mapping[str, Array]) -> list[bytes | memoryview]:
    """Return the bytes of a message with ``head`` and arrays by name, each sent flat."""
    flat = {name: np.ascontiguousarray(x, np.float64).ravel() for name, x in arrays.items()}
    text = json.dumps({**head, "arrays": [[name, x.size] for name, x in flat.items()]}, default=str).encode()
    sizes = _SIZES.pack(len(text), 8 * sum(x.size for x in flat.values()))
    return [sizes + text, *(x.data.cast("B") for x in flat.values() if x.size)]


def read_sizes(data: bytes) -> tuple[int, int]:
    """Return the bytes of the head and of the arrays that follow. ``FrameError`` for a head that cannot be one."""
    head, body = _SIZES.unpack(data)
    if head > MOST_HEAD or body % 8:
        raise FrameError(f"a message with a head of {head} bytes and {body} bytes of numbers")
    return head, body


def read_parts(text: bytes, body: bytes | bytearray) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the head and the arrays (n,). ``FrameError`` when they do not fit together."""
    try:
        head = json.loads(text)
        sizes = [(str(name), int(size)) for name, size in head.pop("arrays")]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FrameError(f"a head that cannot be read ({error!r})") from error
    if any(size < 0 for _, size in sizes) or 8 * sum(size for _, size in sizes) != len(body):
        raise FrameError("arrays of other lengths than the message")
    every = np.frombuffer(body, np.float64)
    arrays: dict[str, Array] = {}
    at = 0
    for name, size in sizes:
        arrays[name] = every[at : at + size]
        at += size
    return head, arrays


SIZES_BYTES = _SIZES.size
