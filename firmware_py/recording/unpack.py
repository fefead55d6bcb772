"""Decompression with a hard limit: a declared size is a claim, and nothing is allocated on its word.

A frame of 65 kB can claim and deliver gigabytes (a decompression bomb). Every chunk is therefore unpacked as a stream
that stops at the size its header states, no chunk may be larger than ``MOST_CHUNK_BYTES``, and one file may unpack to
at most ``MOST_FREE_BYTES`` plus ``MOST_RATIO`` times its own size.
"""

from __future__ import annotations

from typing import Any

import lz4.frame  # pyright: ignore[reportMissingTypeStubs]
import zstandard

from firmware_py.recording.errors import RecordingError

MOST_CHUNK_BYTES = 1 << 26
MOST_FREE_BYTES = 1 << 28
MOST_RATIO = 500
"""A recording whose 85 columns are all zero packs 220 to 1, the best that the writer can do."""
_FRAME_ERRORS = (zstandard.ZstdError, RuntimeError, ValueError, EOFError, OSError)


class UnpackBudget:
    """The number of bytes that reading one file may still unpack. It keeps the work linear in the file's size."""

    def __init__(self, file_bytes: int) -> None:
        self.limit = self.left = MOST_FREE_BYTES + MOST_RATIO * file_bytes

    def spend(self, n_bytes: int) -> None:
        """Take ``n_bytes`` off. ``RecordingError`` when the file asks for more than any recording needs."""
        self.left -= n_bytes
        if self.left < 0:
            raise FileTooExpansive(
                f"it unpacks to more than {self.limit >> 20} MiB, which no recording of its size does"
            )


class FileTooExpansive(RecordingError):
    """The file as a whole unpacks to too much; nothing more is read from it."""


def unpack(compression: str, packed: bytes | memoryview, size: int, most_bytes: int = MOST_CHUNK_BYTES) -> bytes:
    """``size`` bytes from one frame (``"zstd"``, ``"lz4"``, or ``""`` for plain bytes).

    ``RecordingError`` when ``size`` is above ``most_bytes``, the frame is damaged or holds more or less than ``size``.
    """
    if size > most_bytes:
        raise RecordingError(f"it claims {size} bytes; at most {most_bytes} are read")
    if compression == "":
        content = bytes(packed)
    elif compression in _STREAMS:
        try:
            content = _STREAMS[compression](packed, size)
        except _FRAME_ERRORS as error:
            raise RecordingError(f"it cannot be unpacked: {error}") from error
    else:
        raise RecordingError(f"it is compressed with {compression!r}; zstd and lz4 can be read")
    if len(content) != size:
        more = "more" if len(content) > size else f"{len(content)}"
        raise RecordingError(f"it claims {size} bytes and holds {more}")
    return content


def _zstd(packed: bytes | memoryview, size: int) -> bytes:
    # the window is allocated on the frame's word as well
    decompressor = zstandard.ZstdDecompressor(max_window_size=MOST_CHUNK_BYTES)
    with decompressor.stream_reader(packed) as stream:
        return _read_up_to(stream, size + 1)


def _lz4(packed: bytes | memoryview, size: int) -> bytes:
    decompressor: Any = lz4.frame.LZ4FrameDecompressor()
    content: bytes = decompressor.decompress(packed, max_length=size + 1)
    while len(content) <= size and not decompressor.eof and not decompressor.needs_input:
        more = decompressor.decompress(b"", max_length=size + 1 - len(content))
        if not more:
            break
        content += more
    return content


def _read_up_to(stream: Any, most: int) -> bytes:
    parts: list[bytes] = []
    left = most
    while left:
        part = stream.read(min(left, 1 << 20))
        if not part:
            break
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


_STREAMS = {"zstd": _zstd, "lz4": _lz4}
