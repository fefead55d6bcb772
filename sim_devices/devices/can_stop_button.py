"""The stop button as a CAN node: id 0x080, byte 0 = 1 pressed or 0 released, byte 1 = sequence number.

Source: frame table of the bench (issue 2). Sent at once on press and on release, every 100 ms while pressed,
every 500 ms while released. Truth face: ``press``, ``release``.

Model limits
- The contact does not bounce; the button latches until released; ``silent`` (fault hook) stops all frames.
"""

from __future__ import annotations

STOP_ID = 0x080
PRESSED_PERIOD_NS = 100_000_000
RELEASED_PERIOD_NS = 500_000_000


class CanStopButton:
    """Emulates one button. ``start_ns`` is the bench time of its first heartbeat."""

    def __init__(self, *, start_ns: int = 0) -> None:
        self.pressed = False
        self.silent = False
        self._sequence = 0
        self._due_ns = start_ns
        self._now_ns = start_ns
        self._frames: list[tuple[int, bytes]] = []

    def press(self) -> None:
        self._set(True)

    def release(self) -> None:
        self._set(False)

    def _set(self, pressed: bool) -> None:
        if pressed != self.pressed:
            self.pressed = pressed
            self._due_ns = self._now_ns  # sent by the next advance_to

    def receive(self, can_id: int, data: bytes, t_ns: int) -> None:
        """A button does not listen."""

    def next_event_ns(self) -> int | None:
        return self._due_ns

    def advance_to(self, t_ns: int) -> None:
        self._now_ns = max(self._now_ns, t_ns)
        if self._due_ns > t_ns:
            return
        period_ns = PRESSED_PERIOD_NS if self.pressed else RELEASED_PERIOD_NS
        self._due_ns += (1 + (t_ns - self._due_ns) // period_ns) * period_ns
        if not self.silent:
            self._frames.append((STOP_ID, bytes((int(self.pressed), self._sequence))))
            self._sequence = (self._sequence + 1) & 0xFF

    def take(self) -> list[tuple[int, bytes]]:
        if not self._frames:
            return []
        frames, self._frames = self._frames, []
        return frames
