"""The emulated world's process writes its own pauses into a file that the firmware's process maps.

A host that stands still stops the world as well as the firmware. Without this a scan that the world made late looks
like a DAQ that is silent. One writer, one reader, aligned 64-bit words, bench time in ns.
"""

from __future__ import annotations

import mmap
from pathlib import Path

NAME = "lateness.bin"
STALL_NS = 2_000_000
"""A turn of the world that is later than this is a stall. It turns every millisecond."""
ALLOWED_NS = 1_000_000
"""The pause between two turns that is intended."""
_TURN, _ENDED, _LENGTH, _COUNT, _LONGEST = range(5)
_BYTES = 64


class Lateness:
    """Records the stalls of the world in a shared file; the world calls ``turn`` in every turn of its loop."""

    def __init__(self, folder: Path) -> None:
        path = folder / NAME
        path.write_bytes(bytes(_BYTES))
        with path.open("r+b") as file:
            self._words = memoryview(mmap.mmap(file.fileno(), _BYTES)).cast("q")

    def turn(self, now_ns: int) -> None:
        """Record that the world is awake at ``now_ns``, and a stall if it was late."""
        words = self._words
        late_ns = now_ns - words[_TURN] - ALLOWED_NS if words[_TURN] else 0
        if late_ns >= STALL_NS:
            words[_ENDED], words[_LENGTH] = now_ns, late_ns
            words[_COUNT] += 1
            words[_LONGEST] = max(words[_LONGEST], late_ns)
        words[_TURN] = now_ns


class LatenessView:
    """Reads the stalls of the world in the firmware's process."""

    def __init__(self, folder: Path) -> None:
        with (folder / NAME).open("rb") as file:
            self._words = memoryview(mmap.mmap(file.fileno(), _BYTES, access=mmap.ACCESS_READ)).cast("q")

    def stalled_ms(self, now_ns: int, within_ms: float) -> float:
        """Return the duration in ms of a stall of the world at ``now_ns`` or up to ``within_ms`` before.

        Returns 0 if there is none."""
        words = self._words
        if not words[_TURN]:
            return 0.0
        asleep_ns = now_ns - words[_TURN] - ALLOWED_NS
        if asleep_ns >= STALL_NS:
            return asleep_ns * 1e-6
        return words[_LENGTH] * 1e-6 if words[_ENDED] and (now_ns - words[_ENDED]) * 1e-6 <= within_ms else 0.0

    @property
    def stalls(self) -> int:
        """Return the number of stalls of the world."""
        return self._words[_COUNT]

    @property
    def longest_ms(self) -> float:
        return self._words[_LONGEST] * 1e-6
