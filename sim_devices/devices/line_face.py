"""Devices on a serial line that take commands and speak in lines of text: what one has to say is what each line does.

Source: none of its own; the manual of the device that overrides it.

Model limits
- What it says is there at once; the carrier makes it as slow as the line. Nothing overflows.
"""

from __future__ import annotations

from sim_devices.devices.acting import ActingFace
from sim_devices.registry import Surroundings


class LineFace(ActingFace):
    """Implements the wire face of one device."""

    def __init__(self, around: Surroundings) -> None:
        self.around = around
        self.unread = 0
        self._heard, self._outgoing = b"", bytearray()

    # ------------------------------------------------------------------ for the device to override

    def hear(self, words: list[str], t_ns: int) -> None:
        """Obey one line of the host, given as its words (at least one)."""

    # ------------------------------------------------------------------

    def say(self, text: str) -> None:
        """Queue one line for the host."""
        self._outgoing += text.encode() + b"\n"

    def receive(self, data: bytes, t_ns: int) -> None:
        if self.frozen:
            return
        self.advance_to(t_ns)
        *lines, self._heard = (self._heard + data).split(b"\n")
        for line in lines:
            if words := line.decode("latin-1").split():
                self.hear(words, t_ns)

    def take(self, max_bytes: int) -> bytes:
        sent = bytes(self._outgoing[:max_bytes])
        del self._outgoing[:max_bytes]
        return sent
